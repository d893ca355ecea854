/* The emulated MEGA: the compiled firmware on simavr's ATmega2560, behind the board's real bootloader.
 *
 * board --elf FIRMWARE [--bootloader HEX] --port-link PATH [--fast | --stepped]
 *
 * PATH becomes a symbolic link to the board's serial port. Opening it resets the board, as DTR does on the real one.
 * Emulated time follows real time: never ahead, at most 20 ms behind. A board that is later than that drops the time it
 * lost and reports it (`late`). With --fast time runs freely; with --stepped it advances only in the command `run`, so
 * that a busy machine does not disturb a host on that clock.
 *
 * Commands, one a line on standard input; end of file ends the board:
 *   adc INPUT MILLIVOLT                       voltage on A0..A15
 *   supply MILLIVOLT                          supply of the chip, 5000 at first: scale of the converter
 *   sensors TAU_MS                            pressure sensors follow their valves with a first-order lag until `adc`
 *   reset | power-cycle                       reset pin; power off and on (RAM lost)
 *   power-off                                 no power until power-cycle
 *   hang [cli]                                the main loop stops until a reset; cli: interrupts are off too
 *   unplug | plug [PATH]                      pull the USB cable (the board keeps its power); back in, under a new name
 *   corrupt-rx|drop-rx|insert-rx P [SEED]     serial noise towards the board, probability of each byte
 *   corrupt-tx|drop-tx P [SEED]               serial noise towards the host
 *   flood MS | seed N                         random bytes at the port's rate towards the board; seed of the noise
 *   run US BYTES                              --stepped: advance by US microseconds once the host has sent BYTES bytes
 *                                             in total; answered by `ran`
 *   stats | quit
 *
 * Events, one JSON object a line on standard output, each with t_us (emulated, from the cycle counter), mono_ns
 * (CLOCK_MONOTONIC when it was emulated) and event:
 *   ready      board, clock, port, channels, bootloader, pid; p_full_bar (valve pressure at duty 1), sensors (bit c:
 *              channel c has a sensor, on input c), sensor_mv_per_bar, sensor_zero_mv
 *   pwm        channel (order of firmware/pins.h), duty 0..1, raw [compare, top], floating (the pin is
 *              an input: neither high nor low); only when one of them changes
 *   uart-open, uart-close, dtr-pulse, wrong-baud
 *   watchdog, reset (cause: power-on, external, watchdog), hang, halted
 *   late       emulated time gave way by late_us
 *   command    line, done: the echo of every command but `adc` and `run`
 *   ran        end of a `run`; from_host, to_host: total bytes from and to the host
 *   stats, summary   times, lateness, share of a core, byte counters; rx_bootloader: bytes that the host wrote while
 *              the board was in reset or in its bootloader; firmware_slept_us: sleep since the last reset;
 *              firmware_max_awake_us: its longest time without sleep (its slowest loop)
 *
 * Known differences from the chip: a new compare value takes effect at once, not at the end of the PWM period (256 us);
 * a pin whose timer is connected but stopped counts as 0; waking from sleep takes no time.
 *
 * simavr is GPL-3: this file is a test tool and not part of the wheel. */
#include "mega.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "avr_adc.h"
#include "avr_extint.h"
#include "avr_watchdog.h"
#include "sim_elf.h"
#include "sim_hex.h"

#define NEVER (~(ticks_t)0)
#define RJMP_SELF 0xCFFF /* rjmp .-2 */

const char *const board_name = "simavr";
struct board_load board_load;

avr_t *avr;

static const char *reset_cause;
static uint8_t flags_before; /* MCUSR at the reset: only power-on and the program clear its bits */
static ticks_t held_until;   /* end of the reset; 0: running */
static bool chip_was_reset, halted_reported;
static void (*chip_reset)(avr_t *);
static unsigned adc_mv[ADC_CHANNELS];
static ticks_t woken; /* end of the last sleep; 0 before the first */
static struct {
  uint32_t at;
  uint8_t before[2];
  bool on;
} hang;

/* --- reset and power --------------------------------------------------------------------------------------------- */

