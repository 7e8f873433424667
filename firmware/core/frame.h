/* Frames on the wire: COBS, ended by a zero byte, with id, sequence, body, CRC-16/CCITT-FALSE (big endian). */
#ifndef HEAD_FRAME_H
#define HEAD_FRAME_H

#include <stdint.h>

#include "protocol.h"

#define FRAME_HEADER 2
#define FRAME_CRC 2
#define FRAME_OVERHEAD (FRAME_HEADER + FRAME_CRC)
#define FRAME_MAX (MAX_BODY + FRAME_OVERHEAD)
/* COBS adds one byte to a frame of up to 254, and a zero ends it. */
#define FRAME_ENCODED (FRAME_MAX + 2)

enum { FRAME_MALFORMED = -1, FRAME_BAD_CRC = -2 };

uint16_t frame_crc(const uint8_t *bytes, uint8_t length);

/* Encode a frame, whose id, sequence and body are in `frame` (with room for the CRC), to `encoded` (FRAME_ENCODED bytes).
 * Returns the length of the encoded frame. */
uint8_t frame_encode(uint8_t *encoded, uint8_t *frame, uint8_t body_length);

/* Decode the bytes between two zeros in place: id, sequence and body are then at the beginning.
 * Returns the length of the body, or one of the errors. */
int8_t frame_decode(uint8_t *bytes, uint8_t length);

#endif
