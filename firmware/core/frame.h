/* Frames on the wire: COBS, ended by a zero byte, with id, sequence, body, CRC-16/CCITT-FALSE (big endian). */
#ifndef HEAD_FRAME_H
#define HEAD_FRAME_H

#include <stdint.h>

#include "protocol.h"

#define FRAME_HEADER 2
#define FRAME_CRC 2
#define FRAME_OVERHEAD (FRAME_HEADER + FRAME_CRC)
#define FRAME_MAX (MAX_BODY + FRAME_OVERHEAD)
/* COBS adds one byte to up to 254; plus the zero at the end. */
#define FRAME_LINE (FRAME_MAX + 2)

enum { FRAME_MALFORMED = -1, FRAME_BAD_CRC = -2 };

uint16_t frame_crc(const uint8_t *bytes, uint8_t length);

/* Encode a frame, whose id, sequence and body are in `frame` (with room for the CRC), to `line` (FRAME_LINE bytes).
 * Returns the length of `line`. */
uint8_t frame_encode(uint8_t *line, uint8_t *frame, uint8_t body_length);

/* Decode in place the bytes between two zeros; then id, sequence and body are at the beginning.
 * Returns the length of the body, or one of the errors. */
int8_t frame_decode(uint8_t *bytes, uint8_t length);

#endif
