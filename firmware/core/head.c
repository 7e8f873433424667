#include "head.h"

#include <string.h>

#include "hal.h"

#define TICKS_PER_MS (1000 / TICK_US)

static void latch(struct head *head, uint8_t fault);
static void outputs_off(struct head *head);

static void count(uint16_t *counter) {
    if (*counter != UINT16_MAX) {
        ++*counter;
    }
}

/* -- safety: in the tick ----------------------------------------------------------------------------------------- */

void head_tick(struct head *head) {
    bool open = hal_estop_open();
    if (!open) {
        head->open_ticks = 0;
    } else if (head->open_ticks < ESTOP_TICKS) {
        head->open_ticks++;
    }
    bool pressed = head->open_ticks == ESTOP_TICKS;
    if (pressed != !!(head->inputs & INPUT_ESTOP_OPEN)) {
        head->inputs ^= INPUT_ESTOP_OPEN;
        head->changed = true;
    }
    if (pressed && !(head->faults & HEAD_FAULT_ESTOP)) {
        latch(head, HEAD_FAULT_ESTOP);
    }
    if (head->state == HEAD_STATE_ACTIVE && ++head->silence > head->deadman) {
        latch(head, HEAD_FAULT_DEADMAN);
    }
}

static void latch(struct head *head, uint8_t fault) {
    outputs_off(head);
    head->faults |= fault;
    head->state = HEAD_STATE_FAULT;
    head->changed = true;
}

static void outputs_off(struct head *head) {
    hal_relay(false);
    hal_light(0);
    head->light = 0;
    head->inputs &= (uint8_t)~INPUT_RELAY_CLOSED;
}

/* -- transmission ----------------------------------------------------------------------------------------------- */

/* Queue the frame whose body is in frame[FRAME_HEADER...]. */
static bool transmit(uint8_t *frame, uint8_t id, uint8_t sequence, uint8_t body_length) {
    uint8_t encoded[FRAME_ENCODED];
    frame[0] = id;
    frame[1] = sequence;
    return hal_uart_write(encoded, frame_encode(encoded, frame, body_length));
}

static void send_change(struct head *head) {
    uint8_t frame[FRAME_MAX];
    uint8_t before = hal_lock();
    head->changed = false;
    struct status_changed m = {
        .time_us = hal_micros(),
        .state = head->state,
        .faults = head->faults,
        .inputs = head->inputs,
        .imu_status = head->imu.status,
        .who_am_i = head->imu.who_am_i,
        .reset_cause = head->reset_cause,
    };
    hal_unlock(before);
    if (transmit(frame, MESSAGE_STATUS_CHANGED, head->sequence, put_status_changed(frame + FRAME_HEADER, &m))) {
        head->sequence++;
    } else {
        head->changed = true; /* send it again when there is room */
    }
}

static void send_sample(struct head *head, const struct imu_sample *sample) {
    uint8_t frame[FRAME_MAX];
    struct sample m = {
        .index = sample->index,
        .time_us = sample->time_us,
        .flags = sample->flags,
        .dropped = (uint8_t)head->counters.dropped,
        .accel_x = sample->words[0],
        .accel_y = sample->words[1],
        .accel_z = sample->words[2],
        .temperature = sample->words[3],
        .gyro_x = sample->words[4],
        .gyro_y = sample->words[5],
        .gyro_z = sample->words[6],
    };
    if (transmit(frame, MESSAGE_SAMPLE, head->sequence, put_sample(frame + FRAME_HEADER, &m))) {
        head->sequence++;
    } else {
        count(&head->counters.dropped);
    }
}

/* -- reception ----------------------------------------------------------------------------------------------- */

static uint8_t set_light(struct head *head, uint8_t level) {
    uint8_t rejection = REJECTION_NONE;
    uint8_t before = hal_lock();
    if (level && head->state != HEAD_STATE_ACTIVE) {
        rejection = head->state == HEAD_STATE_FAULT ? REJECTION_FAULT_LATCHED : REJECTION_NOT_ACTIVE;
    } else {
        hal_light(level);
        head->light = level;
    }
    hal_unlock(before);
    return rejection;
}

static uint8_t set_relay(struct head *head, uint8_t closed) {
    uint8_t rejection = REJECTION_NONE;
    uint8_t before = hal_lock();
    if (closed > 1) {
        rejection = REJECTION_OUT_OF_RANGE;
    } else if (closed && head->state != HEAD_STATE_ACTIVE) {
        rejection = head->state == HEAD_STATE_FAULT ? REJECTION_FAULT_LATCHED : REJECTION_NOT_ACTIVE;
    } else {
        hal_relay(closed);
        head->inputs = (uint8_t)((head->inputs & ~INPUT_RELAY_CLOSED) | (closed ? INPUT_RELAY_CLOSED : 0));
    }
    hal_unlock(before);
    return rejection;
}

