/* Steps: ramps, limits, the step counter and its time.
 *
 * Timer 1 runs freely at 2 MHz: compare A makes the steps, and its 16 bits, looked at once a millisecond at least, are
 * the clock of every stamp. The ramp is the one of D. Austin, "Generate stepper-motor speed profiles in real time"
 * (Embedded Systems Programming, 2005): with n the number of steps that a ramp from rest has taken, the next interval is
 *
 *     c[n] = c[n-1] - 2 c[n-1] / (4 n + 1),      c[0] = 0.676 f sqrt(2 / a),
 *
 * back the same way,
 *
 *     c[n-1] = c[n] + 2 c[n] / (4 n - 1)
 *
 * (0.676 makes up for what the series loses at its beginning; the first and the last step take the true f sqrt(2 / a)),
 *
 * and n is at the same time how many steps it takes to stop. So a motion brakes when n reaches what is left, and ends on
 * its target exactly. Everything is one motion: towards `bound`, at most at `cruise`; a new target behind is reached by
 * braking to rest and turning round.
 */
#include "motion.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <math.h>
#include <util/atomic.h>

#include "board.h"
#include "protocol.h"

#define FRACTION 8            /* intervals are in ticks / 256 */
#define LONGEST 50000u        /* ticks that one compare may span */
#define SOONEST 8u            /* ticks: a compare nearer than this might be missed */
#define SLOWEST 2u            /* steps per second */
#define FASTEST 16000u        /* steps per second: the ramp's division leaves no time for more */

enum homing { HOMING_NOT, HOMING_IN, HOMING_OUT };

/* Shared with the interrupts. */
static volatile int32_t position;
static volatile uint32_t step_stamp;
static volatile uint32_t looked; /* the time, in ticks, when somebody last asked */
static volatile bool moving;
static volatile bool braking;
static volatile uint16_t notes; /* flags that latch until the next GO */
static volatile uint8_t stops;
static volatile uint16_t quiet_ms;
static volatile uint16_t left_ms; /* of the present motion; 0: no such limit */
static int8_t direction = 1;
static uint32_t interval;  /* of the step to come, ticks / 256 */
static uint32_t cruise;    /* the shortest interval allowed now */
static uint32_t ramp;      /* n: steps from rest, steps to rest */
static int32_t bound;      /* where to be at rest */
static uint32_t waiting;   /* ticks still to pass before the step, beyond the compare that is set */
static uint8_t fraction;
static uint16_t sync_phase; /* position modulo sync_steps */

/* Settings; written only at rest. */
static uint32_t rest_interval; /* from rest to the first step, and from the last to rest: f sqrt(2 / a) */
static uint32_t ramp_interval; /* c[0], what the ramp begins to count from */
static uint16_t max_speed = 1000;
static int32_t soft_min = INT32_MIN / 2;
static int32_t soft_max = INT32_MAX / 2;
static uint16_t dead_man_ms = 500;
static uint16_t sync_steps;

/* Main loop only, but for `referenced`, which a halt does not touch. */
static volatile bool referenced;
static enum homing homing;
static uint16_t homing_slow;
static uint8_t homing_stops;

static inline bool at_min(void) { return !(PIND & (1u << LIMIT_MIN_BIT)); }
static inline bool at_max(void) { return !(PIND & (1u << LIMIT_MAX_BIT)); }
static inline bool blocked(int8_t way) { return way > 0 ? at_max() : at_min(); }

/* The time goes on by what 16 bits say since the last look, which is never a whole turn of theirs ago. */
static uint32_t ticks_now(void) {
    uint32_t now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        now = looked;
        now += (uint16_t)(TCNT1 - (uint16_t)now);
        looked = now;
    }
    return now;
}

/* 2 c / d, by which a ramp's step changes an interval. The compiler's 24-bit division takes 22 us, the 32-bit one 40. */
static uint32_t change(uint32_t of, uint32_t divisor) {
    if (of < 1ul << 22 && divisor < 1ul << 23) {
        return (__uint24)(2 * of) / (__uint24)divisor;
    }
    return 2 * of / divisor;
}

static uint32_t interval_of(uint16_t speed) { return (TICK_HZ << FRACTION) / speed; }

/* Set the compare for the step to come, `ticks` after the last compare. Interrupts are off. */
static void schedule(uint32_t ticks) {
    uint16_t part = ticks > LONGEST ? LONGEST / 2 : (uint16_t)ticks;
    waiting = ticks - part;
    uint16_t due = OCR1A + part;
    if ((int16_t)(due - TCNT1) < (int16_t)SOONEST && part < 0x7000u) {
        due = TCNT1 + SOONEST;
        notes |= FLAG_LATE;
    }
    OCR1A = due;
}

