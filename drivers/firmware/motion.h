/* Steps: ramps, limits, the step counter and its time. */
#ifndef MOTION_H
#define MOTION_H

#include <stdbool.h>
#include <stdint.h>

/* A consistent sample: all of it belongs to one instant, `stamp`. */
typedef struct {
    int32_t position;    /* steps */
    int32_t velocity;    /* steps per second, signed */
    uint32_t stamp;      /* ticks of 0.5 us, now */
    uint32_t step_stamp; /* ticks, when the last step was made */
    uint16_t flags;
} motion_sample_t;

void motion_init(void);
bool motion_configure(uint32_t acceleration, uint16_t max_speed, int32_t min, int32_t max, uint16_t dead_man_ms,
                      uint16_t sync_steps);
uint8_t motion_go(int32_t target, uint16_t speed, uint16_t for_ms, uint8_t stops);
uint8_t motion_home(uint16_t fast, uint16_t slow, uint16_t for_ms, uint8_t stops);
bool motion_set_position(int32_t position);
void motion_enable(bool on);
void motion_halt(void);  /* from any context: no further step */
void motion_brake(void); /* from any context: stop on the ramp */
uint8_t motion_stops(void); /* how many stops there have been, modulo 256: a command older than the last is dead */
void motion_heard(void); /* a valid frame has come: feeds the dead-man */
void motion_poll(void);  /* from the main loop: homing */
bool motion_moving(void);
motion_sample_t motion_sample(void);

#endif
