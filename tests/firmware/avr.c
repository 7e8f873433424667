/* The flashed binary on an emulated ATmega328P (libsimavr), behind the interface of firmware/boards/host/board.h.
 *
 * The emulator runs from one event to the next: a byte from the host, a data-ready edge, the end of the run. An event
 * takes effect at the first instruction that begins at or after it, so the result does not depend on how a run is
 * divided. */
#include "board.h"

#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include <avr_eeprom.h>
#include <avr_extint.h>
#include <avr_ioport.h>
#include <avr_timer.h>
#include <avr_twi.h>
#include <avr_uart.h>
#include <sim_avr.h>
#include <sim_interrupts.h>

#include "protocol.h"

#define F_CPU 16000000ULL
#define BYTE_CYCLES (10 * F_CPU / BAUD)
#define EDGE_CYCLES (50 * F_CPU / 1000000) /* the sensor's pulse */
#define QUEUE 8192U
#define FOREVER UINT8_MAX

enum { MCUSR = 0x54, TWCR = 0xBC, TCCR2A = 0xB0, OCR2B = 0xB4, PORTD = 0x2B, PORF = 1, EXTRF = 2, BORF = 4, WDRF = 8 };
enum { D_READY = 2, D_LIGHT = 3, D_RELAY = 4, D_ESTOP = 5, C_SDA = 4, C_SCL = 5 };
enum { OP_RJMP_SELF = 0xCFFF };

struct arriving {
    uint64_t cycle;
    uint8_t byte;
};

struct board {
    avr_t *avr;
    struct board_outside outside;
    uint64_t base; /* cycles before the last reset, if the reset starts the emulator's count again (simavr 1.7) */
    uint64_t last; /* the emulator's count at the last check */
    bool was_reset;
    void (*reset)(avr_t *avr); /* the core's own */
    uint32_t flash_size;

    struct arriving arriving[QUEUE];
    uint32_t arriving_head, arriving_count;
    struct board_output out[QUEUE];
    uint32_t out_head, out_count;

    uint64_t next_edge, edge_falls;
    avr_irq_t *uart_in, *ready, *estop, *sda, *twi_in;
    bool estop_open, scl;
    uint8_t stuck;
    int32_t light, relay;

    /* I2C: the emulator's function for writes to TWCR, which must not be called while the bus is stuck. */
    avr_io_write_t write_twcr;
    void *write_twcr_param;
    uint8_t address;
    bool acknowledged;
};

static uint64_t cycle_now(const struct board *b) {
    return b->base + b->avr->cycle;
}

static uint64_t to_ns(uint64_t cycle) {
    return cycle * 125 / 2;
}

static uint64_t to_cycle(uint64_t ns) {
    return ns == BOARD_NEVER ? BOARD_NEVER : (ns * 2 + 124) / 125;
}

static void emit(struct board *b, uint64_t cycle, enum board_event event, int32_t value) {
    if (b->out_count < QUEUE) {
        struct board_output *slot = &b->out[(b->out_head + b->out_count++) % QUEUE];
        slot->ns = to_ns(cycle);
        slot->event = event;
        slot->value = value;
    }
}

/* -- outputs of the microcontroller -------------------------------------------------------------------------------- */

static void on_byte(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    struct board *b = param;
    emit(b, cycle_now(b) + BYTE_CYCLES, BOARD_BYTE, (int32_t)(value & 0xFF));
}

static void set(struct board *b, int32_t *pin, enum board_event event, int32_t value) {
    if (*pin != value) {
        *pin = value;
        emit(b, cycle_now(b), event, value);
    }
}

static void on_relay(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    struct board *b = param;
    set(b, &b->relay, BOARD_RELAY, value & 1);
}

/* The light's duty: the compare value while the timer drives the pin, else the port's level. */
static void update_light(struct board *b) {
    const uint8_t *data = b->avr->data;
    int32_t level = data[PORTD] >> D_LIGHT & 1 ? 255 : 0;
    set(b, &b->light, BOARD_LIGHT, data[TCCR2A] & 0x20 ? data[OCR2B] : level);
}

