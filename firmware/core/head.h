/* The rig head: communicates with the host, and switches its outputs off when necessary.
 *
 * Two contexts: `head_tick` in a timer interrupt, every TICK_US, does the safety functions and never waits;
 * `head_step` in the main loop does everything else. The main loop writes shared data while the tick is locked out. */
#ifndef HEAD_HEAD_H
#define HEAD_HEAD_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"
#include "imu.h"

struct head {
    /* Shared with the tick. */
    volatile uint8_t state, faults, inputs;
    volatile bool changed;
    volatile uint16_t silence; /* ticks since the last heartbeat */
    uint16_t deadman;          /* longest silence in ticks */
    uint8_t open_ticks;        /* ticks for which the e-stop loop has been open */
    uint8_t light;

    /* Main loop only. */
    uint8_t reset_cause;
    bool streaming;
    uint8_t sequence; /* of the events */
    uint8_t received[FRAME_ENCODED];
    uint8_t received_length;
    bool answered; /* the reply to the last request is stored in case the host missed it */
    uint8_t reply[FRAME_MAX];
    uint8_t reply_length;
    uint8_t request[FRAME_HEADER];
    struct counters counters;
    struct imu imu;
};

void head_init(struct head *head);
void head_step(struct head *head);
void head_tick(struct head *head);

#endif
