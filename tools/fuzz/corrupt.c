/* Rows 1 to 4 of the failure matrix on the firmware's logic, in numbers too large for Python.
 *
 * corrupt KIND TRIES [SEED]
 *   flip       1 to 4 bits of a frame
 *   drop       1 to 4 bytes lost
 *   insert     1 to 4 bytes inserted
 *   truncate   the end missing; once in 1000 tries followed by 400 ms of silence: the link timer must vent
 *   garbage    the same number of random bytes
 *   repeat     valid frames again: sent twice, out of order, of an earlier session
 *
 * Each try sends one such frame to a running board, and then a valid SET with new set-points. Prints one JSON object:
 *   tries
 *   whole           frames accepted because only a delimiter was changed
 *   wrong           corrupted frames accepted, repeated frames applied
 *   lost            valid SETs not applied
 *   silences
 *   latest_vent_ms  from the last valid frame of a silence until the valves are at 0
 * Exit code 1 if wrong or lost is not 0; aborts if a rule of watched.h is violated. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "limits.h"
#include "pins.h"
#include "watched.h"

#define HISTORY 300   /* sent frames kept for repetition: more than there are sequence numbers */
#define SESSION 20000 /* tries in a session; then a new one is armed */
#define SILENCE_EVERY 1000
#define SILENCE_MS 400

enum kind { FLIP, DROP, INSERT, TRUNCATE, GARBAGE, REPEAT, KINDS };
static const char *const names[KINDS] = {"flip", "drop", "insert", "truncate", "garbage", "repeat"};

struct sent {
  uint8_t seq;
  struct set set;
};

static uint64_t random_state;
static struct watched host;
static struct sent history[HISTORY];
static uint64_t sent_count;
static uint64_t whole, wrong, lost, silences;
static uint32_t latest_vent_ms;

static uint32_t draw(uint32_t below) {
  random_state ^= random_state << 13; /* xorshift64 */
  random_state ^= random_state >> 7;
  random_state ^= random_state << 17;
  return (uint32_t)((random_state >> 16) % below);
}

/* Corrupts a frame in place; returns its new length. The buffer has room for four more bytes. */
static uint32_t corrupt(uint8_t *bytes, uint32_t count, enum kind kind) {
  uint32_t times = 1 + draw(4);
  if (kind == TRUNCATE) {
    return draw(count);
  }
  if (kind == GARBAGE) {
    for (uint32_t i = 0; i < count; i++) {
      bytes[i] = (uint8_t)draw(256);
    }
    return count;
  }
  while (times--) {
    uint32_t at = draw(count);
    if (kind == FLIP) {
      bytes[at] ^= (uint8_t)(1u << draw(8));
    } else if (kind == DROP) {
      memmove(bytes + at, bytes + at + 1, count - at - 1);
      count--;
    } else {
      memmove(bytes + at + 1, bytes + at, count - at);
      bytes[at] = (uint8_t)draw(256);
      count++;
    }
  }
  return count;
}

/* A valid SET whose sequence number is `ahead` of the last one accepted. */
static struct sent next_set(uint8_t ahead) {
  struct sent next = {(uint8_t)(host.board.last_seq + ahead), {host.board.set_tick + ahead, {0}}};
  for (uint8_t channel = 0; channel < CHANNELS_USED; channel++) {
    next.set.pressures[channel] = (int16_t)draw(P_MAX + 1);
  }
  return next;
}

static bool is_applied(const struct sent *frame) {
  const struct supervisor *board = &host.board;
  return board->state == STATE_RUNNING && board->last_seq == frame->seq && board->set_tick == frame->set.tick &&
         !memcmp(board->set_points, frame->set.pressures, sizeof board->set_points);
}

static void send_good(const struct sent *frame) {
  watched_send(&host, MESSAGE_SET, frame->seq, host.board.session, &frame->set, sizeof frame->set);
  lost += !is_applied(frame);
  history[sent_count++ % HISTORY] = *frame;
}

/* The closing delimiter of a corrupted frame may be the opening one of the next. */
static void try_corrupted(enum kind kind) {
  uint8_t bytes[FRAME_MAX_ENCODED + 4];
  struct sent frame = next_set(1);
  const struct supervisor before = host.board;
  uint32_t count = frame_encode(bytes, MESSAGE_SET, frame.seq, host.board.session, &frame.set, sizeof frame.set);
  uint32_t good = 0;
  count = corrupt(bytes, count, kind);
  for (uint32_t i = 0; i < count; i++) {
    good += watched_receive(&host, bytes[i]);
  }
  good += watched_receive(&host, PROTOCOL_DELIMITER);
  if (good == 1 && is_applied(&frame)) {
    whole++;
  } else if (good || host.board.state != before.state || host.board.last_seq != before.last_seq ||
             host.board.last_valid_ms != before.last_valid_ms ||
             memcmp(host.board.set_points, before.set_points, sizeof before.set_points)) {
    wrong++;
  }
}

