/* The only code that touches the valve pins and their timers. */
#ifndef PWM_H
#define PWM_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Pins low, then outputs; timers 1, 3, 4 and 5 running with every output disconnected. */
void pwm_begin(void);

/* Sets a channel of pins.h to counts out of PWM_COUNTS; 0 disconnects the pin, which then is low. */
void pwm_write(uint8_t channel, uint16_t counts);

#ifdef __cplusplus
}
#endif
#endif
