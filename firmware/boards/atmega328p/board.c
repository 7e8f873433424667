/* ATmega328P at 16 MHz: Arduino Nano or Uno. Pins: see firmware/README.md.
 *
 * Timer 0: the safety tick. Timer 1: time. Timer 2: the light's PWM at 7.8 kHz. */
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <util/delay.h>

#include "../../core/head.h"
#include "../../hal/hal.h"

#define IMU_READY PD2 /* INT0 */
#define LIGHT PD3     /* OC2B */
#define RELAY PD4
#define ESTOP PD5
#define SDA PC4
#define SCL PC5

#define BYTE_US (10U * 1000000UL / BAUD)

static struct head head;
static volatile bool woken; /* an interrupt has work for the main loop */
static uint8_t reset_flags __attribute__((section(".noinit")));

/* Runs before main, because the watchdog is still on after a watchdog reset, with 16 ms. */
static void store_reset_flags(void) __attribute__((naked, used, section(".init3")));
static void store_reset_flags(void) {
    reset_flags = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

/* -- time -------------------------------------------------------------------------------------------------------- */

static volatile uint32_t overflows;

ISR(TIMER1_OVF_vect) {
    overflows++;
}

/* Call it with interrupts off. */
static uint32_t micros_locked(void) {
    uint16_t low = TCNT1;
    uint32_t high = overflows;
    if (TIFR1 & _BV(TOV1) && low < 0x8000) {
        high++; /* the timer has just overflowed; the interrupt has not counted it yet */
    }
    return (high << 15) + (low >> 1); /* timer 1 counts half microseconds */
}

uint32_t hal_micros(void) {
    uint8_t before = hal_lock();
    uint32_t now = micros_locked();
    hal_unlock(before);
    return now;
}

uint8_t hal_lock(void) {
    uint8_t before = SREG;
    cli();
    return before;
}

void hal_unlock(uint8_t before) {
    SREG = before;
}

void hal_feed_watchdog(void) {
    wdt_reset();
}

ISR(TIMER0_COMPA_vect) {
    static uint8_t ticks;
    head_tick(&head);
    if (head.changed || ++ticks >= 1000 / TICK_US) { /* the main loop's waits need a resolution of only 1 ms */
        ticks = 0;
        woken = true;
    }
}

/* -- serial connection ------------------------------------------------------------------------------------------- */

#define RECEIVER 64U /* powers of two */
#define TRANSMITTER 128U

static uint8_t received[RECEIVER], transmitted[TRANSMITTER];
static volatile uint8_t received_in, received_out, overruns, transmitted_in, transmitted_out;
static volatile uint32_t frame_us;

ISR(USART_RX_vect) {
    bool lost = UCSR0A & _BV(DOR0);
    uint8_t byte = UDR0;
    uint8_t next = (received_in + 1U) & (RECEIVER - 1U);
    if (byte == 0) {
        frame_us = micros_locked();
    }
    if (next == received_out || lost) {
        overruns++;
    }
    if (next != received_out) {
        received[received_in] = byte;
        received_in = next;
    }
    woken = true;
}

ISR(USART_UDRE_vect) {
    if (transmitted_in == transmitted_out) {
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
    } else {
        UDR0 = transmitted[transmitted_out];
        transmitted_out = (transmitted_out + 1U) & (TRANSMITTER - 1U);
    }
}

bool hal_uart_read(uint8_t *byte) {
    if (received_in == received_out) {
        return false;
    }
    *byte = received[received_out];
    received_out = (received_out + 1U) & (RECEIVER - 1U);
    return true;
}

uint32_t hal_uart_frame_us(void) {
    uint8_t before = hal_lock();
    uint32_t us = frame_us;
    hal_unlock(before);
    return us;
}

uint8_t hal_uart_overruns(void) {
    uint8_t before = hal_lock();
    uint8_t lost = overruns;
    overruns = 0;
    hal_unlock(before);
    return lost;
}

static uint8_t queued(void) {
    return (transmitted_in - transmitted_out) & (TRANSMITTER - 1U);
}

bool hal_uart_write(const uint8_t *bytes, uint8_t length) {
    if (queued() + length > TRANSMITTER - 1U) {
        return false;
    }
    while (length--) {
        transmitted[transmitted_in] = *bytes++;
        transmitted_in = (transmitted_in + 1U) & (TRANSMITTER - 1U);
    }
    UCSR0B |= _BV(UDRIE0);
    return true;
}

uint16_t hal_uart_backlog_us(void) {
    return (uint16_t)(queued() * BYTE_US);
}

/* -- I2C --------------------------------------------------------------------------------------------------------- */

#define TWI_GO (_BV(TWINT) | _BV(TWEN) | _BV(TWIE))

static struct {
    const uint8_t *write;
    uint8_t *read;
    uint8_t address, to_write, to_read;
    volatile enum hal_i2c_result result;
} i2c;

static void i2c_end(enum hal_i2c_result result) {
    TWCR = _BV(TWINT) | _BV(TWEN) | _BV(TWSTO);
    i2c.result = result;
    woken = true;
}

/* After an acknowledge: continue with the next byte, change to reading, or end. */
static void i2c_next(void) {
    if (i2c.to_write) {
        i2c.to_write--;
        TWDR = *i2c.write++;
        TWCR = TWI_GO;
    } else if (i2c.to_read) {
        TWCR = TWI_GO | _BV(TWSTA);
    } else {
        i2c_end(HAL_I2C_DONE);
    }
}

ISR(TWI_vect) {
    switch (TWSR & 0xF8) {
    case 0x08: /* start */
    case 0x10: /* repeated start */
        TWDR = (uint8_t)(i2c.address << 1 | (i2c.to_write ? 0 : 1));
        TWCR = TWI_GO;
        break;
    case 0x18: /* address acknowledged, for writing */
    case 0x28: /* byte acknowledged */
        i2c_next();
        break;
    case 0x50: /* byte received and acknowledged */
        *i2c.read++ = TWDR;
        i2c.to_read--;
        /* fall through */
    case 0x40: /* address acknowledged, for reading: acknowledge all bytes but the last */
        TWCR = i2c.to_read > 1 ? TWI_GO | _BV(TWEA) : TWI_GO;
        break;
    case 0x58: /* last byte received */
        *i2c.read = TWDR;
        i2c.to_read = 0;
        i2c_end(HAL_I2C_DONE);
        break;
    case 0x20:
    case 0x30:
    case 0x48:
        i2c_end(HAL_I2C_NACK);
        break;
    default: /* arbitration lost, or a bus error */
        i2c_end(HAL_I2C_ERROR);
        break;
    }
}

void hal_i2c_start(uint8_t address, const uint8_t *write, uint8_t write_length, uint8_t *read, uint8_t read_length) {
    i2c.address = address;
    i2c.write = write;
    i2c.to_write = write_length;
    i2c.read = read;
    i2c.to_read = read_length;
    i2c.result = HAL_I2C_BUSY;
    TWBR = (F_CPU / 400000UL - 16) / 2;
    TWSR = 0;
    TWCR = TWI_GO | _BV(TWSTA);
}

enum hal_i2c_result hal_i2c_result(void) {
    return i2c.result;
}

bool hal_i2c_free(void) {
    TWCR = 0;
    i2c.result = HAL_I2C_ERROR;
    PORTC &= (uint8_t) ~(_BV(SDA) | _BV(SCL)); /* a pin either drives its signal low or releases it */
    for (uint8_t i = 0; i < 9 && !(PINC & _BV(SDA)); i++) {
        DDRC |= _BV(SCL);
        _delay_us(5);
        DDRC &= (uint8_t)~_BV(SCL);
        _delay_us(5);
    }
    DDRC |= _BV(SDA); /* a stop: SDA rises while SCL is high */
    _delay_us(5);
    DDRC &= (uint8_t)~_BV(SDA);
    _delay_us(5);
    return (PINC & (_BV(SDA) | _BV(SCL))) == (_BV(SDA) | _BV(SCL));
}

static volatile uint16_t edges;
static volatile uint32_t edge_us;

ISR(INT0_vect) {
    edge_us = micros_locked();
    edges++;
    woken = true;
}

uint16_t hal_imu_edges(uint32_t *last_us) {
    uint8_t before = hal_lock();
    uint16_t count = edges;
    *last_us = edge_us;
    hal_unlock(before);
    return count;
}

/* -- outputs and inputs ------------------------------------------------------------------------------------------ */

void hal_light(uint8_t level) {
    OCR2B = level;
    if (level) {
        TCCR2A = _BV(COM2B1) | _BV(WGM21) | _BV(WGM20); /* fast PWM, 16 MHz / 8 */
        TCCR2B = _BV(CS21);
    } else {
        TCCR2A = 0; /* a duty of 0 would still be one clock of light */
        TCCR2B = 0;
    }
}

void hal_relay(bool closed) {
    if (closed) {
        PORTD |= _BV(RELAY);
    } else {
        PORTD &= (uint8_t)~_BV(RELAY);
    }
}

bool hal_estop_open(void) {
    return PIND & _BV(ESTOP);
}

/* -- identity ---------------------------------------------------------------------------------------------------- */

uint8_t hal_board(void) {
    return BOARD_ATMEGA328P;
}

uint8_t hal_reset_cause(void) {
    if (reset_flags & _BV(WDRF)) {
        return RESET_WATCHDOG;
    }
    if (reset_flags & _BV(PORF)) { /* the brown-out flag is set, too, because the supply rose through the threshold */
        return RESET_POWER_ON;
    }
    if (reset_flags & _BV(BORF)) {
        return RESET_BROWN_OUT;
    }
    return reset_flags & _BV(EXTRF) ? RESET_EXTERNAL : RESET_UNKNOWN;
}

uint32_t hal_serial(void) {
    return eeprom_read_dword((const uint32_t *)0);
}

void hal_store_serial(uint32_t serial) {
    eeprom_update_dword((uint32_t *)0, serial);
}

int main(void) {
    PORTD = _BV(ESTOP); /* pull-up: an open loop reads high */
    DDRD = _BV(LIGHT) | _BV(RELAY);

    TCCR0A = _BV(WGM01); /* clear on match, 16 MHz / 64 */
    OCR0A = F_CPU / 64 * TICK_US / 1000000UL - 1;
    TCCR0B = _BV(CS01) | _BV(CS00);
    TIMSK0 = _BV(OCIE0A);

    TCCR1B = _BV(CS11); /* 16 MHz / 8 */
    TIMSK1 = _BV(TOIE1);

    UCSR0A = _BV(U2X0);
    UBRR0 = F_CPU / 8 / BAUD - 1;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);

    EICRA = _BV(ISC01) | _BV(ISC00); /* rising edge */
    EIFR = _BV(INTF0);
    EIMSK = _BV(INT0);

    i2c.result = HAL_I2C_DONE;
    head_init(&head);
    wdt_enable(WDTO_120MS);
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
    for (;;) {
        cli();
        if (!woken) {
            sleep_enable();
            sei(); /* takes effect after the next instruction, so no interrupt comes between */
            sleep_cpu();
            sleep_disable();
        }
        woken = false;
        sei();
        head_step(&head);
    }
}
