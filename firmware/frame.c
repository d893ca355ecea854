#include "frame.h"

#include <string.h>

uint32_t frame_crc32(const uint8_t *data, uint8_t length) {
  /* Four bits at a time: sixteen entries are a fair price on a chip with 8 KiB of memory. */
  static const uint32_t table[16] = {
      0x00000000UL, 0x1db71064UL, 0x3b6e20c8UL, 0x26d930acUL, 0x76dc4190UL, 0x6b6b51f4UL, 0x4db26158UL, 0x5005713cUL,
      0xedb88320UL, 0xf00f9344UL, 0xd6d6a3e8UL, 0xcb61b38cUL, 0x9b64c2b0UL, 0x86d3d2d4UL, 0xa00ae278UL, 0xbdbdf21cUL,
  };
  uint32_t crc = 0xffffffffUL;
  while (length--) {
    crc ^= *data++;
    crc = (crc >> 4) ^ table[crc & 15];
    crc = (crc >> 4) ^ table[crc & 15];
  }
  return ~crc;
}

static void append(struct frame_parser *parser, uint8_t byte) {
  if (parser->length < PROTOCOL_MAX_DECODED) {
    parser->decoded[parser->length++] = byte;
  } else {
    parser->broken = 1;
  }
}

static enum frame_event finish(struct frame_parser *parser, struct frame *frame) {
  enum frame_event event = FRAME_NONE;
  if (parser->started) {
    event = FRAME_BAD;
    if (!parser->broken && parser->remaining == 0 &&
        parser->length >= PROTOCOL_HEADER_LENGTH + PROTOCOL_CRC_LENGTH) {
      uint8_t body = (uint8_t)(parser->length - PROTOCOL_CRC_LENGTH);
      uint32_t crc;
      memcpy(&crc, parser->decoded + body, sizeof crc);
      if (crc == frame_crc32(parser->decoded, body)) {
        frame->type = parser->decoded[0];
        frame->seq = parser->decoded[1];
        frame->session = parser->decoded[2];
        frame->length = (uint8_t)(body - PROTOCOL_HEADER_LENGTH);
        frame->payload = parser->decoded + PROTOCOL_HEADER_LENGTH;
        event = FRAME_GOOD;
      }
    }
  }
  parser->length = 0;
  parser->remaining = 0;
  parser->zero_pending = 0;
  parser->started = 0;
  parser->broken = 0;
  return event;
}

enum frame_event frame_receive(struct frame_parser *parser, uint8_t byte, struct frame *frame) {
  if (byte == PROTOCOL_DELIMITER) {
    return finish(parser, frame);
  }
  parser->started = 1;
  if (parser->broken) {
    return FRAME_NONE;
  }
  if (parser->remaining > 0) {
    append(parser, byte);
    parser->remaining--;
    return FRAME_NONE;
  }
  /* A code byte: a run of byte - 1 follows. Runs of 254, which no zero ends, are longer than any frame. */
  if (parser->zero_pending) {
    append(parser, 0);
  }
  parser->remaining = (uint8_t)(byte - 1);
  parser->zero_pending = 1;
  return FRAME_NONE;
}

/* One COBS code byte in the making. */
struct stuffing {
  uint8_t *code;
  uint8_t *next;
};

static void stuff(struct stuffing *out, const uint8_t *data, uint8_t length) {
  while (length--) {
    uint8_t byte = *data++;
    if (byte == 0) {
      *out->code = (uint8_t)(out->next - out->code);
      out->code = out->next++;
    } else {
      *out->next++ = byte;
    }
  }
}

uint8_t frame_encode(uint8_t *encoded, uint8_t type, uint8_t seq, uint8_t session, const void *payload,
                     uint8_t length) {
  uint8_t body[PROTOCOL_MAX_DECODED];
  struct stuffing out = {encoded + 1, encoded + 2};
  uint8_t size = (uint8_t)(PROTOCOL_HEADER_LENGTH + length);
  uint32_t crc;

  body[0] = type;
  body[1] = seq;
  body[2] = session;
  memcpy(body + PROTOCOL_HEADER_LENGTH, payload, length);
  crc = frame_crc32(body, size);
  memcpy(body + size, &crc, sizeof crc);
  encoded[0] = PROTOCOL_DELIMITER;
  stuff(&out, body, (uint8_t)(size + PROTOCOL_CRC_LENGTH));
  *out.code = (uint8_t)(out.next - out.code);
  *out.next++ = PROTOCOL_DELIMITER;
  return (uint8_t)(out.next - encoded);
}
