#include "imu.h"

#include <string.h>

#include "frame.h"
#include "hal.h"

/* Register numbers: RM-MPU-6000A rev 4.2 and BST-BNO055-DS000. */
#define MPU_SMPLRT_DIV 0x19
#define MPU_FIFO_EN 0x23
#define MPU_INT_PIN_CFG 0x37
#define MPU_USER_CTRL 0x6A
#define MPU_PWR_MGMT_1 0x6B
#define MPU_FIFO_COUNTH 0x72
#define MPU_FIFO_R_W 0x74
#define MPU_WHO_AM_I 0x75
#define MPU_FRAME 14   /* accelerometer, temperature, gyro: seven words */

#define BNO_CHIP_ID 0x00
#define BNO_ACC_DATA 0x08
#define BNO_GYR_DATA 0x14
#define BNO_TEMP 0x34
#define BNO_CALIB_STAT 0x35
#define BNO_UNIT_SEL 0x3B
#define BNO_OPR_MODE 0x3D
#define BNO_SYS_TRIGGER 0x3F
#define BNO_ID 0xA0
#define BNO_MODE_IMU 0x08
#define BNO_BURST 20         /* gyro, Euler angles, quaternion */
#define BNO_PERIOD_US ((uint32_t)10000) /* of its fusion */
#define BNO_POLL_US ((uint32_t)8000) /* shorter than its period: no sample is missed, repeated ones are recognised */
#define BNO_ACCEL 10         /* samples between two readings of the accelerometer */
#define BNO_CHECK 100        /* samples between two checks of temperature and mode */
#define BNO_LEARN_US ((uint32_t)3000000) /* longest wait for the gyro's calibration, which never completes on a moving table */

#define ATTEMPTS 3
#define TRANSFER_US 5000 /* the longest takes 0.6 ms at 400 kHz; a sensor may stretch the clock */
#define CHECK_US 50000   /* without an edge, check the FIFO: the pin is not connected, or the sensor is gone */
#define AGAIN_US 100000  /* between two attempts to set up a lost sensor again */

enum phase {
    OFF,
    IDENTIFY,
    IDENTIFIED,
    WRITE,
    WRITTEN,
    WAITING,
    VERIFIED,
    MPU_RUN,
    MPU_COUNTED,
    MPU_FETCH,
    MPU_FETCHED,
    BNO_LEARN,
    BNO_LEARNING,
    BNO_RUN,
    BNO_READ,
    BNO_ACCEL_READ,
    BNO_CHECKED,
    LOST,
};

/* A step of the set-up: bytes to write (register first), and the wait after them. */
struct step {
    uint8_t length;
    uint8_t bytes[5];
    uint16_t wait_ms;
};

enum { MPU_STEP_SETTINGS = 2, MPU_STEP_EMPTY = 5 };

static const struct step mpu_steps[] = {
    {2, {MPU_PWR_MGMT_1, 0x80}, 100}, /* device reset */
    {2, {MPU_PWR_MGMT_1, 0x01}, 50},  /* awake, clocked by the gyro */
    {5, {MPU_SMPLRT_DIV, 0, 0, 0, 0}, 0},
    {2, {MPU_FIFO_EN, 0xF8}, 0},            /* temperature, gyro, accelerometer */
    {3, {MPU_INT_PIN_CFG, 0x00, 0x01}, 0},  /* a pulse of 50 us for each sample */
    {2, {MPU_USER_CTRL, 0x04}, 0},          /* empty the FIFO: this works only while it is off */
    {2, {MPU_USER_CTRL, 0x40}, 0},
};

static const struct step bno_steps[] = {
    {2, {BNO_OPR_MODE, 0x00}, 20},
    {2, {BNO_SYS_TRIGGER, 0x20}, 700}, /* reset: it does not answer for 650 ms */
    {2, {BNO_UNIT_SEL, 0x01}, 0},      /* mg, degrees a second, degrees Celsius */
    {2, {BNO_OPR_MODE, BNO_MODE_IMU}, 20},
};

