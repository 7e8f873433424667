/* Unit tests of the core on this computer, under sanitizers: `make test`. More tests of the behaviour are in ../tests,
   in Python. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../boards/host/board.h"
#include "../core/frame.h"
#include "../hal/hal.h"

static unsigned checks;

#define CHECK(truth)                                                                                                   \
    do {                                                                                                               \
        checks++;                                                                                                      \
        if (!(truth)) {                                                                                                \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #truth);                                                \
            exit(1);                                                                                                   \
        }                                                                                                              \
    } while (0)

static uint32_t seed = 1;

static uint8_t random_byte(void) {
    seed = seed * 1664525U + 1013904223U;
    return (uint8_t)(seed >> 24);
}

/* -- frames -------------------------------------------------------------------------------------------------------- */

static void test_crc_is_ccitt_false(void) {
    CHECK(frame_crc((const uint8_t *)"123456789", 9) == 0x29B1);
}

static void test_every_frame_comes_back(void) {
    for (int round = 0; round < 20000; round++) {
        uint8_t frame[FRAME_MAX], sent[FRAME_MAX], encoded[FRAME_ENCODED];
        uint8_t body = (uint8_t)(random_byte() % (MAX_BODY + 1));
        for (uint8_t i = 0; i < body + FRAME_HEADER; i++) {
            frame[i] = sent[i] = random_byte() % 3 ? random_byte() : 0;
        }
        uint8_t length = frame_encode(encoded, frame, body);
        CHECK(length == body + FRAME_OVERHEAD + 2);
        CHECK(strlen((const char *)encoded) == (size_t)length - 1);
        CHECK(frame_decode(encoded, (uint8_t)(length - 1)) == body);
        CHECK(!memcmp(encoded, sent, body + FRAME_HEADER));
    }
}

static void test_garbage_stays_within_its_bytes(void) {
    for (int round = 0; round < 200000; round++) {
        uint8_t length = (uint8_t)(random_byte() % (FRAME_ENCODED + 8));
        uint8_t *encoded = malloc(length ? length : 1); /* the exact length: the sanitizer detects a byte beyond it */
        for (uint8_t i = 0; i < length; i++) {
            encoded[i] = random_byte() % 4 ? (uint8_t)(random_byte() % 6) : random_byte();
        }
        int8_t body = frame_decode(encoded, length);
        CHECK(body <= MAX_BODY);
        free(encoded);
    }
}

/* -- a board without a sensor -------------------------------------------------------------------------------------- */

static int32_t no_device(uint64_t ns, int32_t operation, uint8_t *data, int32_t length) {
    (void)ns;
    (void)operation;
    (void)data;
    (void)length;
    return 0;
}

static uint64_t never(uint64_t ns) {
    (void)ns;
    return BOARD_NEVER;
}

static struct board *board;
static uint64_t now_ns;
static uint8_t sequence;
static int relay, light;
static uint64_t relay_ns, light_ns;
static uint8_t answer[FRAME_ENCODED], event[FRAME_ENCODED];

static void run_ms(uint64_t ms) {
    static uint8_t encoded[FRAME_ENCODED];
    static uint8_t length;
    struct board_output outputs[64];
    uint32_t count;
    board_run(board, now_ns += ms * 1000000);
    while ((count = board_take(board, outputs, 64))) {
        for (uint32_t i = 0; i < count; i++) {
            switch (outputs[i].event) {
            case BOARD_LIGHT:
                light = outputs[i].value;
                light_ns = outputs[i].ns;
                break;
            case BOARD_RELAY:
                relay = outputs[i].value;
                relay_ns = outputs[i].ns;
                break;
            case BOARD_BYTE:
                if (outputs[i].value) {
                    encoded[length++] = (uint8_t)outputs[i].value;
                    break;
                }
                if (!length) {
                    break; /* the zero that ends a frame that the reset interrupted */
                }
                CHECK(frame_decode(encoded, length) >= 0);
                memcpy(encoded[0] >= MESSAGE_SAMPLE ? event : answer, encoded, sizeof encoded);
                length = 0;
                break;
            default:
                break;
            }
        }
    }
}

static void send(uint8_t id, const void *body, uint8_t length, uint8_t number) {
    uint8_t frame[FRAME_MAX] = {id, number}, encoded[FRAME_ENCODED];
    memcpy(frame + FRAME_HEADER, body, length);
    length = frame_encode(encoded, frame, length);
    for (uint8_t i = 0; i < length; i++) {
        board_receive(board, now_ns + (i + 1) * 40000U, encoded[i]);
    }
    run_ms(4);
}