static uint8_t acknowledge(struct head *head, uint8_t seen) {
    uint8_t rejection = REJECTION_NONE;
    uint8_t before = hal_lock();
    if (head->inputs & INPUT_ESTOP_OPEN && seen & HEAD_FAULT_ESTOP) {
        rejection = REJECTION_CAUSE_PERSISTS;
    } else if (head->state == HEAD_STATE_FAULT) {
        head->faults &= (uint8_t)~seen;
        if (!head->faults) {
            head->state = HEAD_STATE_IDLE; /* outputs stay off until the host requests them again */
        }
        head->changed = true;
    }
    hal_unlock(before);
    return rejection;
}

static void shut_down(struct head *head) {
    uint8_t before = hal_lock();
    outputs_off(head);
    if (head->state == HEAD_STATE_ACTIVE) {
        head->state = HEAD_STATE_IDLE;
        head->changed = true;
    }
    hal_unlock(before);
    head->streaming = false;
}

static uint8_t beat(struct head *head, uint16_t deadman_ms) {
    if (deadman_ms < DEADMAN_MIN_MS || deadman_ms > DEADMAN_MAX_MS) {
        return REJECTION_OUT_OF_RANGE;
    }
    uint8_t before = hal_lock();
    head->silence = 0;
    head->deadman = (uint16_t)(deadman_ms * TICKS_PER_MS);
    if (head->state == HEAD_STATE_IDLE) {
        head->state = HEAD_STATE_ACTIVE;
    }
    hal_unlock(before);
    return REJECTION_NONE;
}

static uint8_t answer_heartbeat(struct head *head, uint8_t *body) {
    struct heartbeat_reply m = {
        .received_us = hal_uart_frame_us(),
        .sent_us = hal_micros() + hal_uart_backlog_us(),
        .state = head->state,
        .faults = head->faults,
        .inputs = head->inputs,
        .imu_status = head->imu.status,
        .who_am_i = head->imu.who_am_i,
        .light = head->light,
    };
    return put_heartbeat_reply(body, &m);
}

static uint8_t put_own_identity(struct head *head, uint8_t *body) {
    struct identity m = {
        .protocol = PROTOCOL_VERSION,
        .major = FIRMWARE_MAJOR,
        .minor = FIRMWARE_MINOR,
        .patch = FIRMWARE_PATCH,
        .board = hal_board(),
        .capabilities = CAPABILITY_IMU | CAPABILITY_LIGHT | CAPABILITY_ESTOP | CAPABILITY_RELAY,
        .reset_cause = head->reset_cause,
        .serial = hal_serial(),
        .uptime_us = hal_micros(),
    };
    return put_identity(body, &m);
}

/* Rejected while the head is active: storing takes some milliseconds, in which no sample is sent. */
static uint8_t set_serial(struct head *head, uint32_t serial) {
    if (head->state == HEAD_STATE_ACTIVE) {
        return REJECTION_BUSY;
    }
    hal_store_serial(serial);
    return REJECTION_NONE;
}

/* Length of each request's body by its id; 0xFF if the request does not exist. */
static uint8_t length_of(uint8_t id) {
    static const uint8_t sizes[] = {
        [MESSAGE_HELLO] = SIZE_HELLO, [MESSAGE_HEARTBEAT] = SIZE_HEARTBEAT,   [MESSAGE_SHUTDOWN] = SIZE_SHUTDOWN,
        [MESSAGE_LIGHT] = SIZE_LIGHT, [MESSAGE_RELAY] = SIZE_RELAY,
        [MESSAGE_SET_IMU] = SIZE_SET_IMU, [MESSAGE_READ_COUNTERS] = SIZE_READ_COUNTERS,
        [MESSAGE_ACKNOWLEDGE] = SIZE_ACKNOWLEDGE, [MESSAGE_STREAM] = SIZE_STREAM, [MESSAGE_SET_SERIAL] = SIZE_SET_SERIAL,
    };
    return id >= MESSAGE_HELLO && id < sizeof sizes ? sizes[id] : UINT8_MAX;
}

