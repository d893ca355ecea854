/* Frames on the wire: 0x00 | COBS(type, seq, session, payload, crc32) | 0x00. The supervisor reads the payloads. */
#ifndef FRAME_H
#define FRAME_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

struct frame {
  uint8_t type;
  uint8_t seq;
  uint8_t session;
  uint8_t length;         /* of the payload */
  const uint8_t *payload; /* valid until the next byte is received */
};

enum frame_event { FRAME_NONE, FRAME_GOOD, FRAME_BAD };

/* Decodes byte by byte; zeroed memory is a valid start. */
struct frame_parser {
  uint8_t length;    /* decoded so far */
  uint8_t remaining; /* bytes of the current COBS run still to come */
  bool zero_pending; /* the last run ends in a zero, unless the frame ends first */
  bool started;      /* a byte arrived since the last delimiter */
  bool broken;       /* too long: dropped until the next delimiter */
  uint8_t decoded[PROTOCOL_MAX_DECODED];
};

/* Takes a byte that is not the delimiter. */
void frame_take(struct frame_parser *parser, uint8_t byte);

/* Takes the delimiter. FRAME_GOOD: *frame is set. FRAME_BAD: the bytes before it are no valid frame. */
enum frame_event frame_end(struct frame_parser *parser, struct frame *frame);

/* Length of an encoded frame: both delimiters, one COBS code byte (254 bytes and more would need a second one), header,
 * payload and CRC. */
#define FRAME_ENCODED_LENGTH(length) ((length) + PROTOCOL_HEADER_LENGTH + PROTOCOL_CRC_LENGTH + 3)
#define FRAME_MAX_ENCODED (PROTOCOL_MAX_ENCODED + 2)

/* Writes a whole frame with its delimiters, returns its length. The payload must fit PROTOCOL_MAX_DECODED. */
uint8_t frame_encode(uint8_t *encoded, uint8_t type, uint8_t seq, uint8_t session, const void *payload, uint8_t length);

/* CRC-32 as zlib computes it. */
uint32_t frame_crc32(const uint8_t *data, uint8_t length);

#ifdef __cplusplus
}
#endif
#endif
