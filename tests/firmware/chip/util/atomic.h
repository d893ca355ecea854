/* In place of avr-libc's <util/atomic.h>: nothing interrupts here. */
#define ATOMIC_BLOCK(type)
