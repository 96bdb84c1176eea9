"""The simulated event camera: bytes with USB batching, latency, a bounded ring and a clock of its own.

``read`` is one of the two places where time moves. It advances the world to the next moment at which a packet can be
at the host, and only then renders what the sensor saw, since the lens's path up to there is known by then. Packets
are flushed every 500 us of sensor time and reach the host at least 150 us later, plus the transfer and a jitter that
depends on the seed but not on the reader. A reader who comes late finds the ring's packets waiting and, beyond its
size, a counted gap.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from elpd.errors import CameraError, UsageError
from elpd.records import CameraPacket, Encoding, Geometry, Roi, Trigger
from elpd.units import NS_PER_S, NS_PER_US, HostNs, SensorUs

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from elpd.ports import Clock
    from elpd.records import BiasSet, Frame
    from elpd_drivers.sim.retina import ApsFrames, Retina
    from elpd_drivers.sim.sensor import Events

FLUSH_US = 500
LATENCY_US = 150.0
JITTER_US = 20.0
LARGEST_JITTER_US = 200.0
USB_BYTES_PER_US = 350.0
RING_PACKETS = 512

EVENT_DTYPE = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
"""As neuromorphic-drivers delivers a DAVIS346's events: 13 bytes, packed."""


class Wire(Protocol):
    """How events look on the way to the host."""

    @property
    def encoding(self) -> Encoding:
        """What ``encode`` makes."""
        ...

    def encode(self, events: Events, begin_us: int, end_us: int) -> NDArray[Any]:
        """Turn a span's events into what is sent, state carried from span to span; times are sensor time."""
        ...

    def encode_edge(self, edge: Trigger) -> NDArray[Any]:
        """Turn an edge on the trigger input into what is sent between events; nothing where it travels apart."""
        ...


@runtime_checkable
class TriggerLine(Protocol):
    """What is wired to the camera's trigger input."""

    def take_sync_edges(self) -> list[tuple[int, bool]]:
        """Return (and forget) the edges so far, oldest first: host instant, ns, and the level after it."""
        ...


class ArrayWire:
    """Structured arrays, as vendor libraries give."""

    encoding = Encoding.ARRAY

    def encode(self, events: Events, begin_us: int, end_us: int) -> NDArray[Any]:
        """Return an array of ``EVENT_DTYPE``."""
        del begin_us, end_us
        out = np.empty(len(events.t_us), EVENT_DTYPE)
        out["t"], out["x"], out["y"], out["on"] = events.t_us, events.x, events.y, events.on
        return out

    def encode_edge(self, edge: Trigger) -> NDArray[Any]:
        """Return nothing: edges travel beside the array."""
        del edge
        return np.empty(0, EVENT_DTYPE)


@dataclass(frozen=True, slots=True)
class CameraFaults:
    """What goes wrong, in seconds after ``start``; ``None`` for never.

    ``vanishes_at_s``: the camera is unplugged. ``silent_from_s``: nothing is sent any more. ``drops_from_s``,
    ``drops_for_s``: packets of that interval are lost on the way, and flagged.
    """

    vanishes_at_s: float | None = None
    silent_from_s: float | None = None
    drops_from_s: float | None = None
    drops_for_s: float = 0.01


@dataclass(frozen=True, slots=True)
class RateLimit:
    """What leaves the sensor at most, in events per microsecond; 0 for no limit. ``told``: the sensor counts the rest.

    Like a rate controller it thins evenly within a packet's time.
    """

    mev_s: float = 0.0
    told: bool = True

    def thinned(self, events: Events) -> Events:
        """Return what is left of a packet's events."""
        most, count = round(self.mev_s * FLUSH_US), len(events.t_us)
        if most == 0 or count <= most:
            return events
        kept = np.arange(most) * count // most
        lost = events.lost + (count - most if self.told else 0)
        return replace(
            events, t_us=events.t_us[kept], x=events.x[kept], y=events.y[kept], on=events.on[kept], lost=lost
        )


@dataclass(frozen=True, slots=True)
class _Sent:
    arrival_ns: int
    data: NDArray[Any]
    complete_until_us: int
    frames: tuple[Frame, ...]
    triggers: tuple[Trigger, ...]
    gap_before: bool
    lost_events: int


