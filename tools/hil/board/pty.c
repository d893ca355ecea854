/* The serial port of the emulated board: a pseudo terminal, DTR, baud rates, and noise.
 *
 * simavr's own uart_pty is not used: it dies after a flood and hides that the host closed the port. Here the slave side
 * stays closed, so POLLHUP on the master means "the host has closed the port", and its clearing means "opened", which
 * pulls DTR on a MEGA and resets the board. */
#define _GNU_SOURCE
#include "harness.h"

#include <asm/ioctls.h>
#include <asm/termbits.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <unistd.h>

#define BITS_PER_BYTE 10 /* start, eight data, stop */
#define RX_ROOM 512      /* like the USB chip's buffer: the host's write() waits while it is full */
#define TX_ROOM 4096
#define BAUD_TOLERANCE 0.04

struct pty_counters pty_counters;

static int master = -1;
static char slave_name[64], link_name[4096];
static bool host_open, dtr_low, wrong_baud_reported;
static uint32_t host_baud = 115200;
static ticks_t next_baud_poll, flood_until;

static uint8_t rx[RX_ROOM];
static size_t rx_first, rx_count;
static struct {
  ticks_t end;
  uint8_t byte;
} tx[TX_ROOM];
static size_t tx_first, tx_count;

static double corrupt_rx, drop_rx, insert_rx, corrupt_tx, drop_tx;

static bool chance(double probability) { return probability > 0 && harness_random() < probability * 4294967296.0; }

static void make_link(const char *link) {
  struct stat there;
  snprintf(link_name, sizeof link_name, "%s", link);
  if (lstat(link_name, &there) == 0 && S_ISLNK(there.st_mode)) {
    unlink(link_name); /* left by a board that was killed; nothing else is removed */
  }
  if (symlink(slave_name, link_name) != 0) {
    events_fail(EXIT_USAGE, "cannot make the port link %s: %s", link_name, strerror(errno));
  }
}

void pty_open(const char *link) {
  master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
  if (master < 0 || grantpt(master) != 0 || unlockpt(master) != 0 || ptsname_r(master, slave_name, sizeof slave_name)) {
    events_fail(EXIT_INTERNAL, "cannot make a pseudo terminal: %s", strerror(errno));
  }
  /* Opened once: this sets raw mode before the first host comes, and POLLHUP is only reported after a close. */
  int slave = open(slave_name, O_RDWR | O_NOCTTY | O_CLOEXEC);
  struct termios2 raw;
  if (slave < 0 || ioctl(slave, TCGETS2, &raw) != 0) {
    events_fail(EXIT_INTERNAL, "cannot open the pseudo terminal %s: %s", slave_name, strerror(errno));
  }
  raw.c_iflag = 0;
  raw.c_oflag = 0;
  raw.c_lflag = 0;
  raw.c_cflag = (raw.c_cflag & ~(CSIZE | PARENB)) | CS8 | CREAD | CLOCAL;
  ioctl(slave, TCSETS2, &raw);
  close(slave);
  host_open = false;
  make_link(link);
}

void pty_unplug(void) {
  if (master < 0) {
    return;
  }
  unlink(link_name);
  close(master); /* the host's next read fails, as with an unplugged USB cable */
  master = -1;
  rx_count = tx_count = 0;
  if (host_open) {
    events_emit("uart-close", "\"unplugged\":true");
  }
  host_open = false;
}

void pty_plug(const char *link) {
  if (master >= 0) {
    return;
  }
  char previous[sizeof link_name];
  memcpy(previous, link_name, sizeof previous);
  pty_open(*link ? link : previous);
}

const char *pty_port(void) { return slave_name; }

bool pty_is_open(void) { return host_open; }

/* Reads the host's termios at the master. Rate 0 is how a host drops DTR with termios alone. */
static void poll_baud(void) {
  struct termios2 host;
  if (ioctl(master, TCGETS2, &host) != 0) {
    return;
  }
  uint32_t baud = (host.c_cflag & CBAUD) == B0 ? 0 : host.c_ospeed;
  if (baud != host_baud) {
    wrong_baud_reported = false;
  }
  if (baud) {
    host_baud = baud;
  }
  if (!baud) {
    dtr_low = true;
  } else if (dtr_low) {
    dtr_low = false;
    events_emit("dtr-pulse", "\"baud\":%u", baud);
    board_reset_pin();
  }
}

