/* The parts of the chip and of the Arduino core that pwm.c, sensors.c and boot.c access, as plain memory. */
#include <avr/io.h>
#include <avr/wdt.h>

_Alignas(2) volatile uint8_t chip[0x200];
int watchdog_is_on = 1, watchdog_resets;
volatile unsigned long timer0_millis;