/* Send a request and return its rejection. */
static uint8_t ask(uint8_t id, const void *body, uint8_t length) {
    send(id, body, length, ++sequence);
    CHECK(answer[1] == sequence);
    return answer[0] == MESSAGE_DONE ? answer[FRAME_HEADER + 1] : REJECTION_NONE;
}

static uint8_t beat(uint16_t deadman_ms) {
    uint8_t body[SIZE_HEARTBEAT] = {(uint8_t)deadman_ms, (uint8_t)(deadman_ms >> 8)};
    return ask(MESSAGE_HEARTBEAT, body, sizeof body);
}

static uint8_t ask_u8(uint8_t id, uint8_t value) {
    return ask(id, &value, 1);
}

static void power_up_with(int32_t (*device)(uint64_t, int32_t, uint8_t *, int32_t)) {
    now_ns = 0;
    relay = light = 0;
    board = board_open((struct board_outside){device, never}, NULL, 0, 7);
    run_ms(5);
    CHECK(event[0] == MESSAGE_STATUS_CHANGED && event[FRAME_HEADER + 9] == RESET_POWER_ON);
}

static void power_up(void) {
    power_up_with(no_device);
}

static void test_outputs_need_a_heartbeat(void) {
    power_up();
    CHECK(ask_u8(MESSAGE_RELAY, 1) == REJECTION_NOT_ACTIVE);
    CHECK(ask_u8(MESSAGE_LIGHT, 9) == REJECTION_NOT_ACTIVE);
    CHECK(beat(250) == REJECTION_NONE);
    CHECK(ask_u8(MESSAGE_RELAY, 1) == REJECTION_NONE && relay == 1);
    CHECK(ask_u8(MESSAGE_LIGHT, 9) == REJECTION_NONE && light == 9);
    CHECK(ask_u8(MESSAGE_RELAY, 2) == REJECTION_OUT_OF_RANGE);
    CHECK(ask(MESSAGE_SHUTDOWN, "", 0) == REJECTION_NONE);
    CHECK(relay == 0 && light == 0);
    board_close(board);
}

static void test_silence_makes_the_bench_safe(void) {
    power_up();
    CHECK(beat(49) == REJECTION_OUT_OF_RANGE && beat(2001) == REJECTION_OUT_OF_RANGE);
    beat(250);
    uint64_t beaten_ns = now_ns;
    ask_u8(MESSAGE_RELAY, 1);
    ask_u8(MESSAGE_LIGHT, 255);
    run_ms(230);
    CHECK(relay == 1 && light == 255);
    run_ms(20);
    CHECK(relay == 0 && light == 0);
    CHECK(relay_ns - beaten_ns <= 250000000 + TICK_US * 1000 && relay_ns == light_ns);
    CHECK(beat(250) == REJECTION_NONE);
    CHECK(ask_u8(MESSAGE_RELAY, 1) == REJECTION_FAULT_LATCHED);
    CHECK(ask_u8(MESSAGE_ACKNOWLEDGE, HEAD_FAULT_DEADMAN) == REJECTION_NONE);
    CHECK(ask_u8(MESSAGE_RELAY, 1) == REJECTION_NOT_ACTIVE); /* only after a heartbeat */
    beat(250);
    CHECK(ask_u8(MESSAGE_RELAY, 1) == REJECTION_NONE && relay == 1);
    board_close(board);
}

static void test_estop_acts_within_a_millisecond(void) {
    power_up();
    beat(2000);
    ask_u8(MESSAGE_RELAY, 1);
    board_set_estop(board, true);
    uint64_t opened_ns = now_ns;
    run_ms(2);
    CHECK(relay == 0 && relay_ns - opened_ns <= 1000000);
    CHECK(ask_u8(MESSAGE_ACKNOWLEDGE, 0xFF) == REJECTION_CAUSE_PERSISTS);
    board_set_estop(board, false);
    run_ms(2);
    CHECK(relay == 0);
    CHECK(ask_u8(MESSAGE_ACKNOWLEDGE, 0xFF) == REJECTION_NONE);
    for (int i = 0; i < 50; i++) { /* bouncing contacts: never open for a whole millisecond */
        board_set_estop(board, true);
        board_run(board, now_ns += 700000);
        board_set_estop(board, false);
        board_run(board, now_ns += 300000);
    }
    beat(2000);
    CHECK(ask_u8(MESSAGE_RELAY, 1) == REJECTION_NONE);
    board_close(board);
}

