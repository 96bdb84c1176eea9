/* An open lens controller: says what it does, does what it is told, stops when nobody speaks. See README.md. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <string.h>

#include "board.h"
#include "link.h"
#include "motion.h"
#include "protocol.h"

#define SLOWEST_RAMP 50UL       /* steps/s2: below, an interval no longer fits */
#define STEEPEST_RAMP 4000000UL /* steps/s2 */
#define FASTEST 16000u          /* steps/s */

static uint16_t get16(const uint8_t *at) { return at[0] | (uint16_t)at[1] << 8; }
static uint32_t get32(const uint8_t *at) { return get16(at) | (uint32_t)get16(at + 2) << 16; }

static uint8_t *put16(uint8_t *at, uint16_t value) {
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
    return at + 2;
}

static uint8_t *put32(uint8_t *at, uint32_t value) { return put16(put16(at, (uint16_t)value), (uint16_t)(value >> 16)); }

static uint8_t configure(const uint8_t *payload) {
    uint32_t acceleration = get32(payload);
    uint16_t speed = get16(payload + 4);
    int32_t min = (int32_t)get32(payload + 6), max = (int32_t)get32(payload + 10);
    uint16_t dead_man_ms = get16(payload + 14);
    if (acceleration < SLOWEST_RAMP || acceleration > STEEPEST_RAMP || speed < 2 || speed > FASTEST || min >= max ||
        min < INT32_MIN / 2 || max > INT32_MAX / 2 || dead_man_ms < 10) {
        return STATUS_RANGE;
    }
    return motion_configure(acceleration, speed, min, max, dead_man_ms, get16(payload + 16)) ? STATUS_OK
                                                                                             : STATUS_MOVING;
}

static uint8_t set_position(const uint8_t *payload) {
    int32_t position = (int32_t)get32(payload);
    if (position < INT32_MIN / 2 || position > INT32_MAX / 2) {
        return STATUS_RANGE;
    }
    return motion_set_position(position) ? STATUS_OK : STATUS_MOVING;
}

static uint8_t obey(const frame_t *frame) {
    static const uint8_t lengths[] = {[CMD_HELLO] = 0,        [CMD_STATUS] = 0, [CMD_CONFIGURE] = 18, [CMD_GO] = 8,
                                      [CMD_SET_POSITION] = 4, [CMD_HOME] = 6,   [CMD_IRIS] = 1,       [CMD_ENABLE] = 1};
    uint8_t command = frame->body[1];
    const uint8_t *payload = frame->body + 2;
    if (command == 0 || command >= sizeof lengths) {
        return STATUS_UNKNOWN;
    }
    if (frame->length - 2 != lengths[command]) {
        return STATUS_LENGTH;
    }
    switch (command) {
        case CMD_CONFIGURE:
            return configure(payload);
        case CMD_GO:
            return motion_go((int32_t)get32(payload), get16(payload + 4), get16(payload + 6), frame->stops);
        case CMD_SET_POSITION:
            return set_position(payload);
        case CMD_HOME:
            return motion_home(get16(payload), get16(payload + 2), get16(payload + 4), frame->stops);
        case CMD_IRIS:
            if (payload[0] > 1) {
                return STATUS_RANGE;
            }
            PORTD = payload[0] ? PORTD | (1u << IRIS_BIT) : PORTD & (uint8_t)~(1u << IRIS_BIT);
            return STATUS_OK;
        case CMD_ENABLE:
            if (payload[0] > 1) {
                return STATUS_RANGE;
            }
            motion_enable(payload[0]);
            return STATUS_OK;
        default:
            return STATUS_OK;
    }
}

/* seq, command | 0x80, status, flags u16, position i32, velocity i32, stamp u32, step stamp u32 */
static void reply(uint8_t sequence, uint8_t command, uint8_t status) {
    uint8_t body[FRAME_LONGEST], *at = body;
    motion_sample_t sample = motion_sample();
    *at++ = sequence;
    *at++ = command | 0x80;
    *at++ = status;
    at = put16(at, sample.flags);
    at = put32(at, (uint32_t)sample.position);
    at = put32(at, (uint32_t)sample.velocity);
    at = put32(at, sample.stamp);
    at = put32(at, sample.step_stamp);
    if (command == CMD_HELLO && status == STATUS_OK) {
        *at++ = PROTOCOL_VERSION;
        memcpy(at, "elpd-avr", 8);
        at += 8;
    }
    link_send(body, (uint8_t)(at - body));
}

/* Sleep (idle, which is what SMCR says after a reset) until an interrupt, unless one has already left something to do: the check and the sleep are one. */
static void idle(void) {
    cli();
    if (!link_waiting()) {
        sleep_enable();
        sei();
        sleep_cpu();
        sleep_disable();
    }
    sei();
}

int main(void) {
    MCUSR = 0;
    wdt_enable(WDTO_120MS);
    DDRD |= 1u << IRIS_BIT;
    motion_init();
    link_init();
    sei();
    for (;;) {
        wdt_reset();
        motion_poll();
        frame_t frame;
        if (link_overrun()) {
            reply(0, 0, STATUS_OVERRUN);
        }
        if (!link_receive(&frame)) {
            idle();
            continue;
        }
        if (!frame.intact) {
            reply(frame.length ? frame.body[0] : 0, 0, STATUS_BAD_CRC);
            continue;
        }
        motion_heard();
        reply(frame.body[0], frame.body[1], obey(&frame));
    }
}