static void on_light_register(struct avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param) {
    avr->data[addr] = value;
    update_light(param);
}

static void on_light_port(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)value;
    update_light(param);
}

/* -- I2C ----------------------------------------------------------------------------------------------------------- */

static int32_t ask(struct board *b, int32_t operation, uint8_t *data, int32_t length) {
    return b->outside.i2c(to_ns(cycle_now(b)), operation, data, length);
}

static void schedule_edge(struct board *b) {
    b->next_edge = to_cycle(b->outside.edge(to_ns(cycle_now(b))));
}

static void on_twi(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    struct board *b = param;
    avr_twi_msg_irq_t message = {.u.v = value};
    uint8_t condition = message.u.twi.msg, byte;
    if (condition & TWI_COND_STOP) {
        ask(b, BOARD_I2C_STOP, &b->address, 0);
        b->acknowledged = false;
        schedule_edge(b); /* the write may have switched the signal on or off */
    }
    if (condition & TWI_COND_START) {
        b->address = (uint8_t)(message.u.twi.addr >> 1);
        b->acknowledged = ask(b, message.u.twi.addr & 1 ? BOARD_I2C_START_READ : BOARD_I2C_START_WRITE, &b->address, 1);
        if (b->acknowledged) {
            avr_raise_irq(b->twi_in, avr_twi_irq_msg(TWI_COND_ACK, message.u.twi.addr, 1));
        }
    }
    if (condition & TWI_COND_WRITE && b->acknowledged) {
        byte = message.u.twi.data;
        bool taken = ask(b, BOARD_I2C_WRITE, &byte, 1) == 1;
        avr_raise_irq(b->twi_in, avr_twi_irq_msg(TWI_COND_ACK, message.u.twi.addr, taken));
    }
    if (condition & TWI_COND_READ && b->acknowledged) {
        byte = 0xFF;
        ask(b, BOARD_I2C_READ, &byte, 1);
        avr_raise_irq(b->twi_in, avr_twi_irq_msg(TWI_COND_READ, message.u.twi.addr, byte));
    }
}

/* A start condition on a stuck bus waits forever: the hardware never reports that it was sent. */
static void on_twcr(struct avr_t *avr, avr_io_addr_t addr, uint8_t value, void *param) {
    struct board *b = param;
    if (b->stuck && value & 0x20 /* TWSTA */) {
        avr->data[addr] = value & 0x7F;
    } else {
        b->write_twcr(avr, addr, value, b->write_twcr_param);
    }
}

static void set_external(struct board *b, char port, uint8_t mask, uint8_t value) {
    avr_ioport_external_t external = {.name = (unsigned)port & 0x7F, .mask = mask, .value = value};
    avr_ioctl(b->avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &external);
}

static void drive_bus(struct board *b) {
    set_external(b, 'C', 1 << C_SDA | 1 << C_SCL, (uint8_t)(1 << C_SCL | (b->stuck ? 0 : 1 << C_SDA)));
    avr_raise_irq(b->sda, !b->stuck);
}

/* Count the clock pulses by which the firmware frees the bus; it uses SCL as a plain pin. */
static void on_scl(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    struct board *b = param;
    bool high = value & 1;
    bool rises = high && !b->scl;
    b->scl = high;
    if (rises && b->stuck && b->stuck != FOREVER && --b->stuck == 0) {
        drive_bus(b);
    }
}

/* -- power-up and reset -------------------------------------------------------------------------------------------- */

static void no_sleep(avr_t *avr, avr_cycle_count_t cycles) {
    (void)avr;
    (void)cycles; /* the caller counts them; no real time passes */
}

static void no_log(avr_t *avr, const int level, const char *format, va_list ap) {
    (void)avr;
    (void)level;
    (void)format;
    (void)ap;
}

