/* A program that tests the emulated MEGA: each command byte brings the chip into a known state. 115200 baud (double
 * speed). */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/delay.h>

static void send(uint8_t byte) {
  while (!(UCSR0A & _BV(UDRE0))) {
  }
  UDR0 = byte;
}

static uint8_t receive(void) {
  while (!(UCSR0A & _BV(RXC0))) {
  }
  return UDR0;
}

static uint16_t analogue(uint8_t input) {
  ADMUX = _BV(REFS0) | input;
  ADCSRA = _BV(ADEN) | _BV(ADSC) | 7;
  while (ADCSRA & _BV(ADSC)) {
  }
  return ADC;
}

static void echo_at_250000_baud(void) {
  while (!(UCSR0A & _BV(TXC0))) {
  }
  UCSR0A = 0;
  UBRR0 = 3;
  for (;;) {
    send(receive());
  }
}

int main(void) {
  UBRR0 = 16;
  UCSR0A = _BV(U2X0);
  UCSR0B = _BV(RXEN0) | _BV(TXEN0);
  ICR3 = 999;
  OCR3B = 249; /* pin 2, channel 0 */
  TCCR3A = _BV(WGM31);
  TCCR3B = _BV(WGM33) | _BV(WGM32) | _BV(CS30);
  send('R');
  for (;;) {
    const uint8_t command = receive();
    switch (command) {
      case 'd': /* does not read for more than ten byte times, then sends what was kept */
        _delay_ms(5);
        while (UCSR0A & _BV(RXC0)) {
          send(UDR0);
        }
        break;
      case 'c': /* connected, but the pin is an input */
        TCCR3A |= _BV(COM3B1);
        break;
      case 'o':
        DDRE |= _BV(4);
        break;
      case 'h':
        OCR3B = 499;
        break;
      case 't':
        ICR3 = 1999;
        break;
      case 'i': /* inverting, which the firmware must not use */
        TCCR3A |= _BV(COM3B0);
        break;
      case 'x': /* disconnected, pin low */
        TCCR3A &= (uint8_t)~(_BV(COM3B1) | _BV(COM3B0));
        break;
      case 'p': /* pin high by its port register */
        PORTE |= _BV(4);
        break;
      case 'a': {
        const uint16_t counts = analogue(3);
        send((uint8_t)(counts >> 8));
        send((uint8_t)counts);
        break;
      }
      case 's': /* sleeps until a reset */
        cli();
        SMCR = _BV(SE);
        __asm__ volatile("sleep");
        break;
      case 'e':
        send(command);
        echo_at_250000_baud();
        break;
      default:
        break;
    }
    send(command);
  }
}
