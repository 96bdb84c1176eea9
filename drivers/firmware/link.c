/* Bytes and frames. Stop bytes are obeyed where they are received; a few frames may wait for the main
 * loop, which a fast motion keeps from them for longer than one takes to come. */
#include "link.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>
#include <util/crc16.h>

#include "board.h"
#include "motion.h"
#include "protocol.h"

#define SENDING 128 /* bytes, a power of two */
#define WAITING 4   /* frames, a power of two; one of them is being received */

typedef struct {
    uint8_t held; /* bytes of the body so far */
    uint8_t stops;
    uint8_t body[FRAME_LONGEST];
} received_t;

static bool framing;
static bool escaped;
static volatile bool overrun;
static received_t received[WAITING];
static volatile uint8_t filling, reading; /* equal: none waits */

static uint8_t sending[SENDING];
static volatile uint8_t put, got;

ISR(USART_RX_vect) {
    uint8_t damaged = UCSR0A & ((1u << FE0) | (1u << DOR0));
    uint8_t byte = UDR0;
    if (byte == BYTE_HALT || byte == BYTE_BRAKE) {
        if (byte == BYTE_HALT) {
            motion_halt();
        } else {
            motion_brake();
        }
        framing = false;
        return;
    }
    if (damaged) {
        framing = false;
        return;
    }
    if (byte == BYTE_START) {
        framing = ((filling + 1) & (WAITING - 1)) != reading;
        overrun |= !framing;
        escaped = false;
        received[filling].held = 0;
        return;
    }
    if (!framing) {
        return;
    }
    received_t *frame = &received[filling];
    if (byte == BYTE_END) {
        framing = false;
        frame->stops = motion_stops();
        filling = (filling + 1) & (WAITING - 1);
    } else if (byte == BYTE_ESCAPE) {
        escaped = true;
    } else if (byte >= BYTE_CONTROL || frame->held == FRAME_LONGEST) {
        framing = false;
    } else {
        frame->body[frame->held++] = escaped ? byte ^ ESCAPE_FLIP : byte;
        escaped = false;
    }
}

ISR(USART_UDRE_vect) {
    if (got == put) {
        UCSR0B &= (uint8_t)~(1u << UDRIE0);
        return;
    }
    UDR0 = sending[got];
    got = (got + 1) & (SENDING - 1);
}

void link_init(void) {
    UBRR0 = F_CPU / 16 / BAUD - 1;
    UCSR0A = 0;
    UCSR0C = (1u << UCSZ01) | (1u << UCSZ00);
    UCSR0B = (1u << RXEN0) | (1u << TXEN0) | (1u << RXCIE0);
}

static uint16_t crc_of(const uint8_t *bytes, uint8_t length) {
    uint16_t crc = 0xFFFF;
    while (length--) {
        crc = _crc_xmodem_update(crc, *bytes++);
    }
    return crc;
}

bool link_receive(frame_t *frame) {
    if (reading == filling) {
        return false;
    }
    const received_t *waiting = &received[reading];
    uint8_t length = waiting->held;
    for (uint8_t i = 0; i < length; i++) {
        frame->body[i] = waiting->body[i];
    }
    frame->stops = waiting->stops;
    reading = (reading + 1) & (WAITING - 1);
    if (length < 4) {
        frame->length = 0;
        frame->intact = false;
        return true;
    }
    frame->length = (uint8_t)(length - 2);
    uint16_t crc = frame->body[length - 2] | (uint16_t)frame->body[length - 1] << 8;
    frame->intact = crc == crc_of(frame->body, frame->length);
    return true;
}

bool link_waiting(void) { return reading != filling || overrun; }

bool link_overrun(void) {
    bool was;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        was = overrun;
        overrun = false;
    }
    return was;
}

static void send_byte(uint8_t byte) {
    uint8_t next = (put + 1) & (SENDING - 1);
    while (next == got) {
    }
    sending[put] = byte;
    put = next;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { UCSR0B |= 1u << UDRIE0; }
}

static void send_data(uint8_t byte) {
    if (byte >= BYTE_CONTROL) {
        send_byte(BYTE_ESCAPE);
        byte ^= ESCAPE_FLIP;
    }
    send_byte(byte);
}

void link_send(const uint8_t *body, uint8_t length) {
    uint16_t crc = crc_of(body, length);
    send_byte(BYTE_START);
    while (length--) {
        send_data(*body++);
    }
    send_data((uint8_t)crc);
    send_data((uint8_t)(crc >> 8));
    send_byte(BYTE_END);
}
