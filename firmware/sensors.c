#include "sensors.h"

#include <avr/io.h>

#include "limits.h"
#include "pins.h"

#if SENSORS & ~0xff
#error "SENSORS: only channels 0 to 7 can have one, on A0 to A7"
#endif

#define INPUTS 8
/* After the last input, once in ROUNDS_PER_SUPPLY rounds: the 1.1 V reference, measured against the supply. It settles
 * slowly after it is selected, so its first conversion is discarded. */
#define SETTLING INPUTS
#define SUPPLY (INPUTS + 1)
#define ROUNDS_PER_SUPPLY 64
#define REFERENCE_MV 1100UL
#define LEAST_READING 18 /* of the reference; less would be a supply of more than 62 V */

static bool has_sensor(uint8_t input) { return (SENSORS >> input) & 1; }

static void start(uint8_t input) {
  const uint8_t reference_input = _BV(MUX4) | _BV(MUX3) | _BV(MUX2) | _BV(MUX1);
  ADMUX = _BV(REFS0) | (input < INPUTS ? input : reference_input); /* full scale is the supply, 5 V */
  ADCSRA |= _BV(ADSC); /* clears ADIF as well, because it writes back the 1 */
}

static void next(struct sensors *sensors) {
  do {
    sensors->input++;
    if (sensors->input == SETTLING && ++sensors->rounds < ROUNDS_PER_SUPPLY && SENSORS) {
      sensors->input = 0;
    } else if (sensors->input > SUPPLY) {
      sensors->input = 0;
      sensors->rounds = 0;
    }
  } while (sensors->input < INPUTS && !has_sensor(sensors->input));
}

void sensors_begin(struct sensors *sensors) {
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    sensors->measured[channel] = PROTOCOL_NOT_MEASURED;
  }
  sensors->supply_mv = 0;
  sensors->input = SETTLING;
  DIDR0 = SENSORS;
  ADCSRB = 0;
  ADCSRA = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0); /* 125 kHz: 104 us a conversion */
  start(sensors->input);
}

bool sensors_poll(struct sensors *sensors) {
  uint16_t reading;
  if (!(ADCSRA & _BV(ADIF))) { /* never set by a converter that is off */
    return false;
  }
  reading = ADC;
  if (sensors->input < INPUTS) {
    const uint32_t half = 1UL << 9;
    sensors->measured[sensors->input] = (int16_t)((reading * (uint32_t)SENSOR_FULL + half) >> 10);
  } else if (sensors->input == SUPPLY) {
    sensors->supply_mv = reading < LEAST_READING ? 0 : (uint16_t)(REFERENCE_MV * 1024 / reading);
  }
  next(sensors);
  start(sensors->input);
  return true;
}
