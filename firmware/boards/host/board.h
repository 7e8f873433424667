/* A rig head in memory, for programs that simulate what is around it. The emulated microcontroller (sim/head/avr.c)
 * has the same interface, so that both run under the same tests.
 *
 * Times are nanoseconds of the board's own clock since its power came on. A board runs only within `board_run`. */
#ifndef HEAD_BOARD_H
#define HEAD_BOARD_H

#include <stdbool.h>
#include <stdint.h>

#define BOARD_NEVER UINT64_MAX

enum board_i2c { BOARD_I2C_START_WRITE, BOARD_I2C_START_READ, BOARD_I2C_WRITE, BOARD_I2C_READ, BOARD_I2C_STOP };

/* What the board sees of the world while it runs. */
struct board_outside {
    /* One step of a transfer at `ns`. START: data[0] is the address; returns 1 where it is acknowledged. WRITE: returns
     * how many of the bytes are. READ: fills data. */
    int32_t (*i2c)(uint64_t ns, int32_t operation, uint8_t *data, int32_t length);
    /* When the data-ready line rises next after `ns`, or BOARD_NEVER. */
    uint64_t (*edge)(uint64_t ns);
};

enum board_event { BOARD_BYTE, BOARD_LIGHT, BOARD_RELAY, BOARD_TRIGGER, BOARD_RESET };

/* Something that left the board at `ns`: a byte whose stop bit ends then, a duty in 1/255, a level. After BOARD_RESET
 * (a cause), bytes that would have ended later are lost. */
struct board_output {
    uint64_t ns;
    int32_t event;
    int32_t value;
};

struct board;

/* `image`: the flash, for a board that needs one. Returns NULL when that cannot be. */
struct board *board_open(struct board_outside outside, const uint8_t *image, uint32_t image_size, uint32_t serial);
void board_close(struct board *board);

/* Run until `ns`. */
void board_run(struct board *board, uint64_t ns);

/* Take up to `room` of what left the board, oldest first; returns how many. */
uint32_t board_take(struct board *board, struct board_output *outputs, uint32_t room);

/* The stop bit of `byte` from the host ends at `ns`, which is not before the time run to. */
void board_receive(struct board *board, uint64_t ns, uint8_t byte);

/* From now on. `stuck`: a sensor holds SDA low until it was clocked so many times; 255: for ever; 0: it lets go. */
void board_set_estop(struct board *board, bool open);
void board_set_stuck(struct board *board, uint8_t clocks);

/* Restart with this cause (protocol.h, RESET_...). */
void board_reset(struct board *board, uint8_t cause);

/* Stop executing, as a program that hangs: interrupts go on, the main loop does not. */
void board_hang(struct board *board, bool hangs);

/* Identifies the interface. */
uint32_t board_abi(void);
#define BOARD_ABI 1

#endif