/* Point the motor and set the first step. Interrupts are off. */
static void start(int8_t way) {
    direction = way;
    if (way > 0) {
        PORTB |= 1u << DIR_BIT;
    } else {
        PORTB &= (uint8_t)~(1u << DIR_BIT);
    }
    interval = rest_interval > cruise ? rest_interval : cruise;
    ramp = 0;
    fraction = 0;
    moving = true;
    OCR1A = TCNT1;
    TIFR1 = 1u << OCF1A;
    schedule(interval >> FRACTION);
    TIMSK1 |= 1u << OCIE1A;
}

static void rest(void) {
    TIMSK1 &= (uint8_t)~(1u << OCIE1A);
    moving = false;
    braking = false;
    ramp = 0;
}

/* Count the step that is being made; whether it leads to a multiple of sync_steps, from either side. */
static inline bool sync_reached(void) {
    if (direction > 0) {
        sync_phase = sync_phase + 1 == sync_steps ? 0 : sync_phase + 1;
    } else {
        sync_phase = sync_phase ? sync_phase - 1 : sync_steps - 1;
    }
    return sync_phase == 0;
}

/* Where the position lies between two edges, after it was said anew. Interrupts are off, or nothing moves. */
static void sync_from(int32_t at) {
    if (sync_steps) {
        int32_t rest = at % (int32_t)sync_steps;
        sync_phase = (uint16_t)(rest < 0 ? rest + sync_steps : rest);
    }
}

/* One step, and the plan for the next. The pins change within a microsecond of the compare; the division comes after,
 * with interrupts on, so that a stop byte is obeyed meanwhile. */
ISR(TIMER1_COMPA_vect) {
    if (waiting) {
        schedule(waiting);
        return;
    }
    if (blocked(direction)) {
        rest();
        return;
    }
    uint8_t pins = PORTB | (1u << STEP_BIT);
    if (sync_steps && sync_reached()) {
        pins ^= 1u << SYNC_BIT;
    }
    PORTB = pins;
    step_stamp = ticks_now();
    position += direction;
    TIMSK1 &= (uint8_t)~(1u << OCIE1A); /* not into itself */
    sei();

    int32_t ahead = (bound - position) * direction;
    bool stop = braking || ahead <= (int32_t)ramp;
    uint32_t next = interval;
    bool over = false;
    if (stop) {
        if (ramp == 0) {
            over = true;
        } else {
            next = ramp == 1 ? rest_interval : next + change(next, 4 * ramp - 1);
            ramp--;
        }
    } else if (next > cruise) {
        if (ramp == 0) {
            next = ramp_interval;
        }
        ramp++;
        next -= change(next, 4 * ramp + 1);
        if (next < cruise) {
            next = cruise;
        }
    } else if (next < cruise) {
        if (ramp > 1) {
            next += change(next, 4 * ramp - 1);
            ramp--;
        }
        if (next > cruise || ramp <= 1) {
            next = cruise;
        }
    }
    cli();
    PORTB &= (uint8_t)~(1u << STEP_BIT);
    if (!moving) { /* halted while the plan was made */
        return;
    }
    interval = next;
    if (over) {
        if (braking || position == bound) {
            rest();
        } else {
            start((int8_t)-direction);
        }
        return;
    }
    uint16_t sum = (uint16_t)(interval & 0xFFu) + fraction;
    fraction = (uint8_t)sum;
    schedule((interval >> FRACTION) + (sum >> FRACTION));
    TIMSK1 |= 1u << OCIE1A;
}

/* Once a millisecond: what time it is, how long nobody has spoken, how long this motion may go on. */
ISR(TIMER0_COMPA_vect) {
    ticks_now();
    if (quiet_ms < UINT16_MAX) {
        quiet_ms++;
    }
    if (!moving || braking) {
        return;
    }
    if (quiet_ms >= dead_man_ms) {
        notes |= FLAG_DEAD_MAN;
        braking = true;
    } else if (left_ms && --left_ms == 0) {
        braking = true;
    }
}

void motion_init(void) {
    DDRB |= (1u << STEP_BIT) | (1u << DIR_BIT) | (1u << ENABLE_BIT) | (1u << SYNC_BIT);
    PORTB |= 1u << ENABLE_BIT;
    PORTD |= (1u << LIMIT_MIN_BIT) | (1u << LIMIT_MAX_BIT);
    motion_configure(100000, max_speed, soft_min, soft_max, dead_man_ms, 0);
    TCCR1A = 0;
    TCCR1B = 1u << CS11;
    TCCR0A = 1u << WGM01;
    TCCR0B = (1u << CS01) | (1u << CS00);
    OCR0A = F_CPU / 64 / 1000 - 1;
    TIMSK0 = 1u << OCIE0A;
}

