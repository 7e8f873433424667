/* The portable core on a computer: each call runs it to a given time, event by event. */
#include "board.h"

#include <stdlib.h>
#include <string.h>

#include "../../core/head.h"
#include "../../hal/hal.h"

#define TICK_NS (TICK_US * 1000ULL)
#define BYTE_NS (10ULL * 1000000000ULL / BAUD)
#define I2C_BYTE_NS 22500ULL /* nine bits at 400 kHz */
#define QUEUE 8192U          /* bytes to the board, and events from it */
#define TRANSMITTER 128U     /* as on the microcontroller */
#define WATCHDOG_NS 120000000ULL
#define PASSES 3             /* of the main loop after an event: enough to do all its work */

struct arriving {
    uint64_t ns;
    uint8_t byte;
};

struct board {
    struct head head;
    struct board_outside outside;
    uint64_t now, next_tick, next_edge, fed;
    uint32_t serial;
    uint8_t cause, stuck;
    bool estop_open, hangs;

    struct arriving arriving[QUEUE];
    uint32_t arriving_head, arriving_count;
    struct board_output out[QUEUE];
    uint32_t out_head, out_count;

    uint8_t readable[64];
    uint8_t readable_head, readable_count, overruns;
    uint32_t frame_us;
    uint64_t sent_until; /* end of the last queued byte */

    uint64_t i2c_ends;
    enum hal_i2c_result i2c_result, i2c_pending;

    uint16_t edges;
    uint32_t edge_us;
    int32_t light, relay;
};

/* The running board. The core supports only one, as on the microcontroller. */
static struct board *here;

static void emit(struct board *b, uint64_t ns, int32_t event, int32_t value) {
    if (b->out_count < QUEUE) {
        struct board_output *slot = &b->out[(b->out_head + b->out_count++) % QUEUE];
        slot->ns = ns;
        slot->event = event;
        slot->value = value;
    }
}

/* -- hal.h ------------------------------------------------------------------------------------------------------- */

static uint32_t micros(const struct board *b) {
    return (uint32_t)(b->now / 1000);
}

uint32_t hal_micros(void) {
    return micros(here);
}

uint8_t hal_lock(void) {
    return 0; /* the tick runs between steps only */
}

void hal_unlock(uint8_t before) {
    (void)before;
}

void hal_feed_watchdog(void) {
    here->fed = here->now;
}

bool hal_uart_read(uint8_t *byte) {
    if (!here->readable_count) {
        return false;
    }
    *byte = here->readable[here->readable_head];
    here->readable_head = (uint8_t)((here->readable_head + 1) % sizeof here->readable);
    here->readable_count--;
    return true;
}

uint32_t hal_uart_frame_us(void) {
    return here->frame_us;
}

uint8_t hal_uart_overruns(void) {
    uint8_t lost = here->overruns;
    here->overruns = 0;
    return lost;
}

bool hal_uart_write(const uint8_t *bytes, uint8_t length) {
    uint64_t start = here->sent_until > here->now ? here->sent_until : here->now;
    if ((start - here->now) / BYTE_NS + length > TRANSMITTER) {
        return false;
    }
    for (uint8_t i = 0; i < length; i++) {
        start += BYTE_NS;
        emit(here, start, BOARD_BYTE, bytes[i]);
    }
    here->sent_until = start;
    return true;
}

uint16_t hal_uart_backlog_us(void) {
    return here->sent_until > here->now ? (uint16_t)((here->sent_until - here->now) / 1000) : 0;
}

void hal_i2c_start(uint8_t address, const uint8_t *write, uint8_t write_length, uint8_t *read, uint8_t read_length) {
    struct board *b = here;
    uint64_t ns = b->now;
    uint8_t at = address;
    uint8_t bytes[32];
    b->i2c_result = HAL_I2C_BUSY;
    b->i2c_pending = HAL_I2C_NACK;
    b->i2c_ends = BOARD_NEVER;
    if (b->stuck) {
        return;
    }
    bool acknowledged = true;
    if (write_length) {
        ns += I2C_BYTE_NS;
        memcpy(bytes, write, write_length);
        acknowledged = b->outside.i2c(ns, BOARD_I2C_START_WRITE, &at, 1) == 1;
        if (acknowledged) {
            ns += I2C_BYTE_NS * write_length;
            acknowledged = b->outside.i2c(ns, BOARD_I2C_WRITE, bytes, write_length) == write_length;
        }
    }
    if (acknowledged && read_length) {
        ns += I2C_BYTE_NS;
        at = address;
        acknowledged = b->outside.i2c(ns, BOARD_I2C_START_READ, &at, 1) == 1;
        if (acknowledged) {
            b->outside.i2c(ns, BOARD_I2C_READ, read, read_length);
            ns += I2C_BYTE_NS * read_length;
        }
    }
    b->outside.i2c(ns, BOARD_I2C_STOP, &at, 0);
    b->next_edge = b->outside.edge(b->now); /* the write may have switched the signal on or off */
    b->i2c_ends = ns;
    b->i2c_pending = acknowledged ? HAL_I2C_DONE : HAL_I2C_NACK;
}