static void on_reset(avr_t *avr) {
    struct board *b = avr->custom.data;
    b->was_reset = true;
    b->reset(avr);
}

/* Connect the surroundings again, after power-up or a reset. */
static void wire_up(struct board *b) {
    /* At reset these pins are level-triggered, and simavr would poll low ones in every cycle. */
    avr_extint_set_strict_lvl_trig(b->avr, EXTINT_IRQ_OUT_INT0, 0);
    avr_extint_set_strict_lvl_trig(b->avr, EXTINT_IRQ_OUT_INT1, 0);
    set_external(b, 'D', 1 << D_READY | 1 << D_ESTOP, (uint8_t)(b->estop_open ? 1 << D_ESTOP : 0));
    avr_raise_irq(b->estop, b->estop_open);
    avr_raise_irq(b->ready, 0);
    b->scl = true;
    drive_bus(b);
    b->edge_falls = BOARD_NEVER;
    set(b, &b->light, BOARD_LIGHT, 0); /* pins are inputs again; external resistors pull them to their inactive levels */
    set(b, &b->relay, BOARD_RELAY, 0);
    schedule_edge(b);
}

uint32_t board_abi(void) {
    return BOARD_ABI;
}

struct board *board_open(struct board_outside outside, const uint8_t *image, uint32_t image_size, uint32_t serial) {
    avr_global_logger_set(no_log);
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    struct board *b = calloc(1, sizeof *b);
    if (!avr || !b || avr_init(avr) || image_size > avr->flashend + 1U) {
        free(b);
        return NULL;
    }
    b->avr = avr;
    b->outside = outside;
    avr->frequency = F_CPU;
    avr->sleep = no_sleep;
    avr->log = LOG_NONE;
    memcpy(avr->flash, image, image_size);
    avr->codeend = avr->flashend;
    b->flash_size = image_size;
    b->reset = avr->reset;
    avr->custom.data = b;
    avr->reset = on_reset;

    avr_eeprom_desc_t eeprom = {.ee = (uint8_t *)&serial, .offset = 0, .size = sizeof serial};
    avr_ioctl(avr, AVR_IOCTL_EEPROM_SET, &eeprom);

    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);

    b->uart_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    b->twi_in = avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT);
    b->ready = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), D_READY);
    b->estop = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), D_ESTOP);
    b->sda = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('C'), C_SDA);
    avr_irq_t *scl = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('C'), C_SCL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), on_twi, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), D_RELAY), on_relay, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), D_LIGHT), on_light_port, b);
    avr_irq_register_notify(scl, on_scl, b);
    avr_register_io_write(avr, TCCR2A, on_light_register, b);
    avr_register_io_write(avr, OCR2B, on_light_register, b);
    b->write_twcr = avr->io[AVR_DATA_TO_IO(TWCR)].w.c;
    b->write_twcr_param = avr->io[AVR_DATA_TO_IO(TWCR)].w.param;
    avr->io[AVR_DATA_TO_IO(TWCR)].w.c = on_twcr;
    avr->io[AVR_DATA_TO_IO(TWCR)].w.param = b;

    wire_up(b);
    avr->data[MCUSR] = PORF;
    return b;
}

void board_close(struct board *b) {
    avr_terminate(b->avr);
    free(b->avr);
    free(b);
}

static void take_reset(struct board *b, uint8_t cause) {
    if (b->avr->cycle < b->last) {
        b->base += b->last;
    }
    b->last = b->avr->cycle;
    b->was_reset = false;
    emit(b, cycle_now(b), BOARD_RESET, cause);
    wire_up(b);
}

void board_reset(struct board *b, uint8_t cause) {
    b->last = b->avr->cycle;
    avr_reset(b->avr);
    take_reset(b, cause);
    b->avr->data[MCUSR] = cause == RESET_POWER_ON    ? PORF
                          : cause == RESET_BROWN_OUT ? BORF
                          : cause == RESET_EXTERNAL  ? EXTRF
                                                     : 0;
}