static void test_a_repeated_request_is_answered_but_not_done_twice(void) {
    power_up();
    beat(2000);
    uint8_t level = 9;
    send(MESSAGE_LIGHT, &level, 1, 77);
    CHECK(answer[0] == MESSAGE_DONE && light == 9);
    uint8_t first[FRAME_ENCODED];
    memcpy(first, answer, sizeof first);
    level = 5; /* the number tells the repetition */
    send(MESSAGE_LIGHT, &level, 1, 77);
    CHECK(!memcmp(first, answer, FRAME_HEADER + SIZE_DONE) && light == 9);
    board_close(board);
}

static void test_unknown_and_malformed_requests_are_rejected(void) {
    power_up();
    CHECK(ask(0x00, "", 0) == REJECTION_UNKNOWN_REQUEST);
    CHECK(ask(0x7F, "", 0) == REJECTION_UNKNOWN_REQUEST);
    CHECK(ask(MESSAGE_LIGHT, "ab", 2) == REJECTION_MALFORMED);
    board_close(board);
}

static void test_a_program_that_hangs_is_restarted(void) {
    power_up();
    beat(2000);
    ask_u8(MESSAGE_RELAY, 1);
    board_hang(board, true);
    run_ms(130);
    CHECK(relay == 0);
    CHECK(event[0] == MESSAGE_STATUS_CHANGED && event[FRAME_HEADER + 9] == RESET_WATCHDOG);
    CHECK(event[FRAME_HEADER + 5] == HEAD_FAULT_WATCHDOG);
    board_close(board);
}

/* -- a board with a sensor whose FIFO has a fixed count --------------------------------------------------------- */

static uint8_t who_am_i, registers[128], pointer;
static bool pointed;

static int32_t sensor(uint64_t ns, int32_t operation, uint8_t *data, int32_t length) {
    (void)ns;
    if (operation == BOARD_I2C_START_WRITE || operation == BOARD_I2C_START_READ) {
        pointed = operation == BOARD_I2C_START_READ;
        return data[0] == 0x68;
    }
    for (int32_t i = 0; i < length && operation != BOARD_I2C_STOP; i++) {
        if (operation == BOARD_I2C_READ) {
            data[i] = pointer == 0x75 ? who_am_i : registers[pointer];
        } else if (pointed) {
            registers[pointer] = data[i];
        } else {
            pointer = data[i] & 0x7F;
            pointed = true;
            continue;
        }
        pointer = (pointer + 1) & 0x7F;
    }
    return length;
}

/* Run a sensor whose FIFO always has `fifo` bytes; returns its status, and the number of overflows in `*overflows`. */
static uint8_t run_sensor(uint8_t identity, uint16_t fifo, uint16_t *overflows) {
    static const uint8_t setup[SIZE_SET_IMU] = {IMU_MODEL_MPU6050, 0x68, 4, 3, 0};
    memset(registers, 0, sizeof registers);
    who_am_i = identity;
    registers[0x72] = (uint8_t)(fifo >> 8);
    registers[0x73] = (uint8_t)fifo;
    power_up_with(sensor);
    CHECK(ask(MESSAGE_SET_IMU, setup, sizeof setup) == REJECTION_NONE);
    run_ms(200);
    beat(2000);
    uint8_t status = answer[FRAME_HEADER + 11];
    ask(MESSAGE_READ_COUNTERS, "", 0);
    *overflows = (uint16_t)(answer[FRAME_HEADER + 16] | answer[FRAME_HEADER + 17] << 8);
    board_close(board);
    return status;
}

static void test_sensors_of_the_family_have_their_own_fifo(void) {
    static const uint8_t family[] = {0x68, 0x70, 0x71, 0x72, 0x98};
    uint16_t overflows;
    for (unsigned id = 0; id < 256; id++) {
        bool known = memchr(family, (int)id, sizeof family) != NULL;
        CHECK(run_sensor((uint8_t)id, 490, &overflows) == (known ? IMU_STATUS_RUNNING : IMU_STATUS_WRONG_ID));
        CHECK(overflows == 0 && (registers[0x6B] != 0) == known); /* nothing is written to an unknown chip */
    }
    for (unsigned i = 0; i < sizeof family; i++) {
        run_sensor(family[i], 504, &overflows);
        CHECK((overflows != 0) == (i != 0));
        run_sensor(family[i], 1022, &overflows);
        CHECK(overflows != 0);
    }
}

int main(void) {
    test_crc_is_ccitt_false();
    test_every_frame_comes_back();
    test_garbage_stays_within_its_bytes();
    test_outputs_need_a_heartbeat();
    test_silence_makes_the_bench_safe();
    test_estop_acts_within_a_millisecond();
    test_a_repeated_request_is_answered_but_not_done_twice();
    test_unknown_and_malformed_requests_are_rejected();
    test_a_program_that_hangs_is_restarted();
    test_sensors_of_the_family_have_their_own_fifo();
    printf("%u checks passed\n", checks);
}