/* Carry out a request; write the reply's body to `out`, its id to `*reply`. Returns the length of the body. */
static uint8_t execute(struct head *head, uint8_t id, const uint8_t *body, uint8_t length, uint8_t *out, uint8_t *reply) {
    uint8_t rejection = REJECTION_NONE;
    uint8_t answer = 0;
    uint8_t expected = length_of(id);
    if (expected == UINT8_MAX) {
        rejection = REJECTION_UNKNOWN_REQUEST;
    } else if (expected != length) {
        rejection = REJECTION_MALFORMED;
    } else {
        switch (id) {
        case MESSAGE_HELLO:
            *reply = MESSAGE_IDENTITY; /* for any version of the host: it must learn this version */
            answer = put_own_identity(head, out);
            break;
        case MESSAGE_HEARTBEAT:
            rejection = beat(head, get_u16(body + HEARTBEAT_DEADMAN_MS));
            *reply = MESSAGE_HEARTBEAT_REPLY;
            answer = answer_heartbeat(head, out);
            break;
        case MESSAGE_SHUTDOWN:
            shut_down(head);
            break;
        case MESSAGE_ACKNOWLEDGE:
            rejection = acknowledge(head, body[ACKNOWLEDGE_FAULTS]);
            break;
        case MESSAGE_LIGHT:
            rejection = set_light(head, body[LIGHT_LEVEL]);
            break;
        case MESSAGE_RELAY:
            rejection = set_relay(head, body[RELAY_CLOSED]);
            break;
        case MESSAGE_SET_IMU:
            rejection = imu_setup(&head->imu, body[SET_IMU_MODEL], body[SET_IMU_ADDRESS], body[SET_IMU_DIVIDER],
                                body[SET_IMU_FILTER], body[SET_IMU_RANGE]);
            break;
        case MESSAGE_STREAM:
            rejection = body[STREAM_ON] > 1 ? REJECTION_OUT_OF_RANGE : REJECTION_NONE;
            head->streaming = body[STREAM_ON] == 1;
            break;
        case MESSAGE_SET_SERIAL:
            rejection = set_serial(head, get_u32(body + SET_SERIAL_SERIAL));
            break;
        case MESSAGE_READ_COUNTERS:
            *reply = MESSAGE_COUNTERS;
            answer = put_counters(out, &head->counters);
            break;
        default:
            break;
        }
    }
    if (rejection || answer == 0) {
        struct done m = {.request = id, .rejection = rejection};
        *reply = MESSAGE_DONE;
        return put_done(out, &m);
    }
    return answer;
}

/* A frame is complete. If a request arrives twice in a row, its reply was lost: the head answers it again, but does
 * not carry it out again. */
static void take_frame(struct head *head) {
    int8_t length = frame_decode(head->received, head->received_length);
    if (length < 0) {
        count(length == FRAME_BAD_CRC ? &head->counters.crc_errors : &head->counters.malformed);
        return;
    }
    count(&head->counters.frames);
    uint8_t *frame = head->received;
    if (!head->answered || memcmp(head->request, frame, FRAME_HEADER) != 0 || frame[0] == MESSAGE_HELLO) {
        memcpy(head->request, frame, FRAME_HEADER);
        uint8_t body = execute(head, frame[0], frame + FRAME_HEADER, (uint8_t)length, head->reply + FRAME_HEADER,
                               &head->reply[0]);
        head->reply_length = body;
        head->answered = frame[0] != MESSAGE_HELLO;
    }
    transmit(head->reply, head->reply[0], frame[1], head->reply_length);
}

static void receive(struct head *head) {
    uint8_t byte;
    while (hal_uart_read(&byte)) {
        if (byte) {
            if (head->received_length < FRAME_ENCODED) {
                head->received[head->received_length++] = byte;
            }
        } else {
            if (head->received_length) { /* repeated zeros have no effect */
                take_frame(head);
            }
            head->received_length = 0;
        }
    }
    for (uint8_t lost = hal_uart_overruns(); lost; lost--) {
        count(&head->counters.overruns);
    }
}

/* -- main loop --------------------------------------------------------------------------------------------------- */

void head_init(struct head *head) {
    memset(head, 0, sizeof *head);
    outputs_off(head);
    head->deadman = DEADMAN_DEFAULT_MS * TICKS_PER_MS;
    head->reset_cause = hal_reset_cause();
    imu_init(&head->imu);
    if (head->reset_cause == RESET_WATCHDOG) {
        latch(head, HEAD_FAULT_WATCHDOG);
    } else if (head->reset_cause == RESET_BROWN_OUT) {
        latch(head, HEAD_FAULT_BROWN_OUT);
    }
    uint8_t end = 0;
    hal_uart_write(&end, 1); /* ends a frame that the reset interrupted */
    head->changed = true;    /* the first message after a start */
}

void head_step(struct head *head) {
    hal_feed_watchdog();
    receive(head);
    struct imu_sample sample;
    uint8_t status = head->imu.status;
    if (imu_step(&head->imu, &head->counters, &sample) && head->streaming) {
        send_sample(head, &sample);
    }
    if (status != head->imu.status) {
        head->changed = true;
    }
    if (head->changed) {
        send_change(head);
    }
}
