/* Interface between core and board. All functions but hal_store_serial are short and never wait. */
#ifndef HEAD_HAL_H
#define HEAD_HAL_H

#include <stdbool.h>
#include <stdint.h>

/* -- time, interrupts, watchdog ---------------------------------------------------------------------------------- */

/* Return the microseconds since the start; they wrap after 71.6 minutes. */
uint32_t hal_micros(void);

/* Lock out the safety tick between the two calls; pass the result of `hal_lock` to `hal_unlock`. */
uint8_t hal_lock(void);
void hal_unlock(uint8_t before);

void hal_feed_watchdog(void);

/* -- connection to the host ---------------------------------------------------------------------------------------- */

/* Take the next received byte; returns false if there is none. */
bool hal_uart_read(uint8_t *byte);

/* Return the time at which the last zero byte (the end of a frame) was received. */
uint32_t hal_uart_frame_us(void);

/* Return the number of bytes that the receiver lost since the last call. */
uint8_t hal_uart_overruns(void);

/* Queue all bytes; if they do not fit, queue none and return false. */
bool hal_uart_write(const uint8_t *bytes, uint8_t length);

/* Return the time until the transmission of a byte that is queued now begins. */
uint16_t hal_uart_backlog_us(void);

/* -- I2C, one transfer at a time, in the background -------------------------------------------------------------- */

enum hal_i2c_result { HAL_I2C_BUSY, HAL_I2C_DONE, HAL_I2C_NACK, HAL_I2C_ERROR };

/* Write `write_length` bytes, then after a repeated start read `read_length`; the board uses the buffers until
 * the transfer has ended. At least one of the lengths is not 0. */
void hal_i2c_start(uint8_t address, const uint8_t *write, uint8_t write_length, uint8_t *read, uint8_t read_length);
enum hal_i2c_result hal_i2c_result(void);

/* Abort the transfer, free the bus with up to nine clock pulses, and end with a stop.
 * Returns whether the bus is free: SDA and SCL high. */
bool hal_i2c_free(void);

/* Return the number of the sensor's data-ready edges; `*last_us` is the time of the last one. */
uint16_t hal_imu_edges(uint32_t *last_us);

/* -- outputs and inputs ------------------------------------------------------------------------------------------ */

void hal_light(uint8_t level);
void hal_relay(bool closed);

/* Return whether the e-stop loop is open: pressed, unplugged or broken. */
bool hal_estop_open(void);

/* -- identity -------------------------------------------------------------------------------------------------- */

uint8_t hal_board(void);
uint8_t hal_reset_cause(void);
uint32_t hal_serial(void);

/* Store the serial number in permanent memory; the only function that may take some milliseconds. */
void hal_store_serial(uint32_t serial);

#endif
