/* A rig head on a pseudo-terminal, in real time, for tests without a board.
 *
 *     head-pty            prints the port to open, then each change of an output with its time in seconds
 *
 * Commands on its standard input, one on each line: `estop open`, `estop closed`, `spin DEGREES_PER_SECOND`, `reset`.
 * An MPU-6050 without noise is on its bus. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "../../core/protocol.h"
#include "board.h"

#define STEP_MS 1
#define BYTE_NS (10ULL * 1000000000ULL / BAUD)

/* -- an MPU-6050 without noise: registers, FIFO, data-ready pulses ------------------------------------------------- */

enum { SMPLRT_DIV = 0x19, CONFIG, GYRO_CONFIG, FIFO_EN = 0x23, INT_ENABLE = 0x38, ACCEL = 0x3B };
enum { USER_CTRL = 0x6A, PWR_MGMT_1 = 0x6B, FIFO_COUNTH = 0x72, FIFO_R_W = 0x74, WHO_AM_I = 0x75, FIFO = 1024 };

static uint8_t registers[128] = {[PWR_MGMT_1] = 0x40};
static uint8_t fifo[FIFO];
static uint32_t fifo_head, fifo_count;
static uint8_t pointer;
static bool pointed, addressed;
static uint64_t epoch_ns, taken;
static double spin_dps;

static uint64_t period_ns(void) {
    return 1000000ULL * (registers[SMPLRT_DIV] + 1U);
}

static bool asleep(void) {
    return registers[PWR_MGMT_1] & 0x40;
}

static void take_samples(uint64_t now_ns) {
    static const double lsb_per_dps[] = {131.0, 65.5, 32.8, 16.4};
    uint64_t due = asleep() || now_ns < epoch_ns ? taken : (now_ns - epoch_ns) / period_ns();
    if (due - taken > FIFO / 14) {
        taken = due - FIFO / 14;
    }
    for (; taken < due; taken++) {
        int rate = (int)(spin_dps * lsb_per_dps[registers[GYRO_CONFIG] >> 3 & 3]);
        int words[7] = {0, 0, 16384, -3926, 0, 0, rate > 32767 ? 32767 : rate < -32768 ? -32768 : rate};
        for (int i = 0; i < 14; i++) {
            registers[ACCEL + i] = (uint8_t)(i % 2 ? words[i / 2] : words[i / 2] >> 8);
            if (registers[FIFO_EN] == 0xF8 && registers[USER_CTRL] & 0x40) {
                fifo[(fifo_head + fifo_count) % FIFO] = registers[ACCEL + i];
                if (fifo_count == FIFO) {
                    fifo_head++;
                } else {
                    fifo_count++;
                }
            }
        }
    }
}

static void write_register(uint64_t now_ns, uint8_t value) {
    take_samples(now_ns);
    if (pointer == PWR_MGMT_1 && value & 0x80) {
        memset(registers, 0, sizeof registers);
        registers[PWR_MGMT_1] = 0x40;
        fifo_count = 0;
        return;
    }
    if (pointer == USER_CTRL && value & 0x04) {
        fifo_count = 0;
    }
    registers[pointer] = value;
    if (pointer == PWR_MGMT_1 || pointer == SMPLRT_DIV) {
        epoch_ns = now_ns;
        taken = 0;
    }
}

static uint8_t read_register(void) {
    uint8_t value = pointer == WHO_AM_I ? 0x68 : registers[pointer];
    if (pointer == FIFO_COUNTH || pointer == FIFO_COUNTH + 1) {
        value = (uint8_t)(pointer == FIFO_COUNTH ? fifo_count >> 8 : fifo_count);
    }
    if (pointer == FIFO_R_W && fifo_count) {
        value = fifo[fifo_head++ % FIFO];
        fifo_count--;
    }
    return value;
}

