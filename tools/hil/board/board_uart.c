/* UART0 of the emulated MEGA: bytes take as long as on the wire, and are lost where the chip would lose them. */
#include "mega.h"

#include <string.h>

#include "avr_uart.h"

#define BITS_PER_BYTE 10 /* simavr counts eleven: 10 % slow, and 7 % of a flood lost */

static avr_uart_t *uart;
static avr_irq_t *uart_in;
static ticks_t tx_free, rx_end;        /* when the last byte is out; when the one arriving is in */
static int rx_now = -1, rx_shift = -1; /* arriving; arrived, but both places of the receive buffer are full */
static struct {
  avr_io_read_t read;
  void *param;
} chip_udr;
static struct {
  avr_io_write_t write;
  void *param;
} chip_ucsrb;

static uint32_t board_bit_ticks(void) {
  return (word_at(UBRR0) % 4096 + 1u) * (avr->data[UCSR0A] >> U2X0 & 1 ? 8 : 16);
}

static uint32_t board_baud(void) { return TICKS_PER_SECOND / board_bit_ticks(); }

/* 0 while the receiver is off: then the host's rate does not matter. */
static uint32_t listening_baud(void) { return avr->data[UCSR0B] >> RXEN0 & 1 ? board_baud() : 0; }

/* simavr computes its byte time at every change of the rate, so this corrects it before each use. */
static void correct_byte_time(void) { uart->cycles_per_byte = BITS_PER_BYTE * board_bit_ticks(); }

static unsigned rx_held(void) { return (uart->input.write - uart->input.read) & (uart_fifo_fifo_size - 1); }

static void rx_store(uint8_t byte) {
  uart->cycles_per_byte = 1; /* its stop bit has arrived: ready now, not one byte time later */
  avr_raise_irq(uart_in, byte);
  correct_byte_time();
}

/* The start bit of the next byte, if any. */
static void begin_byte(avr_cycle_count_t now) {
  rx_now = pty_next_byte(listening_baud());
  rx_end = now + (rx_now < 0 ? 0 : pty_byte_ticks());
  if (rx_now >= 0 && rx_shift >= 0) { /* while the shift register is still full */
    pty_counters.rx_overrun++;
    rx_shift = -1;
  }
}

/* One byte has arrived; the next begins, if any. simavr buffers 64 bytes, the chip 2 and its shift register. */
static avr_cycle_count_t on_rx_byte(avr_t *chip, avr_cycle_count_t when, void *param) {
  (void)param;
  if (chip->data[UCSR0B] >> RXEN0 & 1) {
    if (rx_held() < 2) {
      rx_store((uint8_t)rx_now);
    } else {
      rx_shift = rx_now;
    }
  }
  begin_byte(when);
  return rx_now < 0 ? 0 : rx_end;
}

static uint8_t on_udr_read(avr_t *chip, avr_io_addr_t address, void *param) {
  (void)param;
  uart->rx_cnt = 0; /* disables simavr's limit of the reading rate: bytes arrive at the port's rate */
  uint8_t value = chip_udr.read(chip, address, chip_udr.param);
  if (rx_shift >= 0) {
    rx_store((uint8_t)rx_shift);
    rx_shift = -1;
  }
  if (rx_held()) {
    avr_raise_interrupt(chip, &uart->rxc); /* the flag stays set while a byte is left */
  }
  return value;
}

/* The transmit buffer is free again. simavr reports that one byte time later, when the shift register is empty too. */
static avr_cycle_count_t on_tx_room(avr_t *chip, avr_cycle_count_t when, void *param) {
  (void)when, (void)param;
  avr_raise_interrupt(chip, &uart->udrc);
  return 0;
}

static void on_uart_output(avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)param;
  correct_byte_time();
  if (tx_free < avr->cycle) {
    tx_free = avr->cycle;
  }
  avr_cycle_timer_register(avr, tx_free - avr->cycle + 2, on_tx_room, NULL); /* after simavr's own timer */
  tx_free += uart->cycles_per_byte;
  pty_send(tx_free, (uint8_t)value, board_baud());
}

static void on_ucsrb_write(avr_t *chip, avr_io_addr_t address, uint8_t value, void *param) {
  (void)param;
  chip_ucsrb.write(chip, address, value, chip_ucsrb.param);
  if (avr_regbit_get(chip, uart->udrc.enable) && avr_regbit_get(chip, uart->udrc.raised)) {
    avr_raise_interrupt(chip, &uart->udrc);
  }
}

void uart_after_reset(void) {
  avr->data[UCSR0B] = 0; /* simavr leaves the transmitter on */
  tx_free = 0;
  rx_now = rx_shift = -1;
}

void uart_start_byte(void) {
  if (rx_now >= 0) {
    return;
  }
  begin_byte(avr->cycle);
  if (rx_now >= 0) {
    avr_cycle_timer_register(avr, pty_byte_ticks(), on_rx_byte, NULL);
  }
}

void uart_ignore_bytes(void) {
  while (rx_end <= avr->cycle) {
    rx_end = pty_next_byte(0) < 0 ? avr->cycle + 1 : rx_end + pty_byte_ticks();
  }
}

void uart_begin(void) {
  for (avr_io_t *io = avr->io_port; io; io = io->next) {
    if (!strcmp(io->kind, "uart") && ((avr_uart_t *)io)->name == '0') {
      uart = (avr_uart_t *)io;
    }
  }
  uint32_t no_flags = 0; /* otherwise simavr sleeps at every read of the status register */
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &no_flags);
  uart_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_uart_output, NULL);

  unsigned udr = AVR_DATA_TO_IO(UDR0), ucsrb = AVR_DATA_TO_IO(UCSR0B);
  chip_udr.read = avr->io[udr].r.c;
  chip_udr.param = avr->io[udr].r.param;
  avr->io[udr].r.c = on_udr_read;
  avr->io[udr].r.param = NULL;
  chip_ucsrb.write = avr->io[ucsrb].w.c;
  chip_ucsrb.param = avr->io[ucsrb].w.param;
  avr->io[ucsrb].w.c = on_ucsrb_write;
  avr->io[ucsrb].w.param = NULL;
}
