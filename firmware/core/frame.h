/* Frames on the line: COBS, closed by a zero byte; inside id, sequence, body, CRC-16/CCITT-FALSE (big end first). */
#ifndef HEAD_FRAME_H
#define HEAD_FRAME_H

#include <stdint.h>

#include "protocol.h"

#define FRAME_HEADER 2
#define FRAME_CRC 2
#define FRAME_OVERHEAD (FRAME_HEADER + FRAME_CRC)
#define FRAME_MAX (MAX_BODY + FRAME_OVERHEAD)
/* COBS adds one byte to fewer than 255; with the zero at the end. */
#define FRAME_LINE (FRAME_MAX + 2)

enum { FRAME_MALFORMED = -1, FRAME_BAD_CRC = -2 };

uint16_t frame_crc(const uint8_t *bytes, uint8_t length);

/* Make `line` (FRAME_LINE bytes) of a frame whose id, sequence and body are in `frame`, which has room for the CRC.
 * Returns the length of the line. */
uint8_t frame_encode(uint8_t *line, uint8_t *frame, uint8_t body_length);

/* Decode in place what came between two zero bytes; id, sequence and body are at the beginning then.
 * Returns the length of the body, or one of the errors. */
int8_t frame_decode(uint8_t *bytes, uint8_t length);

#endif
