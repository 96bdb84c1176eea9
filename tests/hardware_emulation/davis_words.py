"""Events, frames, inertial samples and edges as a DAVIS says them: 16-bit words, little endian.

After libcaer's description of the format: bit 15 set is the lower 15 bits of the time, which goes for all that follows;
else three bits of a kind. 1 a row, 2 and 3 a column with an OFF or ON event in that row, 4 a sample of the picture's
ADC, 5 a byte with four bits of what it is, 7 that the time has passed 32768 us; 0 is something special: edges, and the
begin and end of things.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

Kind = Literal["events", "frames", "imu", "edges"]
TIME, ROW, OFF, ON, SAMPLE, BYTE, WRAP = 0x8000, 0x1000, 0x2000, 0x3000, 0x4000, 0x5000, 0x7001
FALLING, RISING, IMU_BEGIN, IMU_END = 2, 3, 5, 7
FRAME_BEGIN, FRAME_END, RESET_COLUMN, SIGNAL_COLUMN, COLUMN_END = 8, 10, 11, 12, 13
EXPOSURE_BEGIN, EXPOSURE_END = 14, 15
TURN_US = 1 << 15
RESET_LEVEL = 1500
"""What the ADC says of a pixel in reset: bright ones fall from there."""

IMU_SCALES = 0b11100101
"""Accelerometer, thermometer and gyroscope are there; 4 g and 500 degrees a second are full scale."""


class Sample(NamedTuple):
    """Raw numbers of the inertial sensor: three of acceleration, the temperature, three of rotation."""

    acceleration: tuple[int, int, int]
    temperature: int
    rotation: tuple[int, int, int]


class Encoder:
    """Puts things into words, one after the other; time goes on and never back."""

    def __init__(self) -> None:
        self._turn = 0
        self.now_us = -1
        self._words: list[int] = []
        self._blocks: list[NDArray[np.uint16]] = []

    def take(self) -> bytes:
        """Return the words since the last call."""
        self._close_block()
        blocks, self._blocks = self._blocks, []
        return b"".join(block.tobytes() for block in blocks)

    def at(self, t_us: int) -> None:
        """Let time go on to *t_us*; a time that is said again is not said."""
        assert t_us >= self.now_us, f"{t_us} us comes before {self.now_us}"
        if t_us == self.now_us:
            return
        self._words += [WRAP] * (t_us // TURN_US - self._turn)
        self._turn, self.now_us = t_us // TURN_US, t_us
        self._words.append(TIME | t_us % TURN_US)

    def events(self, events: Iterable[tuple[int, int, int, bool]]) -> None:
        """Say (t, x, y, on), in the order of time: those of one instant and row share both words."""
        for (t_us, y), row in groupby(events, key=lambda event: (event[0], event[2])):
            self.at(t_us)
            self._words.append(ROW | y)
            self._words += [(ON if on else OFF) | x for _, x, _, on in row]

    def edge(self, t_us: int, *, rising: bool) -> None:
        """Say an edge on the signal input."""
        self.at(t_us)
        self._words.append(RISING if rising else FALLING)

    def inertia(self, t_us: int, sample: Sample) -> None:
        """Say a sample of the inertial sensor."""
        self.at(t_us)
        raw = np.array([*sample.acceleration, sample.temperature, *sample.rotation], ">i2").tobytes()
        self._words += [IMU_BEGIN, BYTE | 3 << 8 | IMU_SCALES, *(BYTE | byte for byte in raw), IMU_END]

    def block(self, t_us: int, words: NDArray[np.uint16]) -> None:
        """Say words that were put together before."""
        self.at(t_us)
        self._close_block()
        self._blocks.append(words)

    def frame(self, times_us: Sequence[int], grey: NDArray[np.uint16], orientation: int = 0) -> None:
        """Say a picture, see ``frame_blocks``, with nothing in between."""
        for t_us, words in frame_blocks(times_us, grey, orientation):
            self.block(t_us, words)

    def _close_block(self) -> None:
        self._blocks.append(np.array(self._words, "<u2"))
        self._words = []


def frame_blocks(
    times_us: Sequence[int], grey: NDArray[np.uint16], orientation: int = 0
) -> list[tuple[int, NDArray[np.uint16]]]:
    """Return what is said of a picture of a global shutter, and when.

    *times_us* are its begin, its exposure's begin and end, and its end. *grey* (height, width) has 10 bits. The chip
    reads it out by columns, or where *orientation* has bit 2 by rows, from the other side where it has bits 1 (across
    its columns) and 0 (within them).
    """
    columns = (grey if orientation & 4 else grey.T).astype(np.int64)
    columns = columns[:: -1 if orientation & 2 else 1, :: -1 if orientation & 1 else 1]
    reset = _columns(RESET_COLUMN, np.full_like(columns, RESET_LEVEL))
    signal = _columns(SIGNAL_COLUMN, RESET_LEVEL - columns)
    parts = (
        [np.array([FRAME_BEGIN], "<u2"), reset],
        [np.array([EXPOSURE_BEGIN], "<u2")],
        [np.array([EXPOSURE_END], "<u2"), signal],
        [np.array([FRAME_END], "<u2")],
    )
    return [(t_us, np.concatenate(part)) for t_us, part in zip(times_us, parts, strict=True)]


def _columns(begin: int, samples: NDArray[np.int64]) -> NDArray[np.uint16]:
    ends = np.full((len(samples), 1), COLUMN_END, "<u2")
    words: NDArray[np.uint16] = np.hstack([np.full_like(ends, begin), (SAMPLE | samples).astype("<u2"), ends])
    return words.ravel()
