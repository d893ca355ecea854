/* The native board: the firmware's logic (frame.c, output.c, supervisor.c) compiled for this machine.
 *
 * For machines without simavr. Same commands, events, pacing and serial port as board.c, but this file replaces
 * firmware.ino and the hardware below it: no bootloader, no timer registers (duties are those of the logic), no AVR
 * compiler, no timing of the CPU. It tests the protocol, the states and the safety timers only. */
#include "harness.h"

#include <string.h>

#include "supervisor.h"
#include "limits.h"
#include "pins.h"

#define LOOP_TICKS (1000 * TICKS_PER_US)           /* firmware.ino sleeps for a millisecond at most */
#define WATCHDOG_TICKS (128 * 1000 * TICKS_PER_US) /* WDTO_120MS is 16384 cycles of 128 kHz */
#define TX_BUFFER 64
#define ADC_COUNTS 1024
#define NEVER (~(ticks_t)0 / 2)

const char *const board_name = "native";
const unsigned board_channels = CHANNELS_USED;
struct board_load board_load;

static struct supervisor logic;
static ticks_t now, next_loop, started, watchdog_fed, tx_free, rx_end;
static uint32_t boot_id;
static int rx_now = -1;
static bool hung;
static unsigned counts_now[MAX_CHANNELS];
static bool floating[MAX_CHANNELS];
static int16_t measured[PROTOCOL_CHANNELS];
static unsigned supply_mv = ADC_FULL_MV;

static uint32_t now_ms(void) { return (uint32_t)((now - started) / LOOP_TICKS); }

static void start(uint8_t cause, const char *name) {
  hung = false;
  started = next_loop = watchdog_fed = now + STARTUP_TICKS;
  tx_free = 0;
  harness_report_reset(name);
  supervisor_init(&logic, boot_id, cause, 0);
  for (unsigned channel = 0; channel < board_channels; channel++) {
    if (!floating[channel]) {
      harness_report_duty(channel, floating[channel] = true, counts_now[channel] = 0, 0, 0);
    }
  }
}

static void loop(void) {
  uint8_t checks = supervisor_update(&logic, measured, (uint16_t)supply_mv, now_ms());
  for (unsigned channel = 0; channel < board_channels; channel++) {
    unsigned counts = supervisor_counts(&logic, channel);
    if (counts == counts_now[channel] && !floating[channel]) {
      continue;
    }
    counts_now[channel] = counts;
    floating[channel] = false;
    harness_report_duty(channel, false, (double)counts / PWM_COUNTS, counts ? counts - 1 : 0, counts ? PWM_TOP : 0);
  }
  ticks_t byte_ticks = (ticks_t)TICKS_PER_SECOND * 10 / BAUD;
  while (tx_free < now + TX_BUFFER * byte_ticks) {
    int16_t byte = supervisor_next_byte(&logic);
    if (byte < 0) {
      break;
    }
    tx_free = (tx_free > now ? tx_free : now) + byte_ticks;
    pty_send(tx_free, (uint8_t)byte, BAUD);
  }
  if (checks == CHECK_UPDATE) {
    watchdog_fed = now;
  }
}

void board_run(ticks_t until) {
  while (now < until) {
    if (rx_now < 0 && (rx_now = pty_next_byte(BAUD)) >= 0) {
      rx_end = now + pty_byte_ticks();
    }
    ticks_t watchdog = watchdog_fed + WATCHDOG_TICKS, next = until;
    if (rx_now >= 0 && rx_end < next) {
      next = rx_end;
    }
    if (!hung && next_loop < next) {
      next = next_loop;
    }
    if (watchdog < next) {
      next = watchdog;
    }
    now = next > now ? next : now;
    bool arrived = rx_now >= 0 && now >= rx_end, listens = !hung && now >= started;
    if (arrived && listens) {
      supervisor_receive(&logic, (uint8_t)rx_now, now_ms());
    }
    if (arrived) {
      rx_now = -1;
    }
    if (listens && (arrived || now >= next_loop)) {
      loop();
      next_loop = now + LOOP_TICKS;
    }
    if (now >= watchdog_fed + WATCHDOG_TICKS) {
      boot_id++;
      start(RESET_CAUSE_WATCHDOG, "watchdog");
    }
  }
}

void board_reset_pin(void) {
  boot_id++;
  start(RESET_CAUSE_EXTERNAL, "external");
}

void board_power_cycle(void) {
  boot_id = harness_random();
  start(RESET_CAUSE_POWER_ON, "power-on");
}

void board_power_on(const struct options *options) {
  if (options->bootloader) {
    events_fail(EXIT_USAGE, "the native board has no bootloader: leave --bootloader out");
  }
  for (unsigned channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
    measured[channel] = SENSORS >> channel & 1 ? 0 : PROTOCOL_NOT_MEASURED;
  }
  board_power_cycle();
}

void board_power_off(void) {
  board_power_cycle();
  started = next_loop = watchdog_fed = NEVER;
}

bool board_runs_firmware(void) { return now >= started; }

bool board_hang(bool interrupts_off) {
  (void)interrupts_off; /* there are no interrupts here */
  hung = true;
  events_emit("hang", "%s", "");
  return true;
}

ticks_t board_now(void) { return now; }

void board_set_adc(unsigned input, unsigned millivolt) {
  if (SENSORS >> input & 1) {
    unsigned reading = millivolt * (ADC_COUNTS - 1) / ADC_FULL_MV;
    measured[input] = (int16_t)SENSOR_PRESSURE(reading * ADC_FULL_MV / ADC_COUNTS);
  }
}

void board_set_supply(unsigned millivolt) { supply_mv = millivolt; }
