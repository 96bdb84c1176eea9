"""Latch when each pixel first brightened while an aperture opened over the scene.

Stage 1 of a focus cycle with an event-only camera: the sensor is dark, an aperture opens, and each pixel answers with
its first ON event at a time that depends on its brightness alone (EvTemMap, ECCV 2024, arXiv 2403.06443). Pixels also
fire before the light comes, by noise, so the first three ON times of each are kept (``elpd.vision.latch``), and which
one is believed is for its neighbours to say (``elpd.vision.first_times``).

EVT3 words go straight to the latch, without an event in between; all else comes as columns. Latching is O(1) per event
and the same however the stream is cut; memory is 14 bytes per pixel, whatever the length of the recording. Nothing here
knows transmittance or intensity: that is ``elpd.vision.temporal_map``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.epoch import enter_epoch
from elpd.events.evt3 import EVENTS_PER_WORD, decode
from elpd.events.registers import HIGH, TRIGGERS_HELD, forget_addresses, new_state, new_triggers, time_of
from elpd.events.stream import PacketDecoder
from elpd.records import Encoding
from elpd.vision.first_times import FirstTimes, believe_neighbours
from elpd.vision.latch import (
    MAX_INTERVAL_US,
    N_BEFORE,
    N_ON,
    N_OUTSIDE,
    SLOTS,
    latch_first_on,
    new_latch,
    stride,
)
from elpd.vision.latch_lanes import latch_kernel, scratch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Geometry

HOT_LIMIT = 8.0
"""A pixel is hot when it fired this many Poisson standard deviations more often than the median before the opening."""


class FirstEventMap:
    """The first ON times of every pixel inside ``[begin_us, end_us)``, gathered packet by packet.

    Parameters
    ----------
    geometry
        The sensor's size in pixels. Events outside it are counted (``n_outside``) and ignored.
    begin_us, end_us
        The interval on the sensor's clock. Without *begin_us* it starts at the first event seen; without *end_us* it
        lasts as long as events come, at most 35 minutes.

    Raises
    ------
    UsageError
        If the interval is empty or longer than 35 minutes.
    """

    def __init__(self, geometry: Geometry, begin_us: int | None = None, end_us: int | None = None) -> None:
        if begin_us is not None and end_us is not None and not 0 < end_us - begin_us <= MAX_INTERVAL_US:
            raise UsageError(
                f"an aperture opening of {end_us - begin_us} us cannot be mapped (limit 1 to {MAX_INTERVAL_US} us); "
                "give the interval's begin and end in microseconds of the sensor's clock"
            )
        self.geometry = geometry
        self._begin_us = begin_us
        self._end_us = end_us
        self._latch = new_latch(geometry.width, geometry.height)
        self._state, self._triggers = new_state(), new_triggers()
        self._latch_words, self._scratch = latch_kernel(), scratch()
        self._decoder: PacketDecoder | None = None
        self.first_us: int | None = None
        """Time of the first event."""
        self.last_us: int | None = None
        """Time of the newest event, or word: nothing earlier will follow but what a stream steps back by."""

    @property
    def begin_us(self) -> int | None:
        """Where the interval begins; ``None`` until the first event if it was not given."""
        return self._begin_us

    @property
    def n_on(self) -> int:
        """ON events inside the interval."""
        return int(self._latch.tally[N_ON])

    @property
    def n_before(self) -> int:
        """ON events before the interval: noise, by definition."""
        return int(self._latch.tally[N_BEFORE])

    @property
    def n_outside(self) -> int:
        """ON events with coordinates outside the sensor."""
        return int(self._latch.tally[N_OUTSIDE])

    @property
    def complete(self) -> bool:
        """Whether time is at or past the interval's end, so that nothing more can change."""
        return self._end_us is not None and self.last_us is not None and self.last_us >= self._end_us

    def add_packet(self, packet: CameraPacket) -> None:
        """Add a camera's packet, events or words.

        Words are read here, with the state of their decoder carried from packet to packet: times are those of the
        stream since its first packet *here*. Who has a decoder of the stream already gives its arrays to ``add``.
        """
        if packet.encoding is Encoding.EVT3:
            self._add_words(packet)
            return
        if self._decoder is None:
            self._decoder = PacketDecoder(self.geometry)
        events = self._decoder.feed(packet)
        self.add(events.t, events.x, events.y, events.p)

    def _add_words(self, packet: CameraPacket) -> None:
        """Latch EVT3 words without decoding them to arrays."""
        words = np.ascontiguousarray(packet.data)
        if packet.gap_before:
            forget_addresses(self._state)
        enter_epoch(packet, self._state)
        if self.first_us is None:
            self.first_us = self._first_event(words)
        if self._begin_us is None:
            self._begin_us = self.first_us
        # Before the first event there is nothing to latch, wherever the interval begins.
        begin_us = 0 if self._begin_us is None else self._begin_us
        size = (self.geometry.width, self.geometry.height)
        self._latch_words(
            words, 0, self._state, self._triggers, begin_us, self._end_of(begin_us), *size, *self._latch, *self._scratch
        )
        self._state[TRIGGERS_HELD] = 0  # edges are for others to read
        if self._state[HIGH] >= 0 and self.first_us is not None:
            self.last_us = time_of(self._state, low_bits=12, high_bits=12)

    def _first_event(self, words: NDArray[np.uint16]) -> int | None:
        """Return when the first event inside the sensor is, if it is in these words."""
        t, x, y = (np.empty(EVENTS_PER_WORD, kind) for kind in ("<i8", "<u2", "<u2"))
        p = np.empty(EVENTS_PER_WORD, np.uint8)
        size = self.geometry
        _, n = decode(words, 0, self._state.copy(), size.width, size.height, t, x, y, p, new_triggers())
        return int(t[0]) if n else None

    def _end_of(self, begin_us: int) -> int:
        """Return where an interval that begins at *begin_us* ends."""
        longest_us = begin_us + MAX_INTERVAL_US
        return longest_us if self._end_us is None else min(longest_us, self._end_us)

    def add(
        self,
        t_us: NDArray[Any],
        x: NDArray[Any],
        y: NDArray[Any],
        on: NDArray[Any],
    ) -> None:
        """Add events: equally long one-dimensional arrays of any integer type, *on* is 1 (or True) for ON.

        Arrays that are C-contiguous ``int64, uint16, uint16, uint8`` are not copied.
        """
        if t_us.size == 0:
            return
        t_us = np.ascontiguousarray(t_us, dtype=np.int64)
        if self.first_us is None:
            self.first_us = int(t_us[0])
        self.last_us = int(t_us[-1])
        if self._begin_us is None:
            self._begin_us = self.first_us
        latch_first_on(
            t_us,
            np.ascontiguousarray(x, dtype=np.uint16),
            np.ascontiguousarray(y, dtype=np.uint16),
            np.ascontiguousarray(on, dtype=np.uint8),
            t_us.size,
            self._begin_us,
            self._end_of(self._begin_us),
            self.geometry.width,
            self.geometry.height,
            *self._latch,
            self._scratch[-1],
        )

    def raw_times_us(self) -> NDArray[np.int32]:
        """Return the very first ON times, relative to ``begin_us``, noise included; ``EMPTY`` where unfired. A view."""
        first: NDArray[np.int32] = self._slots()[0]
        return first

    def hot_before(self) -> NDArray[np.bool_]:
        """Mark pixels that fired far too often before the interval (closed aperture): (height, width).

        The limit is ``HOT_LIMIT`` Poisson standard deviations above the median count, and at least three events.
        """
        width, height = self.geometry.width, self.geometry.height
        before = self._latch.before.reshape(height, stride(width))[:, :width]
        typical = float(np.median(before))
        limit = max(typical + HOT_LIMIT * np.sqrt(max(typical, before.mean())), 3.0)
        hot: NDArray[np.bool_] = before >= limit
        return hot

    def believed(self) -> FirstTimes:
        """Choose each pixel's first ON time that its neighbours support.

        Raises
        ------
        UsageError
            If no ON event came inside the interval.
        """
        if self._begin_us is None or self.n_on == 0:
            raise UsageError(
                "no ON event came while the aperture opened; "
                "check that the aperture moves, that light reaches the sensor, and the interval"
            )
        return believe_neighbours(np.ascontiguousarray(self._slots()), self.hot_before(), self._begin_us)

    def _slots(self) -> NDArray[np.int32]:
        """Return the times as (SLOTS, height, width): a view."""
        width, height = self.geometry.width, self.geometry.height
        return self._latch.slots.reshape(SLOTS, height, stride(width))[:, :, :width]
