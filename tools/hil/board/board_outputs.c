/* The valve outputs of the emulated MEGA: the output of each channel's pin, computed from the timer registers. */
#include "mega.h"

#include "pins.h"

#define MODE_14 14

/* The MEGA's 16-bit timer outputs: the pin, its port bit, and the registers of its timer. */
#define TIMER(n, letter, com_shift) OCR##n##letter, TCCR##n##A, TCCR##n##B, ICR##n, com_shift
static const struct {
  unsigned pin, bit, ddr, port, compare, control_a, control_b, top, com_shift;
} outputs[] = {
    {11, 5, DDRB, PORTB, TIMER(1, A, 6)}, {12, 6, DDRB, PORTB, TIMER(1, B, 4)}, {13, 7, DDRB, PORTB, TIMER(1, C, 2)},
    {5, 3, DDRE, PORTE, TIMER(3, A, 6)},  {2, 4, DDRE, PORTE, TIMER(3, B, 4)},  {3, 5, DDRE, PORTE, TIMER(3, C, 2)},
    {6, 3, DDRH, PORTH, TIMER(4, A, 6)},  {7, 4, DDRH, PORTH, TIMER(4, B, 4)},  {8, 5, DDRH, PORTH, TIMER(4, C, 2)},
    {46, 3, DDRL, PORTL, TIMER(5, A, 6)}, {45, 4, DDRL, PORTL, TIMER(5, B, 4)}, {44, 5, DDRL, PORTL, TIMER(5, C, 2)},
};
#define OUTPUTS (sizeof outputs / sizeof *outputs)

/* Only the pins come from the firmware's channel map: an error in its timers or ports must show here. */
#define PIN_OF_CHANNEL(channel, pin, timer, unit, port, bit) [channel] = pin,
static const uint8_t channel_pins[] = {CHANNEL_TABLE(PIN_OF_CHANNEL)};
const unsigned board_channels = CHANNELS_USED;

static unsigned output_of[MAX_CHANNELS];
static struct {
  double duty;
  unsigned compare, top;
  bool floating;
} last[MAX_CHANNELS];
static struct {
  avr_io_write_t write;
  void *param;
} chained[MAX_IOs];

static void sample(unsigned channel) {
  unsigned o = output_of[channel];
  unsigned a = avr->data[outputs[o].control_a], b = avr->data[outputs[o].control_b];
  unsigned com = a >> outputs[o].com_shift & 3, mode = (a & 3) | (b >> 1 & 0x0C), clock = b & 7;
  unsigned compare = word_at(outputs[o].compare), top = word_at(outputs[o].top);
  bool is_output = avr->data[outputs[o].ddr] >> outputs[o].bit & 1;
  bool level = avr->data[outputs[o].port] >> outputs[o].bit & 1;
  double duty = 0;
  if (is_output && com == 0) {
    duty = level; /* a plain pin: shows the bootloader's LED on D13 */
  } else if (is_output && clock && com == 2 && mode == MODE_14) {
    duty = compare >= top ? 1 : (compare + 1.0) / (top + 1.0);
  } else if (is_output && clock) {
    duty = 1; /* a mode that is not modelled: the worst case, so that a test fails */
  }
  if (duty == 0) {
    compare = top = 0; /* the registers of a disconnected timer have no effect */
  }
  if (duty == last[channel].duty && compare == last[channel].compare && top == last[channel].top &&
      is_output != last[channel].floating) {
    return;
  }
  last[channel].duty = duty;
  last[channel].compare = compare;
  last[channel].top = top;
  last[channel].floating = !is_output;
  harness_report_duty(channel, !is_output, duty, compare, top);
}

void outputs_sample(void) {
  for (unsigned channel = 0; channel < board_channels; channel++) {
    sample(channel);
  }
}

/* simavr has no event for OCRnC and only four places for shared registers, so its write handlers are wrapped. */
static void on_output_write(avr_t *chip, avr_io_addr_t address, uint8_t value, void *param) {
  unsigned io = AVR_DATA_TO_IO(address);
  (void)param;
  if (chained[io].write) {
    chained[io].write(chip, address, value, chained[io].param);
  } else {
    avr_core_watch_write(chip, address, value);
  }
  outputs_sample();
}

static void watch(unsigned address) {
  unsigned io = AVR_DATA_TO_IO(address);
  if (avr->io[io].w.c == on_output_write) {
    return;
  }
  chained[io].write = avr->io[io].w.c;
  chained[io].param = avr->io[io].w.param;
  avr->io[io].w.c = on_output_write;
  avr->io[io].w.param = NULL;
}

void outputs_begin(void) {
  for (unsigned channel = 0; channel < board_channels; channel++) {
    unsigned o = 0;
    while (o < OUTPUTS && outputs[o].pin != channel_pins[channel]) {
      o++;
    }
    if (o == OUTPUTS) {
      events_fail(EXIT_INTERNAL, "pin %u of channel %u is no 16-bit timer output", channel_pins[channel], channel);
    }
    output_of[channel] = o;
    watch(outputs[o].compare); /* the low byte: its write comes last */
    watch(outputs[o].control_a);
    watch(outputs[o].control_b);
    watch(outputs[o].top);
    watch(outputs[o].ddr);
    watch(outputs[o].port);
  }
}
