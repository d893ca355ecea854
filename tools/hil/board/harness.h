/* Shared by the two emulated boards, with the functions that each of them must define.
 *
 * board.c (the compiled firmware on simavr) and native_board.c (the firmware's logic compiled for this machine) define
 * the board_* functions; pty.c (serial port as a pseudo terminal), sensors.c, events.c and harness.c (main,
 * commands, pacing) serve both. The commands and events are described at the top of board.c. */
#ifndef HARNESS_H
#define HARNESS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Emulated time is counted in ticks: CPU cycles at 16 MHz, on both boards. */
#define TICKS_PER_US 16
#define TICKS_PER_SECOND (1000000u * TICKS_PER_US)
typedef uint64_t ticks_t;

/* The MEGA's fuses hold the chip for 16K clocks and 65 ms after every reset. */
#define STARTUP_TICKS (16384 + 65000 * TICKS_PER_US)

#define ADC_CHANNELS 16
#define ADC_FULL_MV 5000
#define MAX_CHANNELS 16

struct options {
  const char *firmware;   /* ELF or Intel hex; the native board is compiled with its own */
  const char *bootloader; /* Intel hex, or NULL: the reset vector is then the firmware's */
  const char *port_link;  /* symbolic link to be made to the serial port */
  bool fast;              /* emulated time does not follow real time */
  bool stepped;           /* emulated time advances only in the command `run` */
};

/* --- a board ----------------------------------------------------------------------------------------------------- */

extern const char *const board_name;
extern const unsigned board_channels;

struct board_load {
  ticks_t slept;     /* since the last reset, the firmware's own sleep */
  ticks_t max_awake; /* longest stretch from one sleep to the next: the firmware's worst loop; 0 where not emulated */
};
extern struct board_load board_load;

void board_power_on(const struct options *options);
ticks_t board_now(void);
void board_run(ticks_t until);        /* may overshoot by one instruction */
void board_reset_pin(void);           /* what DTR does when the port is opened */
void board_power_cycle(void);         /* a reset that also loses the RAM */
void board_power_off(void);           /* until the next power cycle: every pin floats */
bool board_runs_firmware(void);       /* false: in reset, or in the bootloader */
bool board_hang(bool interrupts_off); /* stops the main loop until the next reset; false: not possible now */
void board_set_adc(unsigned input, unsigned millivolt);
void board_set_supply(unsigned millivolt);

/* --- the serial port (pty.c) ------------------------------------------------------------------------------------- */

struct pty_counters {
  uint64_t rx, tx;                   /* bytes that the board received, sent */
  uint64_t rx_bootloader;            /* written by the host while the board was in reset or in its bootloader */
  uint64_t rx_corrupted, rx_dropped; /* by injected noise */
  uint64_t tx_corrupted, tx_dropped;
  uint64_t rx_overrun;         /* lost in the UART: the firmware was too slow */
  uint64_t tx_unread;          /* lost, because the host did not read */
  uint64_t from_host, to_host; /* taken from and given to the pseudo terminal */
  uint64_t wrong_baud;         /* corrupted: host and board use different rates */
};
extern struct pty_counters pty_counters;

void pty_open(const char *link);
void pty_unplug(void);
void pty_plug(const char *link);
const char *pty_port(void);
bool pty_is_open(void);                 /* a host has it open */
void pty_poll(void);                    /* once a slice: opened or closed, bytes in */
void pty_flush(ticks_t now);            /* once a slice: bytes out whose stop bit has passed */
int pty_next_byte(uint32_t board_baud); /* the byte that starts to arrive now, or -1; baud 0: the receiver is off */
ticks_t pty_byte_ticks(void);           /* duration of a byte at the host's rate */
void pty_send(ticks_t end, uint8_t byte, uint32_t board_baud);
bool pty_command(const char *verb, double probability);
void pty_flood(ticks_t duration);

/* --- pressure sensors (sensors.c) -------------------------------------------------------------------------------- */

#define SENSOR_MV_PER_UNIT ((double)SENSOR_SPAN_MV / SENSOR_FULL) /* a unit is that of limits.h, 10 Pa */
#define UNITS_PER_BAR (100000 / PROTOCOL_PRESSURE_UNIT_PA)

void sensors_follow(double tau_ms);                    /* every sensor follows its valve */
void sensors_hold(unsigned input, unsigned millivolt); /* this one reads a fixed voltage */
void sensors_on_duty(unsigned channel, double duty);   /* a valve changed */
void sensors_advance(double elapsed_us);               /* once a slice */

/* --- events (events.c) ------------------------------------------------------------------------------------------- */

void events_begin(void);
uint64_t events_mono_ns(void); /* CLOCK_MONOTONIC */
void events_flush(bool wait);
void events_emit(const char *name, const char *format, ...) __attribute__((format(printf, 2, 3)));
_Noreturn void events_fail(int exit_code, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* --- outputs and random numbers (harness.c) ---------------------------------------------------------------------- */

void harness_report_duty(unsigned channel, bool floating, double duty, unsigned compare, unsigned top);
void harness_report_reset(const char *cause);
uint32_t harness_random(void);

enum { EXIT_USAGE = 2, EXIT_INTERNAL = 70 };

#endif