static void count(uint16_t *counter) {
    if (*counter != UINT16_MAX) {
        ++*counter;
    }
}

static bool passed(uint32_t now, uint32_t due) {
    return (int32_t)(now - due) >= 0;
}

static bool is_mpu(const struct imu *imu) {
    return imu->model == IMU_MODEL_MPU6050;
}

/* The sensors with the registers of the MPU-6050: itself, MPU-6500, MPU-9250, and two clones. */
static const uint8_t mpu_ids[] = {0x68, 0x70, 0x71, 0x72, 0x98};

static bool identified(const struct imu *imu) {
    return is_mpu(imu) ? memchr(mpu_ids, imu->who_am_i, sizeof mpu_ids) != NULL : imu->who_am_i == BNO_ID;
}

/* Return the largest count at which one more frame fits into the FIFO, which has 1024 bytes only in an MPU-6050. */
static uint16_t mpu_full(const struct imu *imu) {
    return ((imu->who_am_i == mpu_ids[0] ? 1024 : 512) / MPU_FRAME - 1) * MPU_FRAME;
}

/* -- transfers --------------------------------------------------------------------------------------------------- */

static void transfer(struct imu *imu, uint8_t write_length, uint8_t read_length) {
    imu->began_us = hal_micros();
    hal_i2c_start(imu->address, imu->sent, write_length, imu->got, read_length);
}

static void read_registers(struct imu *imu, uint8_t first, uint8_t length) {
    imu->sent[0] = first;
    transfer(imu, 1, length);
}

static void lost(struct imu *imu, uint8_t status) {
    imu->status = status;
    imu->attempts = 0;
    imu->phase = LOST;
    imu->due_us = hal_micros() + AGAIN_US;
}

static void empty_fifo(struct imu *imu) {
    imu->frames = 0;
    imu->at = MPU_STEP_EMPTY;
    imu->phase = WRITE;
}

/* Return whether the transfer succeeded. If it failed, continue with the phase `again`, which repeats it. */
static bool ended(struct imu *imu, struct counters *counters, uint8_t again) {
    enum hal_i2c_result result = hal_i2c_result();
    uint8_t status = IMU_STATUS_ABSENT;
    if (result == HAL_I2C_BUSY) {
        if (!passed(hal_micros(), imu->began_us + TRANSFER_US)) {
            return false;
        }
        count(&counters->timeouts);
    }
    if (result == HAL_I2C_DONE) {
        imu->attempts = 0;
        return true;
    }
    if (result == HAL_I2C_NACK) {
        count(&counters->nacks);
    } else if (hal_i2c_free()) {
        count(&counters->recoveries);
    } else {
        status = IMU_STATUS_BUS_STUCK;
    }
    if (++imu->attempts >= ATTEMPTS) {
        lost(imu, status);
    } else if (again == MPU_FETCH && result != HAL_I2C_NACK) {
        /* The transfer ended within a frame, so the FIFO's content no longer begins with a frame. */
        empty_fifo(imu);
    } else {
        imu->phase = again;
        imu->due_us = hal_micros();
    }
    return false;
}

/* -- setting up -------------------------------------------------------------------------------------------------- */

void imu_init(struct imu *imu) {
    memset(imu, 0, sizeof *imu);
}

uint8_t imu_setup(struct imu *imu, uint8_t model, uint8_t address, uint8_t divider, uint8_t filter, uint8_t range) {
    if (model > IMU_MODEL_BNO055 || address < 0x08 || address > 0x77 || filter < 1 || filter > 6 || range > 3) {
        return REJECTION_OUT_OF_RANGE;
    }
    if (hal_i2c_result() == HAL_I2C_BUSY) {
        hal_i2c_free();
    }
    imu_init(imu);
    if (model == IMU_MODEL_NONE) {
        return REJECTION_NONE;
    }
    imu->status = IMU_STATUS_STARTING;
    imu->phase = IDENTIFY;
    imu->model = model;
    imu->address = address;
    imu->divider = divider;
    imu->filter = filter;
    imu->range = range;
    imu->period_us = is_mpu(imu) ? (uint32_t)1000 * (divider + 1U) : BNO_PERIOD_US;
    return REJECTION_NONE;
}

