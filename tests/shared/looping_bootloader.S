; A bootloader that leaves the watchdog on, as some that MEGA boards were sold with: it waits longer than the 16 ms that
; the watchdog has after a reset of its own, then starts the program.
#include <avr/io.h>
.global __vectors
__vectors:
  ldi r20, 8          ; 8 * 65536 * 4 cycles: 0.13 s
1:ldi r24, 0
  ldi r25, 0
2:sbiw r24, 1
  brne 2b
  dec r20
  brne 1b
  jmp 0
