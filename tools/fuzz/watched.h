/* The firmware's logic with assertions: every byte and every pass goes through these functions, which check the rules
 * that hold for any input. The rules are written independently of the firmware. */
#ifndef WATCHED_H
#define WATCHED_H

#include <stdint.h>

#include "supervisor.h"

#define BOOT_ID 0xb0a4dUL

struct watched {
  struct supervisor board;
  uint32_t now_ms;
  int16_t measured[PROTOCOL_CHANNELS]; /* sensor readings, 10 Pa; set by the caller */
  int16_t applied[PROTOCOL_CHANNELS];  /* outputs after the last pass, 10 Pa */
};

/* Powers on: vented, all sensors read 0. */
void watched_begin(struct watched *w, uint32_t now_ms);

/* One byte arrives. Returns true if it ends a valid frame. */
bool watched_receive(struct watched *w, uint8_t byte);

/* Time passes, then one pass of the firmware's loop runs. Aborts with one line if a rule is violated: a byte since the
 * last pass changed an output to a value other than 0; an output leaves 0 .. P_MAX, moves faster than SLEW, or does not
 * fall at SLEW outside RUNNING or outside the session's channels; a fault is not latched; a time-out is ignored. */
void watched_pass(struct watched *w, uint32_t elapsed_ms);

/* The sensors read the applied pressures, or 0. */
void watched_follow(struct watched *w, bool follow);

/* A valid frame arrives. */
void watched_send(struct watched *w, uint8_t type, uint8_t seq, uint8_t session, const void *payload, uint8_t length);

/* Does what a correct host does to start a session, from any state to RUNNING with all set-points at `pressure`. Its
 * ticks continue from the board's. The first SET has sequence number 1. */
void watched_run(struct watched *w, int16_t pressure);

#endif