enum hal_i2c_result hal_i2c_result(void) {
    return here->i2c_result;
}

bool hal_i2c_free(void) {
    here->i2c_result = HAL_I2C_ERROR;
    here->i2c_ends = BOARD_NEVER;
    if (here->stuck != UINT8_MAX) {
        here->stuck = here->stuck > 9 ? (uint8_t)(here->stuck - 9) : 0;
    }
    return !here->stuck;
}

uint16_t hal_imu_edges(uint32_t *last_us) {
    *last_us = here->edge_us;
    return here->edges;
}

void hal_light(uint8_t level) {
    if (here->light != level) {
        here->light = level;
        emit(here, here->now, BOARD_LIGHT, level);
    }
}

void hal_relay(bool closed) {
    if (here->relay != closed) {
        here->relay = closed;
        emit(here, here->now, BOARD_RELAY, closed);
    }
}

bool hal_estop_open(void) {
    return here->estop_open;
}

uint8_t hal_board(void) {
    return BOARD_HOST;
}

uint8_t hal_reset_cause(void) {
    return here->cause;
}

uint32_t hal_serial(void) {
    return here->serial;
}

void hal_store_serial(uint32_t serial) {
    here->serial = serial;
}

/* -- board.h ----------------------------------------------------------------------------------------------------- */

static void start(struct board *b, uint8_t cause) {
    here = b;
    b->cause = cause;
    b->next_tick = b->now + TICK_NS;
    b->fed = b->now;
    b->readable_count = b->overruns = 0;
    b->sent_until = b->now;
    b->i2c_result = HAL_I2C_DONE;
    b->i2c_ends = BOARD_NEVER;
    b->next_edge = b->outside.edge(b->now);
    head_init(&b->head);
}

uint32_t board_abi(void) {
    return BOARD_ABI;
}

struct board *board_open(struct board_outside outside, const uint8_t *image, uint32_t image_size, uint32_t serial) {
    (void)image;
    (void)image_size;
    struct board *b = calloc(1, sizeof *b);
    if (b) {
        b->outside = outside;
        b->serial = serial;
        start(b, RESET_POWER_ON);
    }
    return b;
}

void board_close(struct board *b) {
    free(b);
}

void board_reset(struct board *b, uint8_t cause) {
    here = b;
    hal_light(0); /* pins become inputs, and external resistors pull them to their inactive levels */
    hal_relay(false);
    emit(b, b->now, BOARD_RESET, cause);
    start(b, cause);
}

void board_set_estop(struct board *b, bool open) {
    b->estop_open = open;
}

void board_set_stuck(struct board *b, uint8_t clocks) {
    b->stuck = clocks;
}

void board_hang(struct board *b, bool hangs) {
    b->hangs = hangs;
}

void board_receive(struct board *b, uint64_t ns, uint8_t byte) {
    if (b->arriving_count < QUEUE) {
        struct arriving *slot = &b->arriving[(b->arriving_head + b->arriving_count++) % QUEUE];
        slot->ns = ns;
        slot->byte = byte;
    }
}

uint32_t board_take(struct board *b, struct board_output *outputs, uint32_t room) {
    uint32_t taken = 0;
    while (taken < room && b->out_count) {
        outputs[taken++] = b->out[b->out_head];
        b->out_head = (b->out_head + 1) % QUEUE;
        b->out_count--;
    }
    return taken;
}

static void receiver_interrupt(struct board *b, uint8_t byte) {
    if (byte == 0) {
        b->frame_us = micros(b);
    }
    if (b->readable_count == sizeof b->readable) {
        b->overruns++;
    } else {
        b->readable[(b->readable_head + b->readable_count++) % sizeof b->readable] = byte;
    }
}

static uint64_t earliest(uint64_t a, uint64_t b) {
    return a < b ? a : b;
}

void board_run(struct board *b, uint64_t until) {
    here = b;
    for (;;) {
        uint64_t next = earliest(earliest(b->next_tick, b->next_edge), b->i2c_ends);
        if (b->arriving_count) {
            next = earliest(next, b->arriving[b->arriving_head].ns);
        }
        if (next > until) {
            break;
        }
        b->now = next > b->now ? next : b->now;
        if (b->next_edge <= b->now) {
            b->edges++;
            b->edge_us = micros(b);
            b->next_edge = b->outside.edge(b->now);
        }
        while (b->arriving_count && b->arriving[b->arriving_head].ns <= b->now) {
            receiver_interrupt(b, b->arriving[b->arriving_head].byte);
            b->arriving_head = (b->arriving_head + 1) % QUEUE;
            b->arriving_count--;
        }
        if (b->i2c_ends <= b->now) {
            b->i2c_ends = BOARD_NEVER;
            b->i2c_result = b->i2c_pending;
        }
        if (b->next_tick <= b->now) {
            b->next_tick += TICK_NS;
            head_tick(&b->head);
        }
        if (!b->hangs) {
            for (int i = 0; i < PASSES; i++) {
                head_step(&b->head);
            }
        } else if (b->now - b->fed > WATCHDOG_NS) {
            b->hangs = false;
            board_reset(b, RESET_WATCHDOG);
        }
    }
    b->now = until > b->now ? until : b->now;
}
