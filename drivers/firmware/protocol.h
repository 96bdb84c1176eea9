/* What goes over the wire. README.md tells it for people; this is for compilers.
 *
 * Bytes from 0xF0 on are never data: single-byte commands and framing. A frame is START, body, END; a body byte from 0xF0
 * on is sent as ESCAPE and the byte with bit 5 turned over. Body: sequence number, command, payload, CRC-16 (low byte
 * first; CCITT polynomial 0x1021, start 0xFFFF). All numbers little-endian.
 */
#ifndef PROTOCOL_H
#define PROTOCOL_H

#define PROTOCOL_VERSION 1

/* Single bytes, obeyed in the interrupt that receives them, whatever else is going on. */
#define BYTE_HALT 0xF1   /* no further step */
#define BYTE_BRAKE 0xF2  /* stop on the ramp */
#define BYTE_ESCAPE 0xFD
#define BYTE_START 0xFE
#define BYTE_END 0xFF
#define BYTE_CONTROL 0xF0
#define ESCAPE_FLIP 0x20

/* Commands; a reply has the command's number with bit 7 set. */
#define CMD_HELLO 0x01     /* -                                     -> report + 'E' 'L' version name[8] */
#define CMD_STATUS 0x02    /* -                                     -> report */
#define CMD_CONFIGURE 0x03 /* acceleration u32, max speed u16, min i32, max i32, dead-man ms u16, sync steps u16 */
#define CMD_GO 0x04        /* target i32, speed u16, for at most ms u16 */
#define CMD_SET_POSITION 0x05 /* i32 */
#define CMD_HOME 0x06      /* fast u16, slow u16, for at most ms u16: to the lower switch, off it, and that is 0 */
#define CMD_IRIS 0x07      /* u8: 1 open, 0 closed */
#define CMD_ENABLE 0x08    /* u8: 1 driver on, 0 off (the position is lost) */

/* Status of a reply. */
#define STATUS_OK 0
#define STATUS_BAD_CRC 1
#define STATUS_UNKNOWN 2
#define STATUS_LENGTH 3
#define STATUS_RANGE 4
#define STATUS_MOVING 5
#define STATUS_LIMIT 6
#define STATUS_OVERRUN 7
#define STATUS_STOPPED 8 /* a stop byte came after the command */

/* Flags of a report. */
#define FLAG_MOVING 0x0001
#define FLAG_REFERENCED 0x0002
#define FLAG_LIMIT_MIN 0x0004
#define FLAG_LIMIT_MAX 0x0008
#define FLAG_HOMING 0x0010
#define FLAG_HOMING_FAILED 0x0020
#define FLAG_DEAD_MAN 0x0040
#define FLAG_STOPPED 0x0080 /* by a stop byte, since the last GO */
#define FLAG_LATE 0x0100    /* a step came later than planned: the speed is too high for this clock */
#define FLAG_IRIS_OPEN 0x0200
#define FLAG_ENABLED 0x0400

#endif
