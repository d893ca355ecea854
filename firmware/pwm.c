#include "pwm.h"

#include <avr/io.h>
#include <util/atomic.h>

#include "pins.h"

/* Fast PWM with the top in ICRn (mode 14), no prescaler, no output connected yet. Before this the timers have the
 * settings of the Arduino core, for its 8-bit analogWrite. */
#define BEGIN_TIMER(n)         \
  TCCR##n##B = 0;              \
  TCCR##n##A = _BV(WGM##n##1); \
  ICR##n = PWM_TOP;            \
  TCNT##n = 0;                 \
  TCCR##n##B = _BV(WGM##n##3) | _BV(WGM##n##2) | _BV(CS##n##0);

#define BEGIN_PIN(channel, pin, timer, unit, port, bit) \
  if (channel < CHANNELS_USED) {                        \
    PORT##port &= (uint8_t)~_BV(bit);                   \
    DDR##port |= _BV(bit);                              \
  }

#define WRITE_PIN(channel, pin, timer, unit, port, bit)     \
  case channel:                                             \
    if (channel >= CHANNELS_USED) {                         \
      break;                                                \
    }                                                       \
    if (counts == 0) {                                      \
      TCCR##timer##A &= (uint8_t)~_BV(COM##timer##unit##1); \
      OCR##timer##unit = 0;                                 \
    } else {                                                \
      OCR##timer##unit = counts - 1;                        \
      TCCR##timer##A |= _BV(COM##timer##unit##1);           \
    }                                                       \
    break;

void pwm_begin(void) {
  BEGIN_TIMER(1)
  BEGIN_TIMER(3)
  BEGIN_TIMER(4)
  BEGIN_TIMER(5)
  CHANNEL_TABLE(BEGIN_PIN)
}

void pwm_write(uint8_t channel, uint16_t counts) {
  /* All 16-bit registers are written through one shared temporary byte. */
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    switch (channel) { CHANNEL_TABLE(WRITE_PIN) }
  }
}
