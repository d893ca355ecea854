#include "boot.h"

#include <avr/io.h>
#include <avr/wdt.h>
#include <stdbool.h>

#include "frame.h"

#define MAGIC 0x6d736674UL
#define STARVED_MS 100 /* a watchdog of 120 ms, whose own clock may run fast, has bitten after more than this */

/* Not cleared at start: survives a reset, and holds chance values after power-on. */
static struct {
  uint32_t magic;
  uint32_t id;
  uint32_t fed_ms;
  uint8_t chance[24];
} memory __attribute__((section(".noinit")));
static uint8_t flags_at_reset __attribute__((section(".noinit")));
static uint32_t millis_at_reset __attribute__((section(".noinit")));
static bool survived, starved;

extern volatile unsigned long timer0_millis; /* what the core's millis() counts in */

/* Runs before main and before the variables are cleared: a watchdog that bit stays armed with its shortest time, and
 * would bite again before setup() is reached. */
void boot_early(void) __attribute__((naked, used, section(".init3")));
void boot_early(void) {
  flags_at_reset = MCUSR;
  millis_at_reset = timer0_millis;
  MCUSR = 0;
  wdt_disable();
}

uint32_t boot_next_id(void) {
  survived = memory.magic == MAGIC;
  starved = millis_at_reset - memory.fed_ms >= STARVED_MS;
  memory.id = survived ? memory.id + 1 : frame_crc32((const uint8_t *)&memory, sizeof memory);
  memory.magic = MAGIC;
  memory.fed_ms = 0;
  return memory.id;
}

uint8_t boot_reset_cause(void) {
  if (flags_at_reset & _BV(WDRF)) {
    return RESET_CAUSE_WATCHDOG;
  }
  if (flags_at_reset & _BV(BORF)) {
    return RESET_CAUSE_BROWN_OUT;
  }
  if (flags_at_reset & _BV(PORF)) {
    return RESET_CAUSE_POWER_ON;
  }
  if (flags_at_reset & _BV(EXTRF)) {
    return RESET_CAUSE_EXTERNAL;
  }
  /* The MEGA's bootloader clears the flags, but leaves most of the memory as it was: the clock stood far behind the
   * last feeding if the watchdog bit. (Not if interrupts were off in the hang: that looks like an external reset.) */
  if (!survived) {
    return RESET_CAUSE_POWER_ON;
  }
  return starved ? RESET_CAUSE_WATCHDOG : RESET_CAUSE_EXTERNAL;
}

void boot_feed_watchdog(uint32_t now_ms) {
  memory.fed_ms = now_ms;
  wdt_reset();
}
