/* A rig head in memory, for programs that simulate its surroundings. The emulated microcontroller (tests/firmware/avr.c)
 * has the same interface, so that the same tests run with both.
 *
 * Times are nanoseconds of the board's own clock since its power came on. A board runs only within `board_run`. */
#ifndef HEAD_BOARD_H
#define HEAD_BOARD_H

#include <stdbool.h>
#include <stdint.h>

#define BOARD_NEVER UINT64_MAX

enum board_i2c { BOARD_I2C_START_WRITE, BOARD_I2C_START_READ, BOARD_I2C_WRITE, BOARD_I2C_READ, BOARD_I2C_STOP };

/* The surroundings of a running board. */
struct board_outside {
    /* One step of a transfer at `ns`. START: data[0] is the address; returns 1 if it is acknowledged. WRITE: returns
     * the number of acknowledged bytes. READ: writes the bytes to data. */
    int32_t (*i2c)(uint64_t ns, int32_t operation, uint8_t *data, int32_t length);
    /* Time of the next data-ready edge after `ns`, or BOARD_NEVER. */
    uint64_t (*edge)(uint64_t ns);
};

enum board_event { BOARD_BYTE, BOARD_LIGHT, BOARD_RELAY, BOARD_RESET };

/* An output of the board at `ns`: a byte whose stop bit ends then, a duty in 1/255, or a level. BOARD_RESET has the
 * cause; bytes that would have ended after it are lost. */
struct board_output {
    uint64_t ns;
    int32_t event;
    int32_t value;
};

struct board;

/* `image`: the content of the flash, if the board needs it. Returns NULL if the board cannot be opened. */
struct board *board_open(struct board_outside outside, const uint8_t *image, uint32_t image_size, uint32_t serial);
void board_close(struct board *board);

/* Run until `ns`. */
void board_run(struct board *board, uint64_t ns);

/* Take up to `room` outputs, oldest first; returns their number. */
uint32_t board_take(struct board *board, struct board_output *outputs, uint32_t room);

/* Receive `byte` from the host; its stop bit ends at `ns`, not earlier than the end of the last `board_run`. */
void board_receive(struct board *board, uint64_t ns, uint8_t byte);

/* These take effect immediately. A sensor holds SDA low for `clocks` clock pulses; 255: forever; 0: not. */
void board_set_estop(struct board *board, bool open);
void board_set_stuck(struct board *board, uint8_t clocks);

/* Restart with this cause (protocol.h, RESET_...). */
void board_reset(struct board *board, uint8_t cause);

/* Simulate a program that hangs: interrupts continue, the main loop does not. */
void board_hang(struct board *board, bool hangs);

/* Return the version of this interface. */
uint32_t board_abi(void);
#define BOARD_ABI 1

#endif
