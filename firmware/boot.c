#include "boot.h"

#include <avr/io.h>
#include <avr/wdt.h>

#include "frame.h"

#define MAGIC 0x6d736674UL

/* Not cleared at start: survives a reset, and holds chance values after power-on. */
static struct {
  uint32_t magic;
  uint32_t id;
  uint8_t chance[24];
} memory __attribute__((section(".noinit")));
static uint8_t flags_at_reset __attribute__((section(".noinit")));
static uint8_t serial_at_reset __attribute__((section(".noinit")));
static uint8_t survived;

/* Runs before main, before any variable is set up: a watchdog that bit stays armed with its shortest time, and would
 * bite again before setup() is reached. */
void boot_early(void) __attribute__((naked, used, section(".init3")));
void boot_early(void) {
  flags_at_reset = MCUSR;
  serial_at_reset = UCSR0B;
  MCUSR = 0;
  wdt_disable();
}

uint32_t boot_next_id(void) {
  survived = memory.magic == MAGIC;
  memory.id = survived ? memory.id + 1 : frame_crc32((const uint8_t *)&memory, sizeof memory);
  memory.magic = MAGIC;
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
  /* The MEGA's bootloader clears the flags. After the watchdog it starts us at once, with the serial port still off;
   * after anything else it has first listened for an upload. */
  if (!survived) {
    return RESET_CAUSE_POWER_ON;
  }
  return serial_at_reset ? RESET_CAUSE_EXTERNAL : RESET_CAUSE_WATCHDOG;
}
