"""The Python face of the word decoders: feed words, get arrays, in pieces of any size.

One class serves EVT2, EVT2.1 and EVT3, because only the kernel and the word differ. It owns the registers and the
output buffers; buffers grow to the largest piece seen and are then reused, so that a steady stream allocates nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from elpd.events.epoch import enter_epoch
from elpd.events.registers import (
    HIGH,
    check_geometry,
    counters,
    forget_addresses,
    new_state,
    new_triggers,
    rate_controller,
    take_triggers,
    time_of,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Geometry, Trigger
    from elpd.units import SensorUs


class EventArrays(NamedTuple):
    """Events as four equally long arrays: views, valid until the next ``feed`` of their decoder.

    ``t`` int64 us, ``x`` and ``y`` uint16 pixels (origin top left), ``p`` uint8, 1 for ON.
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]


class DecodeKernel(Protocol):
    """A kernel that decodes ``words[position:]`` into the outputs and says how far it came."""

    def __call__(
        self,
        words: NDArray[Any],
        position: int,
        state: NDArray[np.int64],
        width: int,
        height: int,
        out_t: NDArray[np.int64],
        out_x: NDArray[np.uint16],
        out_y: NDArray[np.uint16],
        out_p: NDArray[np.uint8],
        triggers: NDArray[np.int64],
    ) -> tuple[int, int]:
        """Return the index of the first word not taken, and how many events were written."""
        ...


class WordDecoder:
    """Decode words, in pieces of any size, to arrays.

    Parameters
    ----------
    geometry : Geometry
        The sensor's size; events outside are counted, not delivered.
    kernel : DecodeKernel
        What reads the words.
    events_per_word : int
        The most events that one word can hold.
    low_bits : int
        How many bits of time lie below the TIME_HIGH word's; the wrap lies ``high_bits`` above those.
    high_bits : int
        How many bits the TIME_HIGH word has.

    Attributes
    ----------
    triggers : tuple of Trigger
        The edges in the words last fed.
    """

    def __init__(
        self, geometry: Geometry, kernel: DecodeKernel, *, events_per_word: int, low_bits: int, high_bits: int
    ) -> None:
        check_geometry(geometry)
        self._geometry = geometry
        self._kernel = kernel
        self._slack = events_per_word
        self._low_bits = low_bits
        self._high_bits = high_bits
        self._state = new_state()
        self._held_triggers = new_triggers()
        self._out = _allocate(0)
        self.triggers: tuple[Trigger, ...] = ()

    def feed(self, words: NDArray[Any]) -> EventArrays:
        """Decode the next *words* of the stream; the arrays returned are valid until the next call."""
        width, height = self._geometry.width, self._geometry.height
        self._out = _with_capacity(self._out, 0, words.shape[0] + self._slack)
        position, written = self._kernel(words, 0, self._state, width, height, *self._out, self._held_triggers)
        while position < words.shape[0]:
            self._out = _with_capacity(self._out, written, 2 * self._out.t.shape[0])
            t, x, y, p = self._out
            room = (t[written:], x[written:], y[written:], p[written:])
            position, more = self._kernel(words, position, self._state, width, height, *room, self._held_triggers)
            written += more
        self.triggers = take_triggers(self._state, self._held_triggers)
        t, x, y, p = self._out
        return EventArrays(t[:written], x[:written], y[:written], p[:written])

    def forget_addresses(self) -> None:
        """Say that words are missing here: rows and vector bases from before them hold no more."""
        forget_addresses(self._state)

    def enter_epoch(self, packet: CameraPacket) -> None:
        """Let a packet of a running camera say which turn of its clock the first words belong to."""
        enter_epoch(packet, self._state)

    @property
    def time_us(self) -> SensorUs | None:
        """The time of the newest word: what the data is complete until, but for steps back of some us.

        ``None`` before the first TIME_HIGH.
        """
        if self._state[HIGH] < 0:
            return None
        return time_of(self._state, self._low_bits, self._high_bits)

    @property
    def rate_controller(self) -> tuple[int, int] | None:
        """Events before and after the camera's rate controller; ``None`` if the stream never said."""
        return rate_controller(self._state)

    @property
    def counters(self) -> dict[str, int]:
        """How often each odd thing was met, by the names of ``registers.COUNTERS``."""
        return counters(self._state)


def _allocate(capacity: int) -> EventArrays:
    return EventArrays(
        np.empty(capacity, np.int64),
        np.empty(capacity, np.uint16),
        np.empty(capacity, np.uint16),
        np.empty(capacity, np.uint8),
    )


def _with_capacity(events: EventArrays, used: int, capacity: int) -> EventArrays:
    """Return *events*, or larger arrays with its first *used* places copied."""
    if events.t.shape[0] >= capacity:
        return events
    larger = _allocate(capacity)
    larger.t[:used] = events.t[:used]
    larger.x[:used] = events.x[:used]
    larger.y[:used] = events.y[:used]
    larger.p[:used] = events.p[:used]
    return larger
