/* main() of both emulated boards: commands, events, pacing of the emulated time. See the top of board.c. */
#define _GNU_SOURCE
#include "harness.h"

#include <errno.h>
#include <getopt.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <time.h>
#include <unistd.h>

#include "limits.h"
#include "pins.h"

#define SLICE_US 500
#define LATE_US 1000        /* slices later than this are counted */
#define LATE_BOUND_US 20000 /* beyond this, emulated time drops the delay */
#define STEP_WAIT_US 50     /* for bytes that are still in the pseudo terminal */
#define STEP_TRIES 20000

static uint64_t started_ns, slices, late_slices, max_late_ns, slipped_ns, pwm_events, resets;
static ticks_t run_until;      /* stepped: end of the emulated time that `run` allows */
static uint64_t run_from_host; /* ... which starts once the host has sent this many bytes */
static bool run_reported = true;
static volatile sig_atomic_t stop_signal;
static uint64_t random_state = 0x9E3779B97F4A7C15u;

uint32_t harness_random(void) {
  random_state ^= random_state << 13; /* xorshift64 */
  random_state ^= random_state >> 7;
  random_state ^= random_state << 17;
  return random_state >> 32;
}

void harness_report_duty(unsigned channel, bool floating, double duty, unsigned compare, unsigned top) {
  sensors_on_duty(channel, duty);
  pwm_events++;
  events_emit("pwm", "\"channel\":%u,\"duty\":%.6f,\"raw\":[%u,%u],\"floating\":%s", channel, duty, compare, top,
              floating ? "true" : "false");
}

void harness_report_reset(const char *cause) {
  resets++;
  if (!strcmp(cause, "watchdog")) {
    events_emit("watchdog", "%s", "");
  }
  events_emit("reset", "\"cause\":\"%s\"", cause);
}

static void report_statistics(const char *name) {
  struct rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  double cpu_s =
      usage.ru_utime.tv_sec + usage.ru_stime.tv_sec + 1e-6 * (usage.ru_utime.tv_usec + usage.ru_stime.tv_usec);
  double wall_s = 1e-9 * (events_mono_ns() - started_ns), emulated_s = (double)board_now() / TICKS_PER_SECOND;
  struct pty_counters *c = &pty_counters;
  events_emit(
      name,
      "\"emulated_s\":%.6f,\"wall_s\":%.6f,\"cpu_s\":%.3f,\"percent_of_real_time\":%.3f,\"percent_of_core\":%.2f,"
      "\"slices\":%llu,\"late_slices\":%llu,\"max_late_us\":%.1f,\"slipped_us\":%.1f,"
      "\"pwm_events\":%llu,\"resets\":%llu,"
      "\"firmware_slept_us\":%.1f,\"firmware_max_awake_us\":%.1f,"
      "\"rx\":%llu,\"tx\":%llu,\"rx_bootloader\":%llu,\"rx_overrun\":%llu,\"tx_unread\":%llu,"
      "\"rx_corrupted\":%llu,\"rx_dropped\":%llu,"
      "\"tx_corrupted\":%llu,\"tx_dropped\":%llu,\"wrong_baud\":%llu",
      emulated_s, wall_s, cpu_s, wall_s > 0 ? 100 * emulated_s / wall_s : 0, wall_s > 0 ? 100 * cpu_s / wall_s : 0,
      (unsigned long long)slices, (unsigned long long)late_slices, max_late_ns * 1e-3, slipped_ns * 1e-3,
      (unsigned long long)pwm_events, (unsigned long long)resets, (double)board_load.slept / TICKS_PER_US,
      (double)board_load.max_awake / TICKS_PER_US, (unsigned long long)c->rx, (unsigned long long)c->tx,
      (unsigned long long)c->rx_bootloader, (unsigned long long)c->rx_overrun, (unsigned long long)c->tx_unread,
      (unsigned long long)c->rx_corrupted, (unsigned long long)c->rx_dropped, (unsigned long long)c->tx_corrupted,
      (unsigned long long)c->tx_dropped, (unsigned long long)c->wrong_baud);
}

