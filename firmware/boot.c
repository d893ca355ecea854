#include "boot.h"

#include <avr/io.h>
#include <avr/wdt.h>
#include <stdbool.h>

#include "frame.h"
#include "limits.h"

#define MAGIC 0x6d736674UL
#define STARVED_MS 100 /* less than the 120 ms of the watchdog, whose clock may run fast */

/* Not cleared at start: keeps its values over a reset, and holds random values after power-on. */
static struct {
  uint32_t magic;
  uint32_t id;
  uint32_t fed_ms;
  uint16_t supply_mv;
  uint8_t noise[22];
} memory __attribute__((section(".noinit")));
static uint8_t flags_at_reset __attribute__((section(".noinit")));
static uint32_t millis_at_reset __attribute__((section(".noinit")));
static bool survived, starved, sagged;

extern volatile unsigned long timer0_millis; /* the counter of the core's millis() */

/* Runs before main and before the variables are cleared: after a watchdog reset the watchdog stays on with its shortest
 * time, and would reset the chip again before setup(). */
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
  sagged = memory.supply_mv < SUPPLY_LEAST_MV;
  memory.id = survived ? memory.id + 1 : frame_crc32((const uint8_t *)&memory, sizeof memory);
  memory.magic = MAGIC;
  memory.fed_ms = 0;
  memory.supply_mv = SUPPLY_LEAST_MV;
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
  /* The MEGA's bootloader clears the flags but keeps most of the memory: after a watchdog reset millis() is far past
   * the last feeding. (A hang with interrupts off stops millis() as well, and looks like an external reset.) */
  if (!survived) {
    return RESET_CAUSE_POWER_ON;
  }
  if (starved) {
    return RESET_CAUSE_WATCHDOG;
  }
  return sagged ? RESET_CAUSE_BROWN_OUT : RESET_CAUSE_EXTERNAL; /* the supply was low just before */
}

void boot_feed_watchdog(uint32_t now_ms, uint16_t supply_mv) {
  memory.fed_ms = now_ms;
  memory.supply_mv = supply_mv;
  wdt_reset();
}
