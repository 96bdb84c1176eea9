/* Bytes and frames. */
#ifndef LINK_H
#define LINK_H

#include <stdbool.h>
#include <stdint.h>

#define FRAME_LONGEST 32

typedef struct {
    uint8_t stops;  /* how many stops there had been when its last byte came */
    uint8_t length; /* of the body without its CRC */
    bool intact;    /* the CRC was right */
    uint8_t body[FRAME_LONGEST];
} frame_t;

void link_init(void);
bool link_receive(frame_t *frame); /* true: a frame has come */
bool link_waiting(void);           /* something for the main loop to do */
bool link_overrun(void);           /* true once after a frame was lost because another waited */
void link_send(const uint8_t *body, uint8_t length);

#endif