static void try_repeated(void) {
  const struct supervisor before = host.board;
  uint64_t most = sent_count < HISTORY ? sent_count : HISTORY;
  struct sent frame = history[(sent_count - 1 - draw((uint32_t)most)) % HISTORY];
  uint8_t session = host.board.session;
  struct arm arm = {PROTOCOL_HASH, BOOT_ID, session, (1 << CHANNELS_USED) - 1, P_FULL};
  uint32_t times = 1 + draw(3);
  struct sent late, early;
  switch (draw(4)) {
    case 0: /* an earlier one of this session, or the last one */
      break;
    case 1: /* of another session, with the sequence number that this session expects */
      frame = next_set((uint8_t)(1 + draw(PROTOCOL_SEQUENCE_WINDOW)));
      session = (uint8_t)(session - 1 - draw(255));
      break;
    case 2: /* two in the wrong order: the first is accepted, the other is late */
      late = next_set(1);
      early = next_set(2);
      send_good(&early);
      watched_send(&host, MESSAGE_SET, late.seq, session, &late.set, sizeof late.set);
      wrong += !is_applied(&early);
      return;
    default: /* the ARM of this session */
      watched_send(&host, MESSAGE_ARM, frame.seq, session, &arm, sizeof arm);
      times = 0;
  }
  while (times--) {
    watched_send(&host, MESSAGE_SET, frame.seq, session, &frame.set, sizeof frame.set);
  }
  wrong += host.board.state != before.state || host.board.session != before.session ||
           host.board.last_seq != before.last_seq || host.board.set_tick != before.set_tick ||
           host.board.last_valid_ms != before.last_valid_ms ||
           memcmp(host.board.set_points, before.set_points, sizeof before.set_points);
}

static void pass(void) {
  watched_pass(&host, 1);
  watched_follow(&host, true);
}

/* The host stops sending: the board must vent by itself. */
static void silence(void) {
  uint32_t since_ms = host.board.last_valid_ms;
  silences++;
  for (uint32_t ms = 0; ms < SILENCE_MS || !output_is_vented(&host.board.output); ms++) {
    pass();
  }
  if (host.board.faults != FAULT_LINK_TIMEOUT) {
    wrong++;
  }
  if (host.now_ms - since_ms > latest_vent_ms) {
    latest_vent_ms = host.now_ms - since_ms;
  }
}

static void run(enum kind kind, uint64_t tries) {
  watched_begin(&host, 0);
  for (uint64_t done = 0; done < tries; done++) {
    struct sent good;
    if (done % SESSION == 0 || host.board.state != STATE_RUNNING) {
      watched_run(&host, P_MIN);
      sent_count = 0;
      good = next_set(1);
      send_good(&good);
    }
    if (kind == REPEAT) {
      try_repeated();
    } else {
      try_corrupted(kind);
    }
    if (kind == TRUNCATE && done % SILENCE_EVERY == SILENCE_EVERY - 1) {
      silence();
      continue;
    }
    good = next_set(1);
    send_good(&good);
    pass();
    if (done % 4 == 0) { /* the host reads too rarely, so that the queue is full at times */
      while (supervisor_next_byte(&host.board) >= 0) {
      }
    }
  }
}

int main(int argc, char **argv) {
  uint64_t tries = argc > 2 ? strtoull(argv[2], NULL, 10) : 0;
  enum kind kind = 0;
  while (kind < KINDS && (argc < 2 || strcmp(argv[1], names[kind]))) {
    kind++;
  }
  if (kind == KINDS || tries == 0) {
    fprintf(stderr, "usage: corrupt flip|drop|insert|truncate|garbage|repeat TRIES [SEED]\n");
    return 2;
  }
  random_state = (argc > 3 ? strtoull(argv[3], NULL, 10) : 1) * 2654435761u + 88172645463325252u;
  run(kind, tries);
  printf(
      "{\"kind\":\"%s\",\"tries\":%llu,\"whole\":%llu,\"wrong\":%llu,\"lost\":%llu,\"silences\":%llu,"
      "\"latest_vent_ms\":%u}\n",
      names[kind], (unsigned long long)tries, (unsigned long long)whole, (unsigned long long)wrong,
      (unsigned long long)lost, (unsigned long long)silences, (unsigned)latest_vent_ms);
  return wrong || lost;
}
