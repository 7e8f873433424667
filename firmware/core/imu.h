/* Sampling of the IMU: sets the sensor up, reads it in the background, and sets it up again when it is lost. */
#ifndef HEAD_IMU_H
#define HEAD_IMU_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

struct imu_sample {
    uint16_t index;
    uint32_t time_us;
    uint8_t flags;
    int16_t words[7]; /* accelerometer x, y, z; temperature; gyro x, y, z */
};

struct imu {
    uint8_t status, who_am_i;

    /* Settings. */
    uint8_t model, address, divider, filter, range;
    uint32_t period_us;

    /* Progress. */
    uint8_t phase;
    uint8_t at;       /* step of the set-up */
    uint8_t attempts; /* of the present transfer */
    bool sampled;     /* there was a sample since the last set-up request */
    bool edges_arrive; /* the data-ready pin is connected */
    uint8_t frames;   /* still to be read from the FIFO */
    uint8_t polls;    /* MPU-6050: odd counts in a row; BNO055: samples since the last check of its mode */
    uint16_t seen;    /* BNO055: checksum of the last sample */
    int16_t accel[3]; /* BNO055: read less often than the gyro's rates */
    uint16_t edges;   /* count at the last check of the FIFO */
    uint16_t base;    /* index = base + count of edges */
    uint16_t newest;  /* index of the newest sample that the sensor took */
    uint32_t due_us, began_us, newest_us, last_us, learnt_us;
    int16_t temperature;
    uint8_t sent[6];
    uint8_t got[20];
};

void imu_init(struct imu *imu);

/* Begin to set the sensor up; returns a rejection. */
uint8_t imu_setup(struct imu *imu, uint8_t model, uint8_t address, uint8_t divider, uint8_t filter, uint8_t range);

/* Continue; returns true if `*sample` has a new sample. */
bool imu_step(struct imu *imu, struct counters *counters, struct imu_sample *sample);

#endif
