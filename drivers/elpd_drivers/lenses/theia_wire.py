"""The messages of Theia's MCR boards: 2 to 12 bytes, the first says how many, the last is 0x0D. Pure functions.

Numbers are big-endian and may themselves contain 0x0D, so a message ends by its length, not by that byte.
"""

from __future__ import annotations

from dataclasses import dataclass

END = 0x0D
BACK, SET_UP, FORWARD, READ_SETUP, HOME, DONE, VERSION, SERIAL = 0x62, 0x63, 0x66, 0x67, 0x73, 0x74, 0x76, 0x79
COMMAND_LENGTHS = {BACK: 8, SET_UP: 12, FORWARD: 8, READ_SETUP: 3, HOME: 8, VERSION: 2, SERIAL: 2}
REPLY_LENGTHS = {SET_UP: 3, READ_SETUP: 12, DONE: 3, VERSION: 7, SERIAL: 8}
LONGEST_MOVE = 0xFFFF


@dataclass(frozen=True, slots=True)
class Setup:
    """What a board is told of a stepper motor. ``high_stop`` and ``low_stop`` make it stop at that switch."""

    high_stop: bool
    low_stop: bool
    steps: int
    slowest_pps: int
    fastest_pps: int


def version() -> bytes:
    """Ask for the firmware's version."""
    return bytes((VERSION, END))


def set_up(motor: int, setup: Setup) -> bytes:
    """Tell a stepper's travel, speeds and switches."""
    numbers = (setup.steps, setup.slowest_pps, setup.fastest_pps)
    words = b"".join(number.to_bytes(2, "big") for number in numbers)
    return bytes((SET_UP, motor, 0, setup.high_stop, setup.low_stop)) + words + bytes((END,))


def move(motor: int, steps: int, speed_pps: int) -> bytes:
    """Move by so many steps."""
    return _motion(FORWARD if steps >= 0 else BACK, motor, abs(steps), speed_pps)


def home(motor: int, steps_from_switch: int, speed_pps: int) -> bytes:
    """Go to the switch, and from there so many steps back into the travel."""
    return _motion(HOME, motor, steps_from_switch, speed_pps)


def _motion(command: int, motor: int, steps: int, speed_pps: int) -> bytes:
    return bytes((command, motor, *steps.to_bytes(2, "big"), 1, *speed_pps.to_bytes(2, "big"), END))


class ReplyReader:
    """Cuts what arrives into replies; what begins or ends as none does is skipped, byte by byte."""

    def __init__(self) -> None:
        self._partial = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the replies that are complete now."""
        self._partial += data
        replies = []
        while self._partial:
            length = REPLY_LENGTHS.get(self._partial[0])
            if length is None:
                del self._partial[0]
            elif len(self._partial) < length:
                break
            elif self._partial[length - 1] != END:
                del self._partial[0]
            else:
                replies.append(bytes(self._partial[:length]))
                del self._partial[:length]
        return replies