static bool run_command(char *line) {
  char verb[32] = "", rest[4096] = "";
  double a = 0, b = 0;
  bool known = true;
  sscanf(line, "%31s %4095s", verb, rest);
  int numbers = sscanf(line, "%*s %lf %lf", &a, &b);
  if (!strcmp(verb, "quit")) {
    stop_signal = SIGTERM;
  } else if (!strcmp(verb, "adc") && numbers == 2 && a >= 0 && a < ADC_CHANNELS && b >= 0 && b <= ADC_FULL_MV) {
    sensors_hold((unsigned)a, (unsigned)b);
    return true; /* a rig sends hundreds a second: no event */
  } else if (!strcmp(verb, "supply") && numbers == 1 && a >= 2700 && a <= 5500) {
    board_set_supply((unsigned)a);
  } else if (!strcmp(verb, "sensors") && numbers == 1 && a > 0) {
    sensors_follow(a);
  } else if (!strcmp(verb, "reset")) {
    board_reset_pin();
  } else if (!strcmp(verb, "power-cycle")) {
    board_power_cycle();
  } else if (!strcmp(verb, "power-off")) {
    board_power_off();
  } else if (!strcmp(verb, "hang")) {
    known = board_hang(!strcmp(rest, "cli"));
  } else if (!strcmp(verb, "unplug")) {
    pty_unplug();
  } else if (!strcmp(verb, "plug")) {
    pty_plug(rest);
  } else if (!strcmp(verb, "flood") && numbers == 1) {
    pty_flood((ticks_t)(a * 1000 * TICKS_PER_US));
  } else if (!strcmp(verb, "seed") && numbers == 1) {
    random_state = 0x9E3779B97F4A7C15u ^ (uint64_t)a << 20;
  } else if (!strcmp(verb, "stats")) {
    report_statistics("stats");
  } else if (!strcmp(verb, "run") && numbers == 2 && a > 0) {
    run_until = board_now() + (ticks_t)(a * TICKS_PER_US);
    run_from_host = (uint64_t)b;
    run_reported = false;
    return true; /* a host sends hundreds a second: no event until it ends */
  } else {
    known = numbers >= 1 && a >= 0 && a <= 1 && pty_command(verb, a);
    if (known && numbers >= 2) {
      random_state = 0x9E3779B97F4A7C15u ^ (uint64_t)b << 20;
    }
  }
  for (char *p = line; *p; p++) {
    if (*p == '"' || *p == '\\' || (unsigned char)*p < ' ') {
      *p = '?';
    }
  }
  events_emit("command", "\"done\":%s,\"line\":\"%.200s\"", known ? "true" : "false", line);
  return known;
}

static void read_commands(int wait_ms) {
  static char buffer[8192];
  static size_t size;
  if (poll(&(struct pollfd){.fd = 0, .events = POLLIN}, 1, wait_ms) <= 0) {
    return;
  }
  ssize_t got = read(0, buffer + size, sizeof buffer - 1 - size);
  if (got <= 0) {
    stop_signal = SIGTERM; /* end of file: the parent has ended */
    return;
  }
  size += (size_t)got;
  buffer[size] = 0;
  char *line = buffer, *end;
  while ((end = strchr(line, '\n'))) {
    *end = 0;
    run_command(line);
    line = end + 1;
  }
  size -= (size_t)(line - buffer);
  memmove(buffer, line, size);
  if (size == sizeof buffer - 1) {
    size = 0;
  }
}

static void on_signal(int number) { stop_signal = number; }

/* Waits until real time has reached the end of the slice; emulated time is never ahead. */
static void pace(uint64_t *base_ns, ticks_t slice_end) {
  uint64_t due_ns = *base_ns + slice_end * 1000 / TICKS_PER_US, now_ns;
  struct timespec due = {.tv_sec = (time_t)(due_ns / 1000000000u), .tv_nsec = (long)(due_ns % 1000000000u)};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) == EINTR && !stop_signal) {
  }
  now_ns = events_mono_ns();
  uint64_t late_ns = now_ns > due_ns ? now_ns - due_ns : 0;
  late_slices += late_ns > LATE_US * 1000u;
  if (late_ns > max_late_ns) {
    max_late_ns = late_ns;
  }
  if (late_ns > LATE_BOUND_US * 1000u) {
    *base_ns += late_ns;
    slipped_ns += late_ns;
    events_emit("late", "\"late_us\":%.1f", late_ns * 1e-3);
  }
}

