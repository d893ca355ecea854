#include "frame.h"

#include <string.h>

#ifdef __AVR__
#define IN_FLASH __flash /* the chip has 256 KiB of flash and 8 KiB of RAM */
#else
#define IN_FLASH
#endif

/* The CRC is linear: the entry of a byte is the exclusive or of the entries of its bits, so eight define the table. */
#define BIT(byte, bit, effect) ((byte) >> (bit) & 1 ? effect : 0)
#define ENTRY(byte)                                                                                                    \
  (BIT(byte, 0, 0x77073096UL) ^ BIT(byte, 1, 0xee0e612cUL) ^ BIT(byte, 2, 0x076dc419UL) ^ BIT(byte, 3, 0x0edb8832UL) ^ \
   BIT(byte, 4, 0x1db71064UL) ^ BIT(byte, 5, 0x3b6e20c8UL) ^ BIT(byte, 6, 0x76dc4190UL) ^ BIT(byte, 7, 0xedb88320UL))
#define FOUR(n) ENTRY(n), ENTRY((n) + 1), ENTRY((n) + 2), ENTRY((n) + 3)
#define SIXTEEN(n) FOUR(n), FOUR((n) + 4), FOUR((n) + 8), FOUR((n) + 12)
#define SIXTY_FOUR(n) SIXTEEN(n), SIXTEEN((n) + 16), SIXTEEN((n) + 32), SIXTEEN((n) + 48)

uint32_t frame_crc32(const uint8_t *data, uint8_t length) {
  static const IN_FLASH uint32_t table[256] = {SIXTY_FOUR(0), SIXTY_FOUR(64), SIXTY_FOUR(128), SIXTY_FOUR(192)};
  uint32_t crc = 0xffffffffUL;
  while (length--) {
    crc = (crc >> 8) ^ table[(uint8_t)crc ^ *data++];
  }
  return ~crc;
}

static void append(struct frame_parser *parser, uint8_t byte) {
  if (parser->length < PROTOCOL_MAX_DECODED) {
    parser->decoded[parser->length++] = byte;
  } else {
    parser->broken = true;
  }
}

void frame_take(struct frame_parser *parser, uint8_t byte) {
  parser->started = true;
  if (parser->remaining > 0) {
    append(parser, byte);
    parser->remaining--;
    return;
  }
  /* A code byte: a run of byte - 1 bytes follows. Runs of 254, which end without a zero, are longer than any frame. */
  if (parser->zero_pending) {
    append(parser, 0);
  }
  parser->remaining = (uint8_t)(byte - 1);
  parser->zero_pending = true;
}

enum frame_event frame_end(struct frame_parser *parser, struct frame *frame) {
  enum frame_event event = parser->started ? FRAME_BAD : FRAME_NONE;
  if (!parser->broken && parser->remaining == 0 && parser->length >= PROTOCOL_HEADER_LENGTH + PROTOCOL_CRC_LENGTH) {
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
  parser->length = 0;
  parser->remaining = 0;
  parser->zero_pending = false;
  parser->started = false;
  parser->broken = false;
  return event;
}

uint8_t frame_encode(uint8_t *encoded, uint8_t type, uint8_t seq, uint8_t session, const void *payload,
                     uint8_t length) {
  /* Encoded in place: a COBS code byte replaces the zero before its run. */
  uint8_t *body = encoded + 2;
  uint8_t size = (uint8_t)(PROTOCOL_HEADER_LENGTH + length);
  uint8_t *code = encoded + 1;
  uint8_t *end = body + size + PROTOCOL_CRC_LENGTH;
  uint32_t crc;

  encoded[0] = PROTOCOL_DELIMITER;
  body[0] = type;
  body[1] = seq;
  body[2] = session;
  memcpy(body + PROTOCOL_HEADER_LENGTH, payload, length);
  crc = frame_crc32(body, size);
  memcpy(body + size, &crc, sizeof crc);
  for (uint8_t *byte = body; byte != end; byte++) {
    if (*byte == 0) {
      *code = (uint8_t)(byte - code);
      code = byte;
    }
  }
  *code = (uint8_t)(end - code);
  *end++ = PROTOCOL_DELIMITER;
  return (uint8_t)(end - encoded);
}