static int32_t i2c(uint64_t ns, int32_t operation, uint8_t *data, int32_t length) {
    if (operation == BOARD_I2C_START_WRITE || operation == BOARD_I2C_START_READ) {
        addressed = data[0] == 0x68;
        pointed = operation == BOARD_I2C_START_READ;
        take_samples(ns);
        return addressed;
    }
    for (int32_t i = 0; addressed && i < length && operation != BOARD_I2C_STOP; i++) {
        if (operation == BOARD_I2C_READ) {
            data[i] = read_register();
        } else if (pointed) {
            write_register(ns, data[i]);
        } else {
            pointer = data[i] & 0x7F;
            pointed = true;
            continue;
        }
        if (pointer != FIFO_R_W) {
            pointer = (pointer + 1) & 0x7F;
        }
    }
    return length;
}

static uint64_t edge(uint64_t ns) {
    if (asleep() || !(registers[INT_ENABLE] & 1)) {
        return BOARD_NEVER;
    }
    uint64_t since = ns > epoch_ns ? ns - epoch_ns : 0;
    return epoch_ns + (since / period_ns() + 1) * period_ns();
}

/* -- the program --------------------------------------------------------------------------------------------------- */

static uint64_t real_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000ULL + (uint64_t)now.tv_nsec;
}

static int open_terminal(void) {
    int master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    struct termios raw;
    if (master < 0 || grantpt(master) || unlockpt(master) || tcgetattr(master, &raw)) {
        perror("head-pty: no pseudo-terminal");
        exit(1);
    }
    cfmakeraw(&raw);
    tcsetattr(master, TCSANOW, &raw);
    /* This end stays open, so that the port also exists while no program uses it. */
    if (open(ptsname(master), O_RDWR | O_NOCTTY) < 0) {
        perror(ptsname(master));
        exit(1);
    }
    return master;
}

static bool run_command(struct board *board, char *line) {
    double dps;
    if (!strncmp(line, "estop ", 6)) {
        board_set_estop(board, !strncmp(line + 6, "open", 4));
    } else if (sscanf(line, "spin %lf", &dps) == 1) {
        spin_dps = dps;
    } else if (!strncmp(line, "reset", 5)) {
        board_reset(board, RESET_EXTERNAL);
    } else {
        return false;
    }
    return true;
}

static void report(int master, struct board *board) {
    static const char *const names[] = {"", "light", "relay", "trigger", "reset"};
    struct board_output outputs[256];
    uint32_t count;
    while ((count = board_take(board, outputs, 256))) {
        for (uint32_t i = 0; i < count; i++) {
            if (outputs[i].event == BOARD_BYTE) {
                uint8_t byte = (uint8_t)outputs[i].value;
                if (write(master, &byte, 1) != 1) {
                    continue; /* no program reads, and the terminal is full */
                }
            } else {
                printf("%.6f %s %d\n", (double)outputs[i].ns * 1e-9, names[outputs[i].event], (int)outputs[i].value);
            }
        }
    }
}

int main(void) {
    int master = open_terminal();
    struct board *board = board_open((struct board_outside){i2c, edge}, NULL, 0, SERIAL_UNSET);
    if (!board) {
        return 1;
    }
    setvbuf(stdout, NULL, _IOLBF, 0);
    printf("%s\n", ptsname(master));
    struct pollfd fds[] = {{.fd = master, .events = POLLIN}, {.fd = STDIN_FILENO, .events = POLLIN}};
    uint64_t start = real_ns(), now = 0, received_until = 0;
    for (;;) {
        poll(fds, 2, STEP_MS);
        uint8_t bytes[256];
        ssize_t count = read(master, bytes, sizeof bytes);
        now = real_ns() - start;
        received_until = received_until > now ? received_until : now;
        for (ssize_t i = 0; i < count; i++) {
            board_receive(board, received_until += BYTE_NS, bytes[i]);
        }
        board_run(board, now);
        report(master, board);
        if (fds[1].revents & (POLLIN | POLLHUP)) {
            char line[80];
            if (!fgets(line, sizeof line, stdin)) {
                fds[1].fd = -1; /* the standard input has ended */
            } else if (!run_command(board, line)) {
                fprintf(stderr, "head-pty: estop open|closed, spin DPS, reset\n");
            }
        }
    }
}