static void on_chip_reset(avr_t *chip) {
  chip_was_reset = true;
  if (chip_reset) {
    chip_reset(chip);
  }
}

/* The registers are cleared, so the pins float: every valve is off from now on. The chip stays in reset for a while. */
static void enter_reset(const char *cause) {
  reset_cause = cause;
  held_until = avr->cycle + STARTUP_TICKS;
  if (hang.on) {
    memcpy(avr->flash + hang.at, hang.before, 2);
    hang.on = false;
  }
  harness_report_reset(cause);
  outputs_sample();
}

static void leave_reset(void) {
  uint8_t flags = flags_before;
  bool watchdog_on = !strcmp(reset_cause, "watchdog") || flags & 1 << WDRF; /* it stays on while WDRF is set */
  for (avr_io_t *io = avr->io_port; io; io = io->next) {
    if (!strcmp(io->kind, "watchdog") && watchdog_on) {
      avr_watchdog_t *watchdog = (avr_watchdog_t *)io;
      watchdog->reset_context.wdrf = 1;
      watchdog->reset_context.avr_run = avr->run;
    }
  }
  avr_reset(avr);
  if (!strcmp(reset_cause, "external")) {
    avr->data[MCUSR] |= 1 << EXTRF;
  }
  avr->data[MCUSR] |= flags;
  flags_before = avr->data[MCUSR];
  for (int i = 0; i < EXTINT_COUNT; i++) {
    avr_extint_set_strict_lvl_trig(avr, i, 0); /* otherwise simavr polls the low pins in every cycle: 0.35x real time */
  }
  avr->run_cycle_limit = TICKS_PER_SECOND / 1000; /* run until the next timer instead of one instruction a call */
  uart_after_reset();
  held_until = woken = board_load.slept = 0;
  chip_was_reset = halted_reported = false;
}

void board_reset_pin(void) {
  avr_reset(avr);
  enter_reset("external");
}

void board_power_cycle(void) {
  avr_reset(avr);
  for (unsigned address = 0; address <= avr->ramend; address++) { /* random values; every other reset keeps them */
    if (address < 32 || address > avr->ioend) {
      avr->data[address] = harness_random();
    }
  }
  flags_before = 1 << PORF;
  enter_reset("power-on");
}

void board_power_off(void) {
  board_power_cycle();
  held_until = NEVER;
}

bool board_runs_firmware(void) { return !held_until && !(avr->reset_pc && avr->pc >= avr->reset_pc); }

bool board_hang(bool interrupts_off) {
  if (hang.on || !board_runs_firmware()) {
    return false; /* the bootloader has no watchdog */
  }
  hang.at = avr->pc;
  hang.on = true;
  memcpy(hang.before, avr->flash + hang.at, 2);
  avr->flash[hang.at] = RJMP_SELF & 0xFF;
  avr->flash[hang.at + 1] = RJMP_SELF >> 8;
  if (interrupts_off) {
    avr->sreg[S_I] = 0;
  }
  events_emit("hang", "\"pc\":%u,\"interrupts\":%s", (unsigned)avr->pc, interrupts_off ? "false" : "true");
  return true;
}

static avr_cycle_count_t on_slice_end(avr_t *chip, avr_cycle_count_t when, void *param) {
  (void)chip, (void)when, (void)param;
  return 0; /* exists only so that a sleeping chip wakes at the end of the slice */
}

void board_run(ticks_t until) {
  if (held_until) {
    avr->cycle = held_until < until ? held_until : until;
    uart_ignore_bytes();
    if (avr->cycle < held_until) {
      return;
    }
    leave_reset();
  }
  uart_start_byte();
  avr_cycle_timer_register(avr, until > avr->cycle ? until - avr->cycle : 1, on_slice_end, NULL);
  while (avr->cycle < until && !held_until) {
    avr->run(avr);
    if (chip_was_reset) {
      enter_reset("watchdog");
    } else {
      flags_before = avr->data[MCUSR];
    }
    if (avr->state == cpu_Done || avr->state == cpu_Crashed) { /* asleep with interrupts off, or crashed: time passes */
      if (!halted_reported) {
        events_emit("halted", "\"pc\":%u,\"crashed\":%s", (unsigned)avr->pc,
                    avr->state == cpu_Crashed ? "true" : "false");
      }
      halted_reported = true;
      avr->cycle += TICKS_PER_US;
    }
  }
}