bool motion_configure(uint32_t acceleration, uint16_t speed, int32_t min, int32_t max, uint16_t dead_man,
                      uint16_t sync) {
    if (moving || homing != HOMING_NOT) {
        return false;
    }
    double from_rest = TICK_HZ * sqrt(2.0 / (double)acceleration) * (1 << FRACTION);
    rest_interval = (uint32_t)from_rest;
    ramp_interval = (uint32_t)(0.676 * from_rest);
    max_speed = speed;
    soft_min = min;
    soft_max = max;
    dead_man_ms = dead_man;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        sync_steps = sync;
        sync_from(position);
    }
    return true;
}

uint8_t motion_go(int32_t target, uint16_t speed, uint16_t for_ms, uint8_t heard_stops) {
    if (speed < SLOWEST || speed > max_speed) {
        return STATUS_RANGE;
    }
    if (homing == HOMING_NOT && referenced && (target < soft_min || target > soft_max)) {
        return STATUS_RANGE;
    }
    uint32_t fastest = interval_of(speed);
    uint8_t status = STATUS_OK;
    motion_enable(true);
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        if (heard_stops != stops) {
            return STATUS_STOPPED;
        }
        notes &= (uint16_t)~(FLAG_DEAD_MAN | FLAG_STOPPED | FLAG_LATE);
        bound = target;
        cruise = fastest;
        left_ms = for_ms;
        braking = false;
        if (!moving && target != position) {
            int8_t way = target > position ? 1 : -1;
            if (blocked(way)) {
                status = STATUS_LIMIT;
            } else {
                start(way);
            }
        }
    }
    return status;
}

uint8_t motion_home(uint16_t fast, uint16_t slow, uint16_t for_ms, uint8_t heard_stops) {
    if (fast < SLOWEST || fast > max_speed || slow < SLOWEST || slow > fast) {
        return STATUS_RANGE;
    }
    if (moving || homing != HOMING_NOT) {
        return STATUS_MOVING;
    }
    if (heard_stops != stops) {
        return STATUS_STOPPED;
    }
    referenced = false;
    notes &= (uint16_t)~FLAG_HOMING_FAILED;
    homing_slow = slow;
    homing_stops = heard_stops;
    homing = HOMING_IN;
    left_ms = for_ms;
    return at_min() ? STATUS_OK : motion_go(position - INT32_MAX / 4, fast, for_ms, heard_stops);
}

/* In to the switch, out of it slowly; the step that lets it go is 0. Whatever else ends the motion has failed. */
void motion_poll(void) {
    if (homing == HOMING_IN && !moving) {
        if (at_min()) {
            homing = HOMING_OUT;
            motion_go(position + INT32_MAX / 4, homing_slow, left_ms ? left_ms : 1, homing_stops);
        } else {
            homing = HOMING_NOT;
            notes |= FLAG_HOMING_FAILED;
        }
    } else if (homing == HOMING_OUT && !at_min()) {
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
            rest();
            position = 0;
            sync_phase = 0;
            referenced = true;
        }
        homing = HOMING_NOT;
    } else if (homing == HOMING_OUT && !moving) {
        homing = HOMING_NOT;
        notes |= FLAG_HOMING_FAILED;
    }
}

bool motion_set_position(int32_t value) {
    if (moving || homing != HOMING_NOT) {
        return false;
    }
    position = value;
    sync_from(value);
    referenced = true;
    return true;
}

void motion_enable(bool on) {
    if (on) {
        PORTB &= (uint8_t)~(1u << ENABLE_BIT);
        return;
    }
    motion_halt();
    PORTB |= 1u << ENABLE_BIT;
    referenced = false;
}

void motion_halt(void) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        rest();
        stops++;
        notes |= FLAG_STOPPED;
    }
}

void motion_brake(void) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        braking = moving;
        stops++;
        notes |= FLAG_STOPPED;
    }
}

void motion_heard(void) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { quiet_ms = 0; }
}

bool motion_moving(void) { return moving; }

uint8_t motion_stops(void) { return stops; }

motion_sample_t motion_sample(void) {
    motion_sample_t sample;
    uint32_t pace;
    int8_t way;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        sample.position = position;
        sample.stamp = ticks_now();
        sample.step_stamp = step_stamp;
        sample.flags = notes;
        pace = moving ? interval : 0;
        way = direction;
    }
    sample.velocity = pace ? (int32_t)((TICK_HZ << FRACTION) / pace) * way : 0;
    if (pace) {
        sample.flags |= FLAG_MOVING;
    }
    if (referenced) {
        sample.flags |= FLAG_REFERENCED;
    }
    if (homing != HOMING_NOT) {
        sample.flags |= FLAG_HOMING | FLAG_MOVING;
    }
    if (at_min()) {
        sample.flags |= FLAG_LIMIT_MIN;
    }
    if (at_max()) {
        sample.flags |= FLAG_LIMIT_MAX;
    }
    if (PORTD & (1u << IRIS_BIT)) {
        sample.flags |= FLAG_IRIS_OPEN;
    }
    if (!(PORTB & (1u << ENABLE_BIT))) {
        sample.flags |= FLAG_ENABLED;
    }
    return sample;
}
