/* Replaces avr-libc's <avr/wdt.h>: the watchdog is two variables in chip.c. */
#ifndef FAKE_AVR_WDT_H
#define FAKE_AVR_WDT_H

extern int watchdog_is_on, watchdog_resets;

#define wdt_disable() (watchdog_is_on = 0)
#define wdt_reset() (watchdog_resets++)

#endif
