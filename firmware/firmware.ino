// Connects the lab PC to the valves. All decisions are in supervisor.c and output.c, which are tested on a PC; this
// sketch connects them to the serial port, the pins and the clock.
//
// Before flashing, check limits.h (your valves' full scale) and pins.h (your wiring).

#include <avr/sleep.h>
#include <avr/wdt.h>

#include "boot.h"
#include "supervisor.h"
#include "pins.h"
#include "pwm.h"
#include "sensors.h"

#define RX_BYTES_PER_PASS 32  // arrive in 1.3 ms, about the longest pass; the receive buffer holds 63
#define TX_BYTES_PER_PASS 8

static struct supervisor board;
static struct sensors inputs;

// Fails when the converter stops, because the supervisor must not rely on old readings.
static uint8_t take_reading() { return sensors_poll(&inputs) ? CHECK_ADC : 0; }

static uint8_t drive_pins() {
  for (uint8_t channel = 0; channel < CHANNELS_USED; channel++) {
    pwm_write(channel, supervisor_counts(&board, channel));
  }
  return CHECK_PINS;
}

void setup() {
  pwm_begin();
  sensors_begin(&inputs);
  Serial.begin(BAUD);
  const uint32_t id = boot_next_id();
  supervisor_init(&board, id, boot_reset_cause(), millis());
  set_sleep_mode(SLEEP_MODE_IDLE);
  wdt_enable(WDTO_120MS);
}

void loop() {
  static uint32_t last_ms;
  const uint32_t now_ms = millis();

  // At most one frame and a few bytes in a pass, so that a flood of bytes cannot delay the checks.
  for (uint8_t i = 0; i < RX_BYTES_PER_PASS && Serial.available() > 0; i++) {
    if (supervisor_receive(&board, (uint8_t)Serial.read(), now_ms)) {
      break;  // the next interrupt starts the pass that takes the rest
    }
  }
  if (now_ms != last_ms) {  // every byte starts a pass; the rest runs once a millisecond
    last_ms = now_ms;
    uint8_t checks = take_reading();
    checks |= supervisor_update(&board, inputs.measured, inputs.supply_mv, now_ms);
    checks |= drive_pins();
    if (checks == CHECK_ALL) {
      boot_feed_watchdog(now_ms, inputs.supply_mv);
    }
  }
  // Never waits for the host to read. A few bytes at a time, because every byte sent starts a pass that adds more.
  for (uint8_t i = 0; i < TX_BYTES_PER_PASS && Serial.availableForWrite() > 0; i++) {
    const int16_t next = supervisor_next_byte(&board);
    if (next < 0) {
      break;
    }
    Serial.write((uint8_t)next);
  }
  sleep_mode();  // until the next interrupt, a millisecond at most
}
