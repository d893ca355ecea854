/* Replaces avr-libc's <util/atomic.h>: there are no interrupts here. */
#define ATOMIC_BLOCK(type)
