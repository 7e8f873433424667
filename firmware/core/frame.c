#include "frame.h"

uint16_t frame_crc(const uint8_t *bytes, uint8_t length) {
    uint16_t crc = 0xFFFF;
    while (length--) {
        /* One byte of the polynomial 0x1021 without a table: x is the upper byte of the CRC ^ the byte, folded. */
        uint8_t x = (uint8_t)(crc >> 8 ^ *bytes++);
        x = (uint8_t)(x ^ x >> 4);
        crc = (uint16_t)(crc << 8 ^ (uint16_t)x << 12 ^ (uint16_t)x << 5 ^ x);
    }
    return crc;
}

uint8_t frame_encode(uint8_t *encoded, uint8_t *frame, uint8_t body_length) {
    uint8_t length = (uint8_t)(body_length + FRAME_HEADER);
    uint16_t crc = frame_crc(frame, length);
    frame[length++] = (uint8_t)(crc >> 8);
    frame[length++] = (uint8_t)crc;

    uint8_t *code = encoded, *out = encoded + 1;
    uint8_t run = 1;
    while (length--) {
        uint8_t byte = *frame++;
        if (byte) {
            *out++ = byte;
            run++;
        } else {
            *code = run;
            code = out++;
            run = 1;
        }
    }
    *code = run;
    *out++ = 0;
    return (uint8_t)(out - encoded);
}

int8_t frame_decode(uint8_t *bytes, uint8_t length) {
    uint8_t in = 0, out = 0;
    if (length > FRAME_ENCODED - 1) {
        return FRAME_MALFORMED;
    }
    while (in < length) {
        uint8_t run = bytes[in++];
        if (run == 0 || run - 1 > length - in) {
            return FRAME_MALFORMED;
        }
        while (--run) {
            if (bytes[in] == 0) {
                return FRAME_MALFORMED;
            }
            bytes[out++] = bytes[in++];
        }
        if (in < length) {
            bytes[out++] = 0;
        }
    }
    if (out < FRAME_OVERHEAD) {
        return FRAME_MALFORMED;
    }
    out = (uint8_t)(out - FRAME_CRC);
    if (frame_crc(bytes, out) != (uint16_t)(bytes[out] << 8 | bytes[out + 1])) {
        return FRAME_BAD_CRC;
    }
    return (int8_t)(out - FRAME_HEADER);
}