/* Write the bytes of step `at` to `sent`; returns their number. */
static uint8_t load_step(struct imu *imu) {
    const struct step *step = is_mpu(imu) ? &mpu_steps[imu->at] : &bno_steps[imu->at];
    memcpy(imu->sent, step->bytes, sizeof step->bytes);
    if (is_mpu(imu) && imu->at == MPU_STEP_SETTINGS) {
        imu->sent[1] = imu->divider;
        imu->sent[2] = imu->filter;
        imu->sent[3] = (uint8_t)(imu->range << 3);
    }
    return step->length;
}

static bool settings_unchanged(const struct imu *imu) {
    if (!is_mpu(imu)) {
        return (imu->got[0] & 0x0F) == BNO_MODE_IMU;
    }
    return imu->got[0] == imu->divider && imu->got[1] == imu->filter && imu->got[2] == imu->range << 3;
}

static void read_mode(struct imu *imu) {
    read_registers(imu, BNO_TEMP, BNO_OPR_MODE - BNO_TEMP + 1);
    imu->phase = BNO_CHECKED;
}

static void read_acceleration(struct imu *imu) {
    read_registers(imu, BNO_ACC_DATA, 6);
    imu->phase = BNO_ACCEL_READ;
}

/* Return whether the BNO055 has calibrated its gyro, which it does at a standstill; its rates may jump before that. If it
 * has not, check again later. */
static bool calibrated(struct imu *imu, uint32_t now) {
    if (imu->phase == BNO_LEARNING && ((imu->got[BNO_CALIB_STAT - BNO_TEMP] & 0x30) == 0x30 || passed(now, imu->learnt_us))) {
        return true;
    }
    if (imu->phase != BNO_LEARNING) {
        imu->learnt_us = now + BNO_LEARN_US;
    }
    imu->due_us = now + CHECK_US;
    imu->phase = BNO_LEARN;
    return false;
}

/* Start sampling, for the first time or again. Samples that the sensor did not take count as lost. */
static void run(struct imu *imu, struct counters *counters) {
    uint32_t now = hal_micros(), edge_us;
    if (!is_mpu(imu) && !calibrated(imu, now)) {
        return;
    }
    if (imu->sampled) {
        imu->newest = (uint16_t)(imu->newest + (now - imu->last_us) / imu->period_us);
        if (imu->status != IMU_STATUS_RUNNING) {
            count(&counters->restarts);
        }
    }
    if (!imu->edges_arrive || imu->status != IMU_STATUS_RUNNING) {
        imu->edges = hal_imu_edges(&edge_us);
        imu->base = (uint16_t)(imu->newest - imu->edges);
        imu->edges_arrive = false;
    }
    imu->status = IMU_STATUS_RUNNING;
    imu->last_us = now;
    imu->due_us = now + CHECK_US;
    imu->polls = 0;
    imu->phase = MPU_RUN;
    if (!is_mpu(imu)) {
        imu->due_us = imu->newest_us = now;
        read_acceleration(imu);
    }
}

/* -- sampling ---------------------------------------------------------------------------------------------------- */

static void fetch(struct imu *imu) {
    read_registers(imu, MPU_FIFO_R_W, MPU_FRAME);
    imu->phase = MPU_FETCHED;
}