ticks_t board_now(void) { return avr ? avr->cycle : 0; }

void board_set_adc(unsigned input, unsigned millivolt) { adc_mv[input] = millivolt; }

void board_set_supply(unsigned millivolt) { avr->vcc = avr->avcc = avr->aref = millivolt; }

/* simavr has eight analogue inputs. At the start of a conversion the selected one gets its voltage. */
static void on_conversion(avr_irq_t *irq, uint32_t value, void *param) {
  unsigned input = (avr->data[ADMUX] & 7) | (avr->data[ADCSRB] & 1 << MUX5 ? 8 : 0);
  (void)irq, (void)value, (void)param;
  if (!(avr->data[ADMUX] & 0x18)) {
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + (input & 7)), adc_mv[input]);
  }
}

static void adc_begin(void) {
  for (avr_io_t *io = avr->io_port; io; io = io->next) {
    for (unsigned input = 0; !strcmp(io->kind, "adc") && input < 8; input++) {
      avr_adc_t *adc = (avr_adc_t *)io;
      adc->muxmode[32 + input] = adc->muxmode[input]; /* with MUX5: A8..A15 */
    }
  }
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER), on_conversion, NULL);
}

/* --- start ------------------------------------------------------------------------------------------------------- */

static uint32_t load_hex(const char *path) {
  ihex_chunk_p chunks = NULL;
  int count = read_ihex_chunks(path, &chunks);
  if (count <= 0) {
    events_fail(EXIT_USAGE, "%s is not a readable Intel hex file", path);
  }
  for (int i = 0; i < count; i++) {
    avr_loadcode(avr, chunks[i].data, chunks[i].size, chunks[i].baseaddr);
  }
  return chunks[0].baseaddr;
}

static void load_firmware(const char *path) {
  const char *suffix = strrchr(path, '.');
  elf_firmware_t firmware = {0};
  if (suffix && !strcasecmp(suffix, ".hex")) {
    load_hex(path);
  } else if (elf_read_firmware(path, &firmware) != 0 || !firmware.flashsize) {
    events_fail(EXIT_USAGE, "%s is not a readable ELF file of a firmware", path);
  } else {
    avr_loadcode(avr, firmware.flash, firmware.flashsize, firmware.flashbase);
  }
}

static void log_to_stderr(avr_t *chip, const int level, const char *format, va_list arguments) {
  (void)chip;
  if (level <= LOG_ERROR) {
    vfprintf(stderr, format, arguments);
  }
}

/* The firmware sleeps until the next timer of the emulated chip; the harness waits for real time after each slice. */
static void on_sleep(avr_t *chip, avr_cycle_count_t cycles) {
  ticks_t awake = chip->cycle - woken;
  if (woken && awake > board_load.max_awake) {
    board_load.max_awake = awake;
  }
  board_load.slept += cycles + 1;
  woken = chip->cycle + cycles + 1;
}

void board_power_on(const struct options *options) {
  if (!options->firmware) {
    events_fail(EXIT_USAGE, "--elf FILE is missing: the firmware to run");
  }
  avr_global_logger_set(log_to_stderr);
  avr = avr_make_mcu_by_name("atmega2560");
  if (!avr) {
    events_fail(EXIT_INTERNAL, "this simavr has no ATmega2560");
  }
  avr_init(avr);
  avr->frequency = TICKS_PER_SECOND;
  avr->vcc = avr->avcc = avr->aref = 5000;
  avr->sleep = on_sleep;
  chip_reset = avr->reset;
  avr->reset = on_chip_reset;
  load_firmware(options->firmware);
  if (options->bootloader) {
    avr->reset_pc = load_hex(options->bootloader);
  }

  adc_begin();
  uart_begin();
  outputs_begin();
  board_power_cycle();
}
