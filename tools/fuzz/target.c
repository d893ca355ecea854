/* One input of the fuzzer: a sequence of steps from power-on. Every step goes through watched.h, which aborts if a rule
 * is violated; so does an invalid frame from the board.
 *
 * A step begins with a byte: its low three bits select the step, the others are its amount or index.
 *   0  this many raw bytes arrive
 *   1  a frame arrives: flags, then its payload (corrected according to the flags: a fuzzer cannot guess a hash)
 *   2  a stall of the loop: one byte, in ms
 *   3  this many passes of 1 ms, the sensors follow the outputs
 *   4  a sensor reads: two bytes
 *   5  this many passes of 5 ms, the sensors stay as they are
 *   6  a correct host starts a session, which must succeed from any state
 *   7  the host reads */
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "limits.h"
#include "pins.h"
#include "watched.h"

enum flag { CORRECT_SESSION = 1, CORRECT_SEQUENCE = 2, CORRECT_CONTENT = 4, ONE_BIT_WRONG = 8 };

static const uint8_t types[] = {MESSAGE_SET,  MESSAGE_HEARTBEAT,   MESSAGE_ARM,    MESSAGE_HELLO_REQ,
                                MESSAGE_VENT, MESSAGE_CLEAR_FAULT, MESSAGE_STATUS, 0};

struct input {
  const uint8_t *next, *end;
};

static uint8_t take(struct input *input) { return input->next < input->end ? *input->next++ : 0; }

static void take_into(struct input *input, void *to, uint8_t length) {
  for (uint8_t i = 0; i < length; i++) {
    ((uint8_t *)to)[i] = take(input);
  }
}

/* Corrects the fields that the board would refuse. */
static void correct_payload(const struct supervisor *board, uint8_t type, uint8_t *payload) {
  struct set *set = (struct set *)payload;
  struct arm *arm = (struct arm *)payload;
  switch (type) {
    case MESSAGE_SET:
      set->tick = board->set_tick + (set->tick & 3);
      for (uint8_t channel = 0; channel < PROTOCOL_CHANNELS; channel++) {
        uint16_t pressure = (uint16_t)set->pressures[channel] % (P_MAX + 1);
        set->pressures[channel] = board->channels >> channel & 1 ? (int16_t)pressure : 0;
      }
      break;
    case MESSAGE_HEARTBEAT:
      ((struct heartbeat *)payload)->tick = board->tick + (payload[0] & 1);
      break;
    case MESSAGE_ARM:
      *arm = (struct arm){PROTOCOL_HASH, BOOT_ID, (uint8_t)(board->session == 255 ? 1 : board->session + 1),
                          arm->channels & ((1 << CHANNELS_USED) - 1), P_FULL};
      break;
    case MESSAGE_HELLO_REQ:
      ((struct hello_req *)payload)->protocol_hash = PROTOCOL_HASH;
      break;
    case MESSAGE_CLEAR_FAULT:
      ((struct clear_fault *)payload)->mask = board->faults;
      break;
  }
}

static void frame(struct watched *w, struct input *input, uint8_t which) {
  uint8_t flags = take(input), type = types[which % sizeof types];
  int16_t expected = protocol_payload_length(type);
  uint8_t length = (uint8_t)(expected < 0 ? which : expected);
  uint8_t payload[32], bytes[FRAME_MAX_ENCODED], count;
  uint8_t seq = (uint8_t)(w->board.last_seq + 1 + (flags >> 4)), session = w->board.session;
  take_into(input, payload, sizeof payload < length ? sizeof payload : length);
  seq = flags & CORRECT_SEQUENCE ? seq : take(input);
  session = flags & CORRECT_SESSION ? session : take(input);
  if (flags & CORRECT_CONTENT) {
    correct_payload(&w->board, type, payload);
  }
  count = frame_encode(bytes, type, seq, session, payload, length);
  if (flags & ONE_BIT_WRONG) {
    uint8_t at = take(input);
    bytes[at % count] ^= (uint8_t)(1 << (at & 7));
  }
  for (uint8_t i = 0; i < count; i++) {
    watched_receive(w, bytes[i]);
  }
}

static void drain(struct watched *w, struct frame_parser *host) {
  struct frame seen;
  int16_t byte;
  while ((byte = supervisor_next_byte(&w->board)) >= 0) {
    if (byte != PROTOCOL_DELIMITER) {
      frame_take(host, (uint8_t)byte);
    } else if (frame_end(host, &seen) == FRAME_BAD) {
      fprintf(stderr, "the board sent an invalid frame\n");
      abort();
    }
  }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  static struct watched w;
  struct frame_parser host = {0};
  struct input input = {data, data + size};
  watched_begin(&w, take(&input));
  while (input.next < input.end) {
    uint8_t step = take(&input), amount = step >> 3;
    switch (step & 7) {
      case 0:
        for (uint8_t i = 0; i <= amount; i++) {
          watched_receive(&w, take(&input));
        }
        break;
      case 1:
        frame(&w, &input, amount);
        break;
      case 2:
        watched_pass(&w, take(&input));
        break;
      case 3:
        for (uint8_t i = 0; i <= amount; i++) {
          watched_pass(&w, 1);
          watched_follow(&w, true);
        }
        break;
      case 4:
        take_into(&input, &w.measured[amount % PROTOCOL_CHANNELS], sizeof w.measured[0]);
        w.measured[amount % PROTOCOL_CHANNELS] %= SENSOR_FULL + 1;
        break;
      case 5:
        for (uint8_t i = 0; i <= amount; i++) {
          watched_pass(&w, 5);
        }
        break;
      case 6:
        watched_run(&w, (int16_t)(amount * 100));
        break;
      default:
        drain(&w, &host);
    }
  }
  return 0;
}