/* Date the samples in the FIFO by its count. The newest one belongs to the last edge unless a new edge occurred. */
static void date_samples(struct imu *imu, struct counters *counters) {
    uint32_t now = hal_micros(), edge_us;
    uint16_t bytes = (uint16_t)(imu->got[0] << 8 | imu->got[1]);
    uint16_t edges = hal_imu_edges(&edge_us);
    uint8_t frames = (uint8_t)(bytes / MPU_FRAME);
    imu->phase = MPU_RUN;
    if (bytes > mpu_full(imu)) {
        count(&counters->fifo_overflows);
        empty_fifo(imu);
        return;
    }
    if (edges != imu->edges && passed(edge_us, imu->began_us + 1)) {
        return; /* an edge occurred during the request, so the count may include it or not: read it again */
    }
    if (!frames) {
        bool silent = edges == imu->edges && passed(now, imu->last_us + CHECK_US + imu->period_us);
        imu->edges = edges;
        imu->due_us = now + (imu->edges_arrive ? CHECK_US : imu->period_us / 2);
        if (silent) {
            lost(imu, IMU_STATUS_SETTINGS_LOST); /* the sensor takes no samples: it sleeps after a brown-out */
        }
        return;
    }
    if (bytes % MPU_FRAME) { /* a frame that is being written, or an incomplete one */
        if (++imu->polls > ATTEMPTS) {
            imu->polls = 0;
            empty_fifo(imu);
        }
        imu->due_us = now;
        return;
    }
    imu->polls = 0;
    uint16_t newest = (uint16_t)(imu->newest + frames);
    if (edges != imu->edges) {
        if (!imu->edges_arrive) {
            imu->base = (uint16_t)(newest - edges);
            imu->edges_arrive = true;
        }
        newest = (uint16_t)(imu->base + edges);
        imu->newest_us = edge_us;
    } else {
        imu->edges_arrive = false;
        imu->newest_us = now - imu->period_us / 2;
    }
    imu->newest = newest;
    imu->edges = edges;
    imu->frames = frames;
    imu->due_us = now + (imu->edges_arrive ? CHECK_US : imu->period_us / 2);
    fetch(imu);
}

static void mpu_sample(struct imu *imu, struct imu_sample *sample) {
    uint8_t older = --imu->frames;
    sample->index = (uint16_t)(imu->newest - older);
    sample->time_us = imu->newest_us - older * imu->period_us;
    sample->flags = imu->edges_arrive ? SAMPLE_FLAG_EDGE : 0;
    for (uint8_t i = 0; i < 7; i++) {
        sample->words[i] = (int16_t)(imu->got[2 * i] << 8 | imu->got[2 * i + 1]);
    }
    imu->last_us = sample->time_us;
    imu->sampled = true;
    imu->phase = MPU_RUN;
    if (imu->frames) {
        fetch(imu);
    }
}

/* The fusion does not signal a new sample, so the head polls faster than the fusion's rate. Unchanged data is the last
 * sample again, unless a sample is overdue: samples of a table at a standstill may be equal. */
static bool bno_sample(struct imu *imu, struct imu_sample *sample) {
    uint16_t seen = frame_crc(imu->got, BNO_BURST);
    bool fresh = seen != imu->seen;
    imu->phase = BNO_RUN;
    if (!fresh && !passed(imu->began_us, imu->newest_us)) {
        return false;
    }
    uint32_t gap_us = imu->began_us - imu->last_us;
    if (gap_us > 5 * BNO_PERIOD_US / 2) {
        imu->newest = (uint16_t)(imu->newest + gap_us / BNO_PERIOD_US - 1); /* the bus was not available */
    }
    imu->seen = seen;
    imu->newest_us = fresh ? imu->began_us + BNO_PERIOD_US + BNO_POLL_US / 4 : imu->newest_us + BNO_PERIOD_US;
    sample->index = ++imu->newest;
    sample->time_us = imu->began_us - BNO_POLL_US / 2;
    sample->flags = 0;
    for (uint8_t i = 0; i < 3; i++) {
        sample->words[i] = imu->accel[i];
        sample->words[4 + i] = (int16_t)get_u16(imu->got + 2 * i);
    }
    sample->words[3] = imu->temperature;
    imu->last_us = imu->began_us;
    imu->sampled = true;
    imu->polls = (uint8_t)((imu->polls + 1) % BNO_CHECK);
    if (imu->polls % BNO_ACCEL == 0) {
        read_acceleration(imu);
    }
    return true;
}

