/* Replaces avr-libc's <avr/io.h> in the native build: the same names of registers and bits, in plain memory. */
#ifndef FAKE_AVR_IO_H
#define FAKE_AVR_IO_H

#include <stdint.h>

extern volatile uint8_t chip[0x200]; /* the data space up to the memory */

#define _AVR_IO_H_
#define _SFR_MEM8(address) chip[address]
#define _SFR_MEM16(address) (*(volatile uint16_t *)&chip[address])
#define _SFR_IO8(address) _SFR_MEM8((address) + 0x20)
#define _SFR_IO16(address) _SFR_MEM16((address) + 0x20)
#define _BV(bit) (1 << (bit))
#include <avr/iom2560.h>

#endif
