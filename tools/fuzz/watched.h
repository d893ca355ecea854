/* The firmware's logic under watch: every byte and every pass goes through here, and what must hold of any board,
 * whatever comes over the wire, is asserted after each. The rules are written anew, not taken from the firmware. */
#ifndef WATCHED_H
#define WATCHED_H

#include <stdint.h>

#include "supervisor.h"

#define BOOT_ID 0xb0a4dUL

struct watched {
  struct supervisor board;
  uint32_t now_ms;
  int16_t measured[PROTOCOL_CHANNELS]; /* what the sensors read, 10 Pa; the caller's to change */
  int16_t applied[PROTOCOL_CHANNELS];  /* by the last pass */
};

/* Powers up, vented, the sensors reading 0. */
void watched_begin(struct watched *w, uint32_t now_ms);

/* One byte arrives. Returns true where it ended a good frame. */
bool watched_receive(struct watched *w, uint8_t byte);

/* Time passes, then one pass of the firmware's loop. Aborts, with one line, where a rule is broken: a byte since the
 * last pass moved an output, but to 0; an output leaves 0 .. P_MAX, moves faster than SLEW, or does not fall at SLEW
 * outside RUNNING or outside the session's channels; a fault is not latched; a session goes on past a time-out. */
void watched_pass(struct watched *w, uint32_t elapsed_ms);

/* Sensors read what is applied now, or 0. */
void watched_follow(struct watched *w, bool yes);

/* A whole frame as a host would send it arrives. */
void watched_send(struct watched *w, uint8_t type, uint8_t seq, uint8_t session, const void *payload, uint8_t length);

/* From whatever state to RUNNING in a new session, all channels told to go to `pressure`, as by a host that counts its
 * ticks on from the board's. The first SET has sequence number 1. */
void watched_run(struct watched *w, int16_t pressure);

#endif
