"""What every rig has: a clock, a camera, a lens and its line, mostly an aperture, and somebody who takes notes.

Time moves only when somebody waits: ``EventCamera.read`` and ``Clock.sleep_until`` are the two places. That is why the
same loop runs against hardware in real time and against a simulated world bit-exactly, without threads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from elpd.records import (
        CameraPacket,
        CommandStamp,
        Geometry,
        LensCapabilities,
        LensLimits,
        LensReport,
        PositionEstimate,
        StopMode,
    )
    from elpd.units import HostNs, Steps


class Clock(Protocol):
    """The host's monotonic clock, real or virtual."""

    def now_ns(self) -> HostNs:
        """Return the present instant."""
        ...

    def sleep_until(self, when: HostNs) -> None:
        """Return at *when* or later; at once if it has passed."""
        ...


class BytePort(Protocol):
    """A serial line. Neither method waits for the far end."""

    def write(self, data: bytes) -> None:
        """Hand *data* to the line in one write. Raises ``LensError`` if the line is dead or full."""
        ...

    def read_available(self) -> bytes:
        """Return what has arrived, possibly nothing. Raises ``LensError`` if the line is dead."""
        ...

    def close(self) -> None:
        """Give the line back. Idempotent."""
        ...


class EventCamera(Protocol):
    """A source of events.

    Its driver's module may have a function ``encodings(settings) -> frozenset[Encoding]`` that says beforehand how the
    packets of the camera that these settings open may be encoded. Without it the daemon compiles kernels for all.
    """

    @property
    def geometry(self) -> Geometry:
        """The sensor's size."""
        ...

    def start(self) -> None:
        """Begin to deliver. Raises ``CameraError``."""
        ...

    def read(self, timeout_s: float) -> CameraPacket | None:
        """Wait up to *timeout_s* for a packet; its arrays are valid until the next call.

        Returns ``None`` when nothing came. Raises ``CameraError`` when the camera is gone or a recording has ended.
        """
        ...

    def stop(self) -> None:
        """Stop delivering. Idempotent."""
        ...


class Lens(Protocol):
    """A stepper-driven lens. Positions in motor microsteps; positive is towards ``limits.max_steps``.

    No method waits for motion to end but ``home``. Every motion is bounded: ``move_to`` by its target, ``run`` by its
    *until* and by the limits, whichever comes first.
    """

    @property
    def limits(self) -> LensLimits:
        """Travel and speed that nothing exceeds."""
        ...

    @property
    def capabilities(self) -> LensCapabilities:
        """What this controller can truly do."""
        ...

    def home(self, deadline: HostNs) -> LensReport:
        """Find the reference, return when at rest. Raises ``LensError`` past *deadline*."""
        ...

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        """Start an absolute move. Raises ``LensError`` if unreferenced, ``UsageError`` if outside the limits."""
        ...

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        """Start (or change to, or reverse to) a signed velocity, ending at *until* or the limit at the latest."""
        ...

    def stop(self, mode: StopMode) -> CommandStamp:
        """Send the stop bytes now, from any thread, behind nothing. Idempotent. Returns before motion has ended."""
        ...

    def poll(self) -> LensReport | None:
        """Ask if it is time to, read what has come, and return the newest report if there is a new one.

        Never waits. Raises ``LensError`` when the controller is lost, alarmed, or has not answered within its limit.
        """
        ...

    def position_at(self, when: HostNs) -> PositionEstimate:
        """Return where the motor was at *when*, from commands and reports. Raises ``LensError`` if unknown."""
        ...


class Aperture(Protocol):
    """An iris or shutter that can open over the sensor."""

    def open(self) -> CommandStamp:
        """Start to open. Returns before it is open."""
        ...

    def close(self) -> CommandStamp:
        """Start to close. Returns before it is closed."""
        ...

    @property
    def opening_ms(self) -> float:
        """How long opening takes, from command to fully open; an upper bound."""
        ...

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the transmittance, 0 to 1, at times after the opening began."""
        ...


class RunSink(Protocol):
    """Where a cycle's notes go: phases, samples, verdicts, the result. Must not block and must not raise."""

    def note(self, event: str, /, **fields: Any) -> None:
        """Take one note. Fields are plain numbers, strings, booleans, ``None``, and lists or dicts of them."""
        ...
