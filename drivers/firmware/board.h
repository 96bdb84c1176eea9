/* Pins and clocks of the lens controller: an ATmega328P at 16 MHz (Arduino Uno, Nano, Pro Mini).
 *
 *   D9  PB1  STEP        to the stepper driver, rising edge
 *   D8  PB0  DIR         high: towards larger positions
 *   D10 PB2  ENABLE      low: driver on
 *   D11 PB3  SYNC        an edge at every multiple of so many steps, in the same instruction as the step: to a camera's trigger-in
 *   D2  PD2  LIMIT_MIN   switch to ground, internal pull-up
 *   D3  PD3  LIMIT_MAX   switch to ground, internal pull-up
 *   D5  PD5  IRIS        high: open
 *   D0, D1   UART        500,000 baud, 8N1 (exact at 16 MHz)
 */
#ifndef BOARD_H
#define BOARD_H

#ifndef F_CPU
#define F_CPU 16000000UL
#endif
#define BAUD 500000UL
#define TICK_HZ (F_CPU / 8) /* Timer 1 */

#define STEP_BIT 1u
#define DIR_BIT 0u
#define ENABLE_BIT 2u
#define SYNC_BIT 3u
#define LIMIT_MIN_BIT 2u
#define LIMIT_MAX_BIT 3u
#define IRIS_BIT 5u

#endif
