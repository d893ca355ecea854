/* Shared by the parts of the emulated MEGA: board.c (chip), board_outputs.c (valve pins), board_uart.c (UART0). */
#ifndef MEGA_H
#define MEGA_H

#include "harness.h"

#include "sim_avr.h"
#include "sim_io.h"

/* avr-libc's own register names, as addresses in the data space */
#define _AVR_IO_H_
#define __ASSEMBLER__
#define _SFR_IO8(address) ((address) + 32)
#define _SFR_IO16(address) ((address) + 32)
#define _SFR_MEM8(address) (address)
#define _SFR_MEM16(address) (address)
#include <avr/iom2560.h>
#undef __ASSEMBLER__

extern avr_t *avr;

static inline unsigned word_at(unsigned address) { return avr->data[address] | avr->data[address + 1] << 8; }

void outputs_begin(void);
void outputs_sample(void); /* reports what has changed */

void uart_begin(void);
void uart_after_reset(void);
void uart_ignore_bytes(void); /* while in reset: what comes meanwhile is lost */
void uart_start_byte(void);   /* once a slice: the host's next byte begins to arrive, if the port is idle */

#endif
