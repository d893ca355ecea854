/* Pin of each valve and input of each sensor. For the Arduino MEGA 2560: its twelve 16-bit PWM outputs. */
#ifndef PINS_H
#define PINS_H

/* X(channel, Arduino pin, timer, compare unit, port, bit). Pin 13 comes last because the bootloader blinks it while it
 * waits for an upload: with a bootloader installed a valve there would open at every reset. */
#define CHANNEL_TABLE(X) \
  X(0, 2, 3, B, E, 4)    \
  X(1, 3, 3, C, E, 5)    \
  X(2, 5, 3, A, E, 3)    \
  X(3, 6, 4, A, H, 3)    \
  X(4, 7, 4, B, H, 4)    \
  X(5, 8, 4, C, H, 5)    \
  X(6, 11, 1, A, B, 5)   \
  X(7, 12, 1, B, B, 6)   \
  X(8, 44, 5, C, L, 5)   \
  X(9, 45, 5, B, L, 4)   \
  X(10, 46, 5, A, L, 3)  \
  X(11, 13, 1, C, B, 7)

/* 11 with a bootloader; 12 only on a board flashed without one (make -C firmware CHANNELS_USED=12). */
#ifndef CHANNELS_USED
#define CHANNELS_USED 11
#endif

/* Bit c is set where channel c has a pressure sensor on analogue input A<c>, A0 to A11. More than 5 V destroys an
 * input. */
#ifndef SENSORS
#define SENSORS 0x003f
#endif

/* PWM at 16 MHz / 4096 = 3.9 kHz. Duty = counts / 4096; a compare register holds counts - 1, and at 0 counts the
 * output is disconnected, because a compare value of 0 still gives one count. */
#define PWM_TOP 4095
#define PWM_COUNTS (PWM_TOP + 1UL)

#define BAUD 250000UL /* exact at 16 MHz, which 115200 is not */

#endif
