/* What the tests need beside the firmware's own interface: memory for a board, looks inside, and fuzzing in loops that
 * are too long for Python. */
#include <stdlib.h>
#include <string.h>

#include "controller.h"

struct controller *board_new(uint32_t boot_id, uint8_t reset_cause, uint32_t now_ms) {
  struct controller *c = malloc(sizeof *c);
  if (c) {
    memset(c, 0xa5, sizeof *c); /* as memory is after power-on */
    controller_init(c, boot_id, reset_cause, now_ms);
  }
  return c;
}

void board_free(struct controller *c) { free(c); }

void board_feed(struct controller *c, const uint8_t *bytes, uint32_t count, uint32_t now_ms) {
  for (uint32_t i = 0; i < count; i++) {
    controller_receive(c, bytes[i], now_ms);
  }
}

uint32_t board_drain(struct controller *c, uint8_t *bytes, uint32_t size) {
  uint32_t count = 0;
  int16_t next;
  while (count < size && (next = controller_next_byte(c)) >= 0) {
    bytes[count++] = (uint8_t)next;
  }
  return count;
}

uint8_t board_state(const struct controller *c) { return c->state; }
uint16_t board_faults(const struct controller *c) { return c->faults; }
int16_t board_applied(const struct controller *c, uint8_t channel) { return c->output.applied[channel]; }
int16_t board_set_point(const struct controller *c, uint8_t channel) { return c->set_points[channel]; }
uint16_t board_rx_bad(const struct controller *c) { return c->rx_bad; }

static uint64_t rng;

static uint32_t draw(uint32_t below) {
  rng ^= rng << 13;
  rng ^= rng >> 7;
  rng ^= rng << 17;
  return (uint32_t)((rng >> 16) % below);
}

enum damage { FLIP_BITS, DROP_BYTES, INSERT_BYTES, TRUNCATE, GARBAGE };

static uint32_t damage_frame(uint8_t *bytes, uint32_t count, uint32_t kind) {
  uint32_t times = 1 + draw(4);
  switch (kind) {
    case FLIP_BITS:
      while (times--) {
        bytes[draw(count)] ^= (uint8_t)(1u << draw(8));
      }
      return count;
    case DROP_BYTES:
      while (times-- && count > 1) {
        uint32_t at = draw(count);
        memmove(bytes + at, bytes + at + 1, count - at - 1);
        count--;
      }
      return count;
    case INSERT_BYTES:
      while (times--) {
        uint32_t at = draw(count + 1);
        memmove(bytes + at + 1, bytes + at, count - at);
        bytes[at] = (uint8_t)draw(256);
        count++;
      }
      return count;
    case TRUNCATE:
      return draw(count);
    default:
      for (uint32_t i = 0; i < count; i++) {
        bytes[i] = (uint8_t)draw(256);
      }
      return count;
  }
}

struct fuzz_result {
  uint32_t sent;       /* damaged frames */
  uint32_t wrong;      /* accepted although no such frame was sent */
  uint32_t unchanged;  /* accepted and equal to what was sent: the damage missed it (a delimiter) */
  uint32_t lost_after; /* good frames that were not accepted after a damaged one and a delimiter */
};

/* Damages `frames` random SET frames in one way and feeds them to a parser, each followed by a good one. */
void fuzz_parser(uint64_t seed, uint32_t kind, uint32_t frames, struct fuzz_result *result) {
  struct frame_parser parser;
  struct frame seen;
  struct set payload, good;
  uint8_t bytes[FRAME_MAX_ENCODED + 8], clean[FRAME_MAX_ENCODED];
  memset(&parser, 0, sizeof parser);
  memset(result, 0, sizeof *result);
  memset(&good, 0, sizeof good);
  rng = seed * 2654435761u + 88172645463325252u;
  for (uint32_t i = 0; i < frames; i++) {
    uint8_t seq = (uint8_t)i;
    uint32_t count, accepted = 0;
    payload.tick = i;
    for (int channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
      payload.pressures[channel] = (int16_t)draw(3501);
    }
    count = frame_encode(bytes, MESSAGE_SET, seq, 7, &payload, sizeof payload);
    count = damage_frame(bytes, count, kind);
    result->sent++;
    for (uint32_t b = 0; b < count; b++) {
      if (frame_receive(&parser, bytes[b], &seen) == FRAME_GOOD) {
        int same = seen.type == MESSAGE_SET && seen.seq == seq && seen.session == 7 &&
                   seen.length == sizeof payload && memcmp(seen.payload, &payload, sizeof payload) == 0;
        result->unchanged += (uint32_t)same;
        result->wrong += (uint32_t)!same;
      }
    }
    good.tick = i;
    count = frame_encode(clean, MESSAGE_SET, (uint8_t)~seq, 9, &good, sizeof good);
    for (uint32_t b = 0; b < count; b++) {
      if (frame_receive(&parser, clean[b], &seen) == FRAME_GOOD) {
        if (seen.session == 9 && memcmp(seen.payload, &good, sizeof good) == 0) {
          accepted = 1;
        } else {
          int same = seen.session == 7 && memcmp(seen.payload, &payload, sizeof payload) == 0;
          result->unchanged += (uint32_t)same; /* only the closing delimiter was hit, ours closed it */
          result->wrong += (uint32_t)!same;
        }
      }
    }
    result->lost_after += !accepted;
  }
}

/* The same against a running board: counts set-points that were never sent. Time stands still, so nothing times out. */
void fuzz_board(struct controller *c, uint64_t seed, uint32_t kind, uint32_t frames, struct fuzz_result *result) {
  uint8_t bytes[FRAME_MAX_ENCODED + 8], sink[512];
  int16_t before[PROTOCOL_CHANNELS];
  struct set payload;
  memset(result, 0, sizeof *result);
  rng = seed * 2654435761u + 88172645463325252u;
  for (uint32_t i = 0; i < frames; i++) {
    uint32_t count;
    payload.tick = c->set_tick + 1;
    for (int channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
      payload.pressures[channel] = (int16_t)(((c->channels >> channel) & 1) ? draw(3501) : 0);
    }
    memcpy(before, c->set_points, sizeof before);
    count = frame_encode(bytes, MESSAGE_SET, (uint8_t)(c->last_seq + 1), c->session, &payload, sizeof payload);
    count = damage_frame(bytes, count, kind);
    board_feed(c, bytes, count, c->now_ms);
    controller_receive(c, PROTOCOL_DELIMITER, c->now_ms);
    board_drain(c, sink, sizeof sink);
    result->sent++;
    if (memcmp(c->set_points, before, sizeof before) != 0) {
      int same = memcmp(c->set_points, payload.pressures, sizeof before) == 0;
      result->unchanged += (uint32_t)same;
      result->wrong += (uint32_t)!same;
    }
    if (c->state != STATE_RUNNING) {
      result->lost_after++;
    }
  }
}