/* Stepped: waits for a `run`, then for the bytes that the host wrote before it. */
static void await_step(void) {
  while (board_now() >= run_until && !stop_signal) {
    if (!run_reported) {
      events_emit("ran", "\"from_host\":%llu,\"to_host\":%llu", (unsigned long long)pty_counters.from_host,
                  (unsigned long long)pty_counters.to_host);
    }
    run_reported = true;
    events_flush(true);
    read_commands(1000);
  }
  pty_poll();
  for (int tries = 0; pty_counters.from_host < run_from_host && pty_is_open() && tries < STEP_TRIES; tries++) {
    usleep(STEP_WAIT_US);
    pty_poll();
  }
}

static struct options parse_options(int argc, char **argv) {
  struct options options = {0};
  static const struct option names[] = {
      {"elf", required_argument, NULL, 'e'},
      {"firmware", required_argument, NULL, 'e'},
      {"bootloader", required_argument, NULL, 'b'},
      {"port-link", required_argument, NULL, 'p'},
      {"fast", no_argument, NULL, 'f'},
      {"stepped", no_argument, NULL, 's'},
      {NULL, 0, NULL, 0},
  };
  for (int name; (name = getopt_long(argc, argv, "", names, NULL)) != -1;) {
    switch (name) {
      case 'e':
        options.firmware = optarg;
        break;
      case 'b':
        options.bootloader = optarg;
        break;
      case 'p':
        options.port_link = optarg;
        break;
      case 'f':
        options.fast = true;
        break;
      case 's':
        options.stepped = true;
        break;
      default:
        exit(EXIT_USAGE);
    }
  }
  if (!options.port_link) {
    events_fail(EXIT_USAGE, "--port-link PATH is missing: where to put the link to the serial port");
  }
  return options;
}

static void report_ready(const struct options *options) {
  events_emit("ready",
              "\"board\":\"%s\",\"clock\":\"%s\",\"port\":\"%s\",\"channels\":%u,\"bootloader\":%s,\"pid\":%d,"
              "\"p_full_bar\":%g,\"sensors\":%u,\"sensor_mv_per_bar\":%g,\"sensor_zero_mv\":%d",
              board_name,
              options->stepped ? "emulated, step by step"
              : options->fast  ? "emulated, not held to real time"
                               : "emulated, held to real time",
              pty_port(), board_channels, options->bootloader ? "true" : "false", (int)getpid(),
              (double)P_FULL / UNITS_PER_BAR, (unsigned)SENSORS, SENSOR_MV_PER_UNIT * UNITS_PER_BAR,
              (int)SENSOR_ZERO_MV);
}

/* Runs the board for one slice of emulated time. */
static void run_slice(const struct options *options, uint64_t *base_ns) {
  if (options->stepped) {
    await_step();
  }
  ticks_t slice_end = board_now() + SLICE_US * TICKS_PER_US;
  if (options->stepped && run_until < slice_end) {
    slice_end = run_until;
  }
  if (!options->fast && !options->stepped) {
    pace(base_ns, slice_end);
  }
  if (!options->stepped) {
    read_commands(0);
  }
  pty_poll();
  ticks_t before = board_now();
  board_run(slice_end);
  sensors_advance((double)(board_now() - before) / TICKS_PER_US);
  pty_flush(board_now());
  events_flush(false);
}

int main(int argc, char **argv) {
  struct options options = parse_options(argc, argv);
  events_begin();
  signal(SIGPIPE, SIG_IGN);
  signal(SIGINT, on_signal);
  signal(SIGTERM, on_signal);
  signal(SIGHUP, on_signal);
  pid_t parent = getppid();

  board_power_on(&options);
  pty_open(options.port_link);
  started_ns = events_mono_ns();
  report_ready(&options);

  uint64_t base_ns = started_ns - board_now() * 1000 / TICKS_PER_US;
  while (!stop_signal) {
    run_slice(&options, &base_ns);
    if (++slices % 400 == 0 && getppid() != parent) {
      break; /* the parent died; PR_SET_PDEATHSIG would depend on the thread that started this process */
    }
  }
  pty_unplug();
  report_statistics("summary");
  events_flush(true);
  return 0;
}
