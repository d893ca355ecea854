// The board between the lab PC and the valves. Thin on purpose: what it decides stands in supervisor.c and output.c,
// which are tested on a PC; here they meet the serial port, the pins and the clock.
//
// Before flashing, check limits.h (your valves' full scale) and pins.h (your wiring).

#include <avr/sleep.h>
#include <avr/wdt.h>

#include "boot.h"
#include "supervisor.h"
#include "pins.h"
#include "pwm.h"
#include "sensors.h"

#define BYTES_PER_PASS 8  // each way; a pass comes with every byte, or sooner

static struct supervisor board;
static struct sensors inputs;

// Fails when the converter stops: the supervisor would then compare readings that never change.
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

  // One frame and a few bytes a pass, so that a flood cannot keep the checks from running.
  for (uint8_t i = 0; i < BYTES_PER_PASS && Serial.available() > 0; i++) {
    if (supervisor_receive(&board, (uint8_t)Serial.read(), now_ms)) {
      break;  // what is left waits for the next interrupt, as the sleep below does
    }
  }
  if (now_ms != last_ms) {  // every byte wakes us; a millisecond is soon enough for all the rest
    last_ms = now_ms;
    uint8_t checks = 0;
    checks |= take_reading();
    checks |= supervisor_update(&board, inputs.measured, inputs.supply_mv, now_ms);
    checks |= drive_pins();
    if (checks == CHECK_ALL) {
      boot_feed_watchdog(now_ms);
    }
  }
  // Never waits for the host to read, and never long for the copying: every byte that leaves wakes us for more.
  for (uint8_t i = 0; i < BYTES_PER_PASS && Serial.availableForWrite() > 0; i++) {
    const int16_t next = supervisor_next_byte(&board);
    if (next < 0) {
      break;
    }
    Serial.write((uint8_t)next);
  }
  sleep_mode();  // until the next interrupt, a millisecond at most
}