class SimulatedCamera:
    """An ``EventCamera`` with ``HardwareRoi``, ``Biases``, ``PixelMask``, ``Latency`` and ``Closeable``.

    Parameters
    ----------
    retina
        Makes the events; its birth is the host instant *birth_ns*, which the camera's own clock calls *origin_us*.
    jitter
        Draws the delay of each packet.
    mask_slots
        How many single pixels the hardware can switch off.
    """

    def __init__(
        self,
        clock: Clock,
        retina: Retina,
        wire: Wire,
        geometry: Geometry,
        *,
        birth_ns: int,
        origin_us: int,
        jitter: np.random.Generator,
        frames: ApsFrames | None = None,
        mask_slots: int = 64,
        serial: str = "simulated",
        ring_packets: int = RING_PACKETS,
        rate_limit: RateLimit | None = None,
        faults: CameraFaults | None = None,
        trigger_line: TriggerLine | None = None,
    ) -> None:
        self._clock = clock
        self._retina = retina
        self._wire = wire
        self._geometry = geometry
        self._birth_ns = birth_ns
        self._origin_us = origin_us
        self._jitter = jitter
        self._frames = frames
        self._mask_slots = mask_slots
        self.serial = serial
        """Which of all simulated cameras this is (``elpd.ports.Identified``)."""
        self._ring_packets = ring_packets
        self._rate_limit = rate_limit or RateLimit()
        self._faults = faults or CameraFaults()
        self._trigger_line = trigger_line
        self._listens_to_line = False
        self._edges: list[Trigger] = []
        self._ring: deque[_Sent] = deque()
        self._pending: list[tuple[int, Callable[[], None]]] = []
        self._next_flush = 0
        self._started_ns: int | None = None
        self._last_arrival_ns = 0
        self._gap, self._lost = False, 0

    @property
    def geometry(self) -> Geometry:
        """The sensor's size."""
        return self._geometry

    @property
    def min_latency_us(self) -> float:
        """The shortest delay between an event and the host's receipt of its packet."""
        return LATENCY_US

    def start(self) -> None:
        """Begin to deliver; the first picture makes no events."""
        if self._started_ns is not None:
            return
        self._started_ns = self._clock.now_ns()
        self._next_flush = self._flush_after(self._started_ns)
        self._retina.restart()

    def stop(self) -> None:
        """Stop delivering and forget what has not been read."""
        self._started_ns = None
        self._ring.clear()
        self._gap, self._lost = False, 0

    def close(self) -> None:
        """Stop."""
        self.stop()

    def read(self, timeout_s: float) -> CameraPacket | None:
        """Let time pass until a packet is there, *timeout_s* at the most. Raises ``CameraError`` once unplugged."""
        if self._started_ns is None:
            raise CameraError("camera: read before start; call start() first")
        deadline = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        while True:
            self._check_plugged()
            self._render_due()
            arrival = self._ring[0].arrival_ns if self._ring else None
            now = self._clock.now_ns()
            if arrival is not None and arrival <= now:
                return self._deliver(self._ring.popleft(), now)
            if now >= deadline:
                return None
            upcoming = self._flush_end_ns(self._next_flush) if arrival is None else arrival
            self._clock.sleep_until(HostNs(min(upcoming, deadline)))

    def set_window(self, window: Roi | None) -> None:
        """Deliver only *window* from the next flush on. Raises ``UsageError`` if it does not fit the sensor."""
        chosen = window or Roi(0, 0, self._geometry.width, self._geometry.height)
        if not chosen.fits(self._geometry):
            raise UsageError(
                f"camera: window {chosen.x},{chosen.y},{chosen.width},{chosen.height} does not fit the sensor of "
                f"{self._geometry.width}x{self._geometry.height}; choose one inside it"
            )
        self._at_next_flush(lambda: self._retina.set_window(chosen))

    def apply_biases(self, biases: BiasSet) -> None:
        """Switch thresholds and refractory time from the next flush on; a few milliseconds of disorder follow."""

        def switch() -> None:
            self._retina.sensor.apply_biases(biases, self._next_flush * FLUSH_US)

        self._at_next_flush(switch)

    def set_mask(self, pixels: Sequence[tuple[int, int]]) -> int:
        """Switch off the first of *pixels*, as many as there are slots; return how many."""
        masked = list(pixels)[: self._mask_slots]
        self._at_next_flush(lambda: self._retina.sensor.set_mask(masked))
        return len(masked)

    def enable_trigger(self, *, on: bool) -> None:
        """Listen to the trigger input from now on, or do not."""
        self._listens_to_line = on

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _check_plugged(self) -> None:
        gone_s = self._faults.vanishes_at_s
        if gone_s is not None and self._running_s(self._clock.now_ns()) >= gone_s:
            raise CameraError(f"camera: lost {gone_s:g} s after start (no device); check the cable, then start again")

    def _render_due(self) -> None:
        now = self._clock.now_ns()
        while self._flush_end_ns(self._next_flush) <= now:
            self._flush()

    def _flush(self) -> None:
        flush = self._next_flush
        due = [change for when, change in self._pending if when <= flush]
        self._pending = [(when, change) for when, change in self._pending if when > flush]
        for change in due:
            change()
        begin_us, end_us = flush * FLUSH_US, (flush + 1) * FLUSH_US
        events = self._rate_limit.thinned(self._retina.expose(begin_us, end_us))
        events.t_us[:] += self._origin_us
        edges = self._edges_until(end_us + self._origin_us)
        data = self._encode(events, edges, begin_us + self._origin_us, end_us + self._origin_us)
        frames = () if self._frames is None else self._frames.take(end_us, self._origin_us)
        end_ns = self._flush_end_ns(flush)
        self._next_flush += 1
        self._lost += events.lost
        self._gap = self._gap or events.lost > 0
        self._send(data, len(events.t_us), end_us + self._origin_us, end_ns, frames, edges)

    def _edges_until(self, end_us: int) -> tuple[Trigger, ...]:
        """Return the edges on the trigger input before *end_us* that have not been sent yet."""
        if self._trigger_line is None:
            return ()
        for at_ns, level in self._trigger_line.take_sync_edges():
            if self._listens_to_line:
                at_us = self._origin_us + (at_ns - self._birth_ns) // NS_PER_US
                self._edges.append(Trigger(SensorUs(at_us), 0, rising=level))
        due = tuple(edge for edge in self._edges if edge.t_us < end_us)
        self._edges = self._edges[len(due) :]
        return due

    def _encode(self, events: Events, edges: tuple[Trigger, ...], begin_us: int, end_us: int) -> NDArray[Any]:
        """Return the span's events with its edges between them."""
        if not edges:
            return self._wire.encode(events, begin_us, end_us)
        pieces, taken = [], 0
        for edge in edges:
            before = int(np.searchsorted(events.t_us, edge.t_us, side="right"))
            pieces += [self._wire.encode(events.part(taken, before), begin_us, edge.t_us), self._wire.encode_edge(edge)]
            taken = before
        return np.concatenate([*pieces, self._wire.encode(events.part(taken, len(events.t_us)), begin_us, end_us)])

    def _send(
        self,
        data: NDArray[Any],
        count: int,
        until_us: int,
        end_ns: int,
        frames: tuple[Frame, ...],
        edges: tuple[Trigger, ...],
    ) -> None:
        jitter_us = min(float(self._jitter.exponential(JITTER_US)), LARGEST_JITTER_US)
        delay_us = LATENCY_US + jitter_us + data.nbytes / USB_BYTES_PER_US
        arrival = max(end_ns + round(delay_us * NS_PER_US), self._last_arrival_ns)
        self._last_arrival_ns = arrival
        faults, at_s = self._faults, self._running_s(end_ns)
        if faults.silent_from_s is not None and at_s >= faults.silent_from_s:
            return
        dropped = faults.drops_from_s is not None and 0 <= at_s - faults.drops_from_s < faults.drops_for_s
        if dropped or len(self._ring) >= self._ring_packets:
            self._gap, self._lost = True, self._lost + count
            return
        beside = edges if self._wire.encoding is Encoding.ARRAY else ()
        self._ring.append(_Sent(arrival, data, until_us, frames, beside, self._gap, self._lost))
        self._gap, self._lost = False, 0

    def _deliver(self, sent: _Sent, now: HostNs) -> CameraPacket:
        return CameraPacket(
            data=sent.data,
            encoding=self._wire.encoding,
            received_ns=now,
            complete_until_us=SensorUs(sent.complete_until_us),
            frames=sent.frames,
            triggers=sent.triggers,
            gap_before=sent.gap_before,
            lost_events=sent.lost_events,
            backlog=sum(waiting.arrival_ns <= now for waiting in self._ring),
        )

    def _at_next_flush(self, change: Callable[[], None]) -> None:
        """Let *change* take effect with the first span that begins no earlier than now."""
        self._pending.append((self._flush_after(self._clock.now_ns()), change))

    def _flush_after(self, when_ns: int) -> int:
        return -((self._birth_ns - when_ns) // (FLUSH_US * NS_PER_US))

    def _flush_end_ns(self, flush: int) -> int:
        return self._birth_ns + (flush + 1) * FLUSH_US * NS_PER_US

    def _running_s(self, when_ns: int) -> float:
        return (when_ns - (self._started_ns or when_ns)) / NS_PER_S
