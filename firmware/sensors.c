#include "sensors.h"

#include <avr/io.h>

#include "limits.h"
#include "pins.h"

#if SENSORS & ~0xfff
#error "SENSORS: only channels 0 to 11 can have one, on A0 to A11"
#endif

#define INPUTS PROTOCOL_CHANNELS
/* After the last input, once in ROUNDS_PER_SUPPLY rounds, the 1.1 V reference is read, from which the supply (the full
 * scale) follows. The reference settles slowly after it is selected, so its first conversion is discarded. */
#define SETTLING INPUTS
#define SUPPLY (INPUTS + 1)
#define ROUNDS_PER_SUPPLY 8 /* twice in SUPPLY_MS with 6 sensors, once with 12 */
#define LEAST_READING 19    /* of the reference; a smaller one means more than 59 V, which may not fit 16 bits */

static bool has_sensor(uint8_t input) { return (SENSORS >> input) & 1; }

static void start(uint8_t input) {
  const uint8_t reference_input = _BV(MUX4) | _BV(MUX3) | _BV(MUX2) | _BV(MUX1);
  ADCSRB = input < INPUTS && input > 7 ? _BV(MUX5) : 0;                /* A8 to A15 */
  ADMUX = _BV(REFS0) | (input < INPUTS ? input & 7 : reference_input); /* full scale is the supply, 5 V */
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

static int16_t pressure(uint16_t reading) {
  const int32_t half = 1L << 11;
  int32_t value = (reading * SENSOR_SLOPE + SENSOR_OFFSET + half) >> 12;
  return (int16_t)(value > 32767 ? 32767 : value < -32767 ? -32767 : value); /* NOT_MEASURED is one less */
}

void sensors_begin(struct sensors *sensors) {
  for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    sensors->measured[channel] = PROTOCOL_NOT_MEASURED;
  }
  sensors->supply_mv = 0;
  sensors->input = SETTLING;
  DIDR0 = SENSORS & 0xff;
  DIDR2 = SENSORS >> 8;
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
    sensors->measured[sensors->input] = pressure(reading);
  } else if (sensors->input == SUPPLY) {
    sensors->supply_mv = reading < LEAST_READING ? 0 : (uint16_t)(REFERENCE_MV * 1024UL / reading);
  }
  next(sensors);
  start(sensors->input);
  return true;
}