/* -- the interface of board.h -------------------------------------------------------------------------------------- */

void board_set_estop(struct board *b, bool open) {
    b->estop_open = open;
    set_external(b, 'D', 1 << D_READY | 1 << D_ESTOP, (uint8_t)(open ? 1 << D_ESTOP : 0));
    avr_raise_irq(b->estop, open);
}

void board_set_stuck(struct board *b, uint8_t clocks) {
    b->stuck = clocks;
    drive_bus(b);
}

/* Make the main loop jump to the endless loop that avr-libc appends to every program. */
void board_hang(struct board *b, bool hangs) {
    if (!hangs) {
        return;
    }
    for (uint32_t at = 0; at + 1 < b->flash_size; at += 2) {
        if ((b->avr->flash[at] | b->avr->flash[at + 1] << 8) == OP_RJMP_SELF) {
            while (!(b->avr->sreg[S_I] && b->avr->state == cpu_Sleeping)) { /* until it is in the main loop */
                avr_run(b->avr);
            }
            b->avr->pc = at;
            b->avr->state = cpu_Running;
            return;
        }
    }
}

void board_receive(struct board *b, uint64_t ns, uint8_t byte) {
    if (b->arriving_count < QUEUE) {
        struct arriving *slot = &b->arriving[(b->arriving_head + b->arriving_count++) % QUEUE];
        uint64_t cycle = to_cycle(ns);
        slot->cycle = cycle > BYTE_CYCLES ? cycle - BYTE_CYCLES : 0; /* its first bit: the emulator simulates the transmission */
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

/* -- running ------------------------------------------------------------------------------------------------------- */

/* Due again in the next cycle. If it were due once, in the very cycle in which the firmware begins to sleep, simavr would
 * sleep on to its next timer. */
static avr_cycle_count_t end_of_run(struct avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)avr;
    (void)param;
    return when + 1;
}

static uint64_t earliest(uint64_t a, uint64_t b) {
    return a < b ? a : b;
}

/* Run to the first instruction at or after `cycle`; returns early after a reset. */
static void run_to(struct board *b, uint64_t cycle) {
    avr_t *avr = b->avr;
    if (cycle_now(b) < cycle) {
        /* The timer ends a sleep or a burst of instructions at this cycle. */
        avr_cycle_timer_register(avr, cycle - cycle_now(b), end_of_run, b);
    }
    while (cycle_now(b) < cycle) {
        b->last = avr->cycle;
        avr_run(avr);
        if (b->was_reset) { /* the watchdog bit */
            take_reset(b, RESET_WATCHDOG);
            return;
        }
    }
    avr_cycle_timer_cancel(avr, end_of_run, b);
}

void board_run(struct board *b, uint64_t ns) {
    uint64_t until = to_cycle(ns);
    for (;;) {
        uint64_t next = earliest(until, earliest(b->next_edge, b->edge_falls));
        if (b->arriving_count) {
            next = earliest(next, b->arriving[b->arriving_head].cycle);
        }
        run_to(b, next);
        uint64_t now = cycle_now(b);
        if (now < next) {
            continue; /* after a reset */
        }
        if (b->next_edge <= now) {
            avr_raise_irq(b->ready, 1);
            b->edge_falls = b->next_edge + EDGE_CYCLES;
            schedule_edge(b);
        }
        if (b->edge_falls <= now) {
            avr_raise_irq(b->ready, 0);
            b->edge_falls = BOARD_NEVER;
        }
        while (b->arriving_count && b->arriving[b->arriving_head].cycle <= now) {
            avr_raise_irq(b->uart_in, b->arriving[b->arriving_head].byte);
            b->arriving_head = (b->arriving_head + 1) % QUEUE;
            b->arriving_count--;
        }
        if (now >= until) {
            return;
        }
    }
}