bool imu_step(struct imu *imu, struct counters *counters, struct imu_sample *sample) {
    uint32_t now = hal_micros(), edge_us;
    switch (imu->phase) {
    case IDENTIFY:
        imu->at = 0;
        read_registers(imu, is_mpu(imu) ? MPU_WHO_AM_I : BNO_CHIP_ID, 1);
        imu->phase = IDENTIFIED;
        break;
    case IDENTIFIED:
        if (ended(imu, counters, IDENTIFY)) {
            imu->who_am_i = imu->got[0];
            imu->phase = WRITE;
            if (!identified(imu)) {
                lost(imu, IMU_STATUS_WRONG_ID);
            }
        }
        break;
    case WRITE:
        transfer(imu, load_step(imu), 0);
        imu->phase = WRITTEN;
        break;
    case WRITTEN:
        if (ended(imu, counters, WRITE)) {
            const struct step *step = is_mpu(imu) ? &mpu_steps[imu->at] : &bno_steps[imu->at];
            imu->due_us = now + (uint32_t)1000 * step->wait_ms;
            imu->phase = WAITING;
        }
        break;
    case WAITING:
        if (!passed(now, imu->due_us)) {
            break;
        }
        if (++imu->at < (is_mpu(imu) ? sizeof mpu_steps / sizeof *mpu_steps : sizeof bno_steps / sizeof *bno_steps)) {
            imu->phase = WRITE;
            break;
        }
        imu->at--;
        read_registers(imu, is_mpu(imu) ? MPU_SMPLRT_DIV : BNO_OPR_MODE, is_mpu(imu) ? 3 : 1);
        imu->phase = VERIFIED;
        break;
    case VERIFIED:
        if (ended(imu, counters, WAITING)) {
            if (settings_unchanged(imu)) {
                run(imu, counters);
            } else {
                lost(imu, IMU_STATUS_SETTINGS_LOST);
            }
        }
        break;
    case MPU_RUN:
        if (passed(now, imu->due_us) || hal_imu_edges(&edge_us) != imu->edges) {
            read_registers(imu, MPU_FIFO_COUNTH, 2);
            imu->phase = MPU_COUNTED;
        }
        break;
    case MPU_COUNTED:
        if (ended(imu, counters, MPU_RUN)) {
            date_samples(imu, counters);
        }
        break;
    case MPU_FETCH:
        fetch(imu);
        break;
    case MPU_FETCHED:
        if (ended(imu, counters, MPU_FETCH)) {
            mpu_sample(imu, sample);
            return true;
        }
        break;
    case BNO_LEARN:
        if (passed(now, imu->due_us)) {
            read_mode(imu);
            imu->phase = BNO_LEARNING;
        }
        break;
    case BNO_LEARNING:
        if (ended(imu, counters, BNO_LEARN)) {
            run(imu, counters);
        }
        break;
    case BNO_RUN:
        if (passed(now, imu->due_us)) {
            imu->due_us = now + BNO_POLL_US;
            read_registers(imu, BNO_GYR_DATA, BNO_BURST);
            imu->phase = BNO_READ;
        }
        break;
    case BNO_READ:
        return ended(imu, counters, BNO_RUN) && bno_sample(imu, sample);
    case BNO_ACCEL_READ:
        if (ended(imu, counters, BNO_RUN)) {
            for (uint8_t i = 0; i < 3; i++) {
                imu->accel[i] = (int16_t)get_u16(imu->got + 2 * i);
            }
            imu->phase = BNO_RUN;
            if (imu->polls == 0) {
                read_mode(imu);
            }
        }
        break;
    case BNO_CHECKED:
        if (ended(imu, counters, BNO_RUN)) {
            imu->temperature = (int8_t)imu->got[0];
            imu->phase = BNO_RUN;
            if ((imu->got[BNO_OPR_MODE - BNO_TEMP] & 0x0F) != BNO_MODE_IMU) {
                lost(imu, IMU_STATUS_SETTINGS_LOST);
            }
        }
        break;
    case LOST:
        if (passed(now, imu->due_us)) {
            imu->phase = IDENTIFY;
        }
        break;
    default:
        break;
    }
    return false;
}
