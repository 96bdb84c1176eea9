"""Live cameras as ``EventCamera``: the same for every library, which runs in a process of its own.

The controller never waits for a camera library. It waits on the ring's descriptor, on the child's line and on nothing
else; a packet is a view of where the child put it. When the child dies, hangs or says that the camera is gone, ``read``
raises ``CameraError`` then and there, and goes on raising until ``start`` or ``reopen`` has brought a new child up.
Whether and when to try again is the caller's business; that trying often does not hammer the bus is ours: the pauses
between attempts grow from 0.1 to 5 s.

A reader who was busy finds packets waiting. One that waited longer than ``max_delay_ms`` is of no use to a loop that
must stop a lens: then everything but the newest is thrown away, counted, and the next packet says so.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import CameraError, ConfigError
from elpd.records import CameraPacket
from elpd.units import NS_PER_MS, NS_PER_S, HostNs, SensorUs
from elpd_drivers.cameras.abilities import ABILITIES
from elpd_drivers.cameras.process import CaptureProcess

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.ports import Clock
    from elpd.records import Frame, Geometry, ImuSample, Trigger
    from elpd_drivers.cameras.ring import Taken
    from elpd_drivers.cameras.source import CaptureSettings, SourceFacts

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0
LATE_CLOCK_NS = NS_PER_S
LOOK_MS = 10.0
"""How long to wait at most before looking whether the child still turns."""

MOST_KEPT = 4096
"""Of packets that are thrown away, edges and inertial samples are kept: the newest of each, up to so many."""


def open_captured(backend: str, settings: Mapping[str, Any], common: CaptureSettings, clock: Clock) -> CapturedCamera:
    """Open a live camera in a process of its own.

    Parameters
    ----------
    backend
        ``module:function`` that makes the ``Source``, in the child.
    settings
        What the child makes it with: plain data.
    common
        The keys that every live camera has.
    clock
        Of the rig; it must be the host's monotonic clock, which the packets are stamped with.

    Raises
    ------
    CameraError
        If the camera cannot be opened.
    ConfigError
        For a rig that lives in another time, or for settings that this camera cannot take.
    """
    if abs(clock.now_ns() - time.monotonic_ns()) > LATE_CLOCK_NS:
        raise ConfigError(
            'camera: a live camera lives in real time, this rig does not; set rig = "hardware", or play a recording '
            'with camera.driver = "file"'
        )
    process = _begin(backend, settings, common)
    try:
        facts = process.wait_ready()
    except BaseException:
        process.close()
        raise
    kind = type("CapturedCamera", (CapturedCamera, *(ABILITIES[name] for name in facts.abilities)), {})
    camera: CapturedCamera = kind(process, facts, lambda: _begin(backend, settings, common), common.max_delay_ms)
    return camera


def _begin(backend: str, settings: Mapping[str, Any], common: CaptureSettings) -> CaptureProcess:
    return CaptureProcess(
        backend, settings, ring_mb=common.ring_mb, open_timeout_s=common.open_timeout_s, hang_ms=common.hang_ms
    )


class CapturedCamera:
    """An ``EventCamera`` with ``Latency``, ``Identified``, ``Counters``, ``Reopens`` and ``Closeable``.

    What only some cameras can do is mixed in by ``open_captured``, from ``abilities.ABILITIES``.
    """

    def __init__(self, process: CaptureProcess, facts: SourceFacts, begin: Any, max_delay_ms: float) -> None:
        self._process: CaptureProcess | None = process
        self._ending: CaptureProcess | None = None
        self._facts, self._dtype = facts, facts.dtype()
        self._begin = begin
        self._max_delay_ns = max_delay_ms * NS_PER_MS
        self._delivering = False
        self._generation = 0
        self._fault = ""
        self._pause_s, self._next_try_s = FIRST_PAUSE_S, 0.0
        self._gap, self._lost = False, 0
        self._frames: tuple[Frame, ...] = ()
        self._edges: tuple[Trigger, ...] = ()
        self._imu: tuple[ImuSample, ...] = ()
        self._shedding = self._proven = False
        self._counts: dict[str, float] = dict.fromkeys(
            ("packets", "bytes", "events", "lost_events", "gaps", "late_packets_dropped", "most_waiting", "reopened"), 0
        )
        self._notes: dict[str, float] = {}

    @property
    def geometry(self) -> Geometry:
        """The sensor's size."""
        return self._facts.geometry

    @property
    def min_latency_us(self) -> float:
        """The shortest delay between an event and the host's receipt of its packet."""
        return self._facts.min_latency_us

    @property
    def serial(self) -> str:
        """The serial number."""
        return self._facts.serial

    @property
    def model(self) -> str:
        """The maker's name for it."""
        return self._facts.model

    @property
    def counters(self) -> Mapping[str, float]:
        """What was delivered and what was lost, where; the camera library's own counters among them. Never waits."""
        if self._process is not None:
            self._notes = self._process.notes()
        return {**self._counts, **self._notes}

    def start(self) -> None:
        """Begin to deliver from now on; a lost camera is opened again first. Raises ``CameraError``."""
        if self._delivering:
            return
        process = self._process
        if process is None:
            if self._ending is not None:
                self._ending.close()
            process = self._open_again()
        try:
            self._await_ready(process)
            self._generation += 1
            process.call("deliver", [self._generation])
        except CameraError as error:
            self._lose(error)
            raise
        self._delivering = True
        self._forget()

    def stop(self) -> None:
        """Stop delivering; the camera stays open. Idempotent."""
        if not self._delivering:
            return
        self._delivering = False
        if self._process is not None:
            try:
                self._process.call("deliver", [0])
            except CameraError as error:
                self._lose(error)

    def close(self) -> None:
        """Give the camera back; ``start`` would open it again. Idempotent."""
        self._delivering = False
        if self._ending is not None:
            self._ending.close()
            self._ending = None
        if self._process is not None:
            self._process.close()
            self._process = None
            self._fault = "camera: it was closed; call start() to open it again"

    def reopen(self) -> bool:
        """Take one step towards being open again, never waiting; say whether it is.

        Raises ``CameraError`` with the reason when an attempt failed; until the next one is due it just says no.
        """
        process = self._process
        if process is None:
            if time.monotonic() < self._next_try_s or not (self._ending is None or self._ending.ended):
                return False
            process = self._open_again()
        try:
            process.wait(0)
            process.check()
            if process.facts is not None:
                self._came_back(process.facts)
        except CameraError as error:
            self._lose(error)
            raise
        return process.facts is not None

    def read(self, timeout_s: float) -> CameraPacket | None:
        """Wait up to *timeout_s* for a packet; see ``EventCamera.read``."""
        process = self._process
        if process is None or not self._delivering:
            raise CameraError(self._fault or "camera: read before start; call start() first")
        until_ns = time.monotonic_ns() + round(timeout_s * NS_PER_S)
        try:
            while True:
                taken = process.reader.take()
                if taken is not None:
                    packet = self._sift(taken)
                    if packet is not None:
                        return packet
                    continue
                left_ms = (until_ns - time.monotonic_ns()) / NS_PER_MS
                if left_ms <= 0:
                    process.wait(0)
                    process.check()
                    return None
                process.wait(min(left_ms, LOOK_MS))
                process.check()
        except CameraError as error:
            self._lose(error)
            raise

    # --- below: how it is done -------------------------------------------------------------------------------------

    def call(self, name: str, *arguments: Any) -> Any:
        """Use an ability of the camera. Raises ``UsageError`` if it cannot, ``CameraError`` if it is lost."""
        if self._process is None:
            raise CameraError(self._fault)
        try:
            return self._process.call(name, arguments)
        except CameraError as error:
            self._lose(error)
            raise

    def _sift(self, taken: Taken) -> CameraPacket | None:
        """Turn what came out of the ring into a packet, unless it is of an earlier delivery or too late."""
        process, counts = self._process, self._counts
        if taken.generation != self._generation or process is None:
            return None
        waiting = process.reader.waiting
        counts["most_waiting"] = max(counts["most_waiting"], waiting)
        self._gap = self._gap or taken.gap_before
        self._lost += taken.lost_events
        self._frames += taken.frames
        self._edges += taken.triggers
        self._imu += taken.imu
        if self._is_stale(taken, waiting):
            counts["late_packets_dropped"] += 1
            self._gap, self._lost = True, self._lost + taken.events
            self._frames, self._edges = self._frames[-1:], self._edges[-MOST_KEPT:]
            self._imu = self._imu[-MOST_KEPT:]
            return None
        packet = CameraPacket(
            data=np.frombuffer(taken.data, self._dtype),
            encoding=self._facts.encoding,
            received_ns=HostNs(taken.received_ns),
            complete_until_us=None if taken.complete_until_us is None else SensorUs(taken.complete_until_us),
            frames=self._frames,
            triggers=self._edges,
            gap_before=self._gap,
            lost_events=self._lost,
            backlog=waiting + taken.backlog,
            imu=self._imu,
        )
        if not self._proven:  # one that opens and then says nothing has not come back
            self._proven, self._pause_s, self._next_try_s = True, FIRST_PAUSE_S, 0.0
        counts["packets"] += 1
        counts["bytes"] += len(taken.data)
        counts["events"] += taken.events
        counts["lost_events"] += self._lost
        counts["gaps"] += self._gap
        self._forget()
        return packet

    def _forget(self) -> None:
        """Begin to gather anew what goes with the next packet."""
        self._gap, self._lost, self._frames, self._edges, self._imu = False, 0, (), (), ()

    def _is_stale(self, taken: Taken, waiting: int) -> bool:
        """Say whether to throw this packet away: from the first that is too late until none waits behind."""
        late = self._max_delay_ns > 0 and time.monotonic_ns() - taken.received_ns > self._max_delay_ns
        self._shedding = (late or self._shedding) and waiting > 0
        return self._shedding

    def _open_again(self) -> CaptureProcess:
        now_s = time.monotonic()
        if now_s < self._next_try_s:
            raise CameraError(f"{self._fault} (next attempt in {self._next_try_s - now_s:.1f} s)")
        self._next_try_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        process: CaptureProcess = self._begin()
        self._process, self._ending = process, None
        return process

    def _await_ready(self, process: CaptureProcess) -> None:
        if process.facts is None:
            self._came_back(process.wait_ready())

    def _came_back(self, facts: SourceFacts) -> None:
        """Take a camera that was opened again, if it is the one it was."""
        if facts.serial != self._facts.serial or facts.geometry != self._facts.geometry:
            raise CameraError(
                f"camera: another one is plugged in ({facts.model} {facts.serial}, it was {self._facts.model} "
                f"{self._facts.serial}); plug that one in, or start elpd again"
            )
        if self._fault:
            self._counts["reopened"] += 1
        self._fault, self._proven = "", False

    def _lose(self, error: CameraError) -> None:
        self._fault = str(error)
        self._delivering = False
        if self._process is not None:
            self._notes = self._process.notes()
            self._process, self._ending = None, self._process
