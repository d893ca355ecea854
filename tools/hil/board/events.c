/* Output of the emulated boards: events as JSON lines on standard output, fatal errors as a line on standard error. */
#define _GNU_SOURCE
#include "harness.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define EVENT_BACKLOG (64u << 20)

static int events_fd;
static char *pending;
static size_t pending_size, pending_room;

uint64_t events_mono_ns(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

void events_begin(void) {
  events_fd = fcntl(1, F_DUPFD_CLOEXEC, 3);
  dup2(2, 1); /* libraries print to standard error; standard output has only events */
  fcntl(events_fd, F_SETFL, fcntl(events_fd, F_GETFL) | O_NONBLOCK);
}

void events_fail(int exit_code, const char *format, ...) {
  va_list arguments;
  va_start(arguments, format);
  fprintf(stderr, "board: ");
  vfprintf(stderr, format, arguments);
  fputc('\n', stderr);
  va_end(arguments);
  exit(exit_code);
}

/* Writes the waiting events without blocking: a slow reader must not delay emulated time, and no event is dropped. */
void events_flush(bool wait) {
  size_t done = 0;
  while (done < pending_size) {
    ssize_t written = write(events_fd, pending + done, pending_size - done);
    if (written > 0) {
      done += (size_t)written;
    } else if (errno == EAGAIN && wait) {
      poll(&(struct pollfd){.fd = events_fd, .events = POLLOUT}, 1, 1000);
    } else if (errno == EAGAIN) {
      break;
    } else if (errno != EINTR) {
      exit(0); /* the reader has closed the pipe */
    }
  }
  memmove(pending, pending + done, pending_size -= done);
}

void events_emit(const char *name, const char *format, ...) {
  char line[2048];
  ticks_t now = board_now();
  int size = snprintf(line, sizeof line, "{\"t_us\":%llu.%04u,\"mono_ns\":%llu,\"event\":\"%s\"",
                      (unsigned long long)(now / TICKS_PER_US), (unsigned)(now % TICKS_PER_US) * (10000 / TICKS_PER_US),
                      (unsigned long long)events_mono_ns(), name);
  va_list arguments;
  va_start(arguments, format);
  int members = vsnprintf(line + size + 1, sizeof line - size - 4, format, arguments);
  va_end(arguments);
  if (members) {
    line[size] = ',';
    size += 1 + members;
  }
  line[size++] = '}';
  line[size++] = '\n';
  if (pending_size + size > EVENT_BACKLOG) {
    events_fail(EXIT_INTERNAL, "no process reads the events: %zu bytes are waiting", pending_size);
  }
  if (pending_size + size > pending_room) {
    pending = realloc(pending, pending_room = 2 * pending_room + sizeof line);
  }
  memcpy(pending + pending_size, line, size);
  pending_size += size;
}