void pty_poll(void) {
  if (master < 0) {
    return;
  }
  struct pollfd port = {.fd = master, .events = POLLIN};
  poll(&port, 1, 0);
  bool open_now = !(port.revents & POLLHUP);
  if (open_now && !host_open) {
    host_open = true;
    dtr_low = false;
    poll_baud();
    events_emit("uart-open", "\"baud\":%u", host_baud);
    board_reset_pin();
  }
  if (host_open && (port.revents & POLLIN || board_now() >= next_baud_poll)) { /* bytes have the rate of their host */
    poll_baud();
    next_baud_poll = board_now() + 1000 * TICKS_PER_US;
  }
  while (port.revents & POLLIN && rx_count < RX_ROOM) {
    uint8_t bytes[RX_ROOM];
    ssize_t got = read(master, bytes, RX_ROOM - rx_count);
    if (got <= 0) {
      break;
    }
    pty_counters.from_host += (uint64_t)got;
    if (!board_runs_firmware()) {
      pty_counters.rx_bootloader += (uint64_t)got;
    }
    for (ssize_t i = 0; i < got; i++) {
      rx[(rx_first + rx_count++) % RX_ROOM] = bytes[i];
    }
  }
  if (!open_now && host_open) { /* after the read: bytes written before the close still arrive */
    host_open = false;
    events_emit("uart-close", "\"unplugged\":false");
  }
}

ticks_t pty_byte_ticks(void) { return (ticks_t)TICKS_PER_SECOND * BITS_PER_BYTE / host_baud; }

static bool rates_differ(uint32_t board_baud) {
  double difference = (double)host_baud - board_baud;
  if (!board_baud || (difference < 0 ? -difference : difference) <= BAUD_TOLERANCE * board_baud) {
    return false;
  }
  if (!wrong_baud_reported) {
    events_emit("wrong-baud", "\"host\":%u,\"board\":%u", host_baud, board_baud);
  }
  wrong_baud_reported = true;
  pty_counters.wrong_baud++;
  return true;
}

int pty_next_byte(uint32_t board_baud) {
  uint8_t byte;
  if (board_now() < flood_until || chance(insert_rx)) {
    byte = harness_random();
  } else {
    do {
      if (rx_count == 0) {
        return -1;
      }
      byte = rx[rx_first];
      rx_first = (rx_first + 1) % RX_ROOM;
      rx_count--;
    } while (chance(drop_rx) && ++pty_counters.rx_dropped);
    if (chance(corrupt_rx)) {
      byte ^= 1u << (harness_random() % 8);
      pty_counters.rx_corrupted++;
    }
    if (rates_differ(board_baud)) {
      byte = harness_random();
    }
  }
  pty_counters.rx++;
  return byte;
}

void pty_flood(ticks_t duration) { flood_until = board_now() + duration; }

void pty_send(ticks_t end, uint8_t byte, uint32_t board_baud) {
  pty_counters.tx++;
  if (!host_open) {
    return;
  }
  if (chance(drop_tx)) {
    pty_counters.tx_dropped++;
    return;
  }
  if (chance(corrupt_tx)) {
    byte ^= 1u << (harness_random() % 8);
    pty_counters.tx_corrupted++;
  }
  if (rates_differ(board_baud)) {
    byte = harness_random();
  }
  if (tx_count == TX_ROOM) {
    pty_counters.tx_unread++;
    return;
  }
  size_t last = (tx_first + tx_count++) % TX_ROOM;
  tx[last].end = end;
  tx[last].byte = byte;
}

void pty_flush(ticks_t now) {
  uint8_t bytes[TX_ROOM];
  size_t count = 0;
  while (tx_count && tx[tx_first].end <= now) {
    bytes[count++] = tx[tx_first].byte;
    tx_first = (tx_first + 1) % TX_ROOM;
    tx_count--;
  }
  if (!count || master < 0 || !host_open) {
    return;
  }
  ssize_t written = write(master, bytes, count);
  pty_counters.to_host += written > 0 ? (size_t)written : 0;
  pty_counters.tx_unread += count - (written > 0 ? (size_t)written : 0);
}

bool pty_command(const char *verb, double probability) {
  struct {
    const char *verb;
    double *value;
  } noise[] = {
      {"corrupt-rx", &corrupt_rx}, {"drop-rx", &drop_rx}, {"insert-rx", &insert_rx},
      {"corrupt-tx", &corrupt_tx}, {"drop-tx", &drop_tx},
  };
  for (size_t i = 0; i < sizeof noise / sizeof *noise; i++) {
    if (!strcmp(verb, noise[i].verb)) {
      *noise[i].value = probability;
      return true;
    }
  }
  return false;
}
