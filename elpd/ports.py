"""The only seams: Protocols that hardware, simulators, recordings and test doubles fill.

A seam is right when its test double fits in twenty lines, so each has at most six methods. What only some devices
can do is a small protocol of its own (``HardwareRoi``, ``Biases`` and so on), asked for once with ``isinstance``.

Time moves only when somebody waits: ``EventCamera.read`` and ``Clock.sleep_until`` are the two places. That is why the
same loop runs against hardware in real time and against a simulated world bit-exactly, without threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from elpd.records import (
        BiasSet,
        CameraPacket,
        CommandStamp,
        Encoding,
        FocusResult,
        Geometry,
        LensCapabilities,
        LensLimits,
        LensReport,
        PositionEstimate,
        Roi,
        StopMode,
        StopTiming,
    )
    from elpd.scale import LensScale
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


# --- optional abilities ------------------------------------------------------------------------------------------


@runtime_checkable
class HardwareRoi(Protocol):
    """A camera that can switch pixels off outside a window."""

    def set_window(self, window: Roi | None) -> None:
        """Deliver only *window*, or everything again with ``None``."""
        ...


@runtime_checkable
class Biases(Protocol):
    """A camera whose sensor can be biased differently for exposing and for focusing."""

    def apply_biases(self, biases: BiasSet) -> None:
        """Switch. Events of the next few milliseconds belong to neither setting."""
        ...


@runtime_checkable
class PixelMask(Protocol):
    """A camera that can switch single pixels off."""

    def set_mask(self, pixels: Sequence[tuple[int, int]]) -> int:
        """Switch off the given (x, y), as many as the hardware can; return how many that were."""
        ...


@runtime_checkable
class TriggerInput(Protocol):
    """A camera with an input for edges, which it stamps with its own clock and delivers in its packets."""

    def enable_trigger(self, *, on: bool) -> None:
        """Listen to the input, or do not."""
        ...


@runtime_checkable
class RateLimit(Protocol):
    """A camera whose sensor can be told to send no more than so many events; what it drops, it counts."""

    def limit_rate(self, mev_s: float | None) -> None:
        """Send that many million events a second at most, or all with ``None``."""
        ...


@runtime_checkable
class Temperature(Protocol):
    """A camera that knows how warm its sensor is."""

    def temperature_c(self) -> float:
        """Return the temperature in degrees Celsius."""
        ...


@runtime_checkable
class Inertial(Protocol):
    """A camera with an inertial sensor, whose samples come in its packets, stamped with the camera's own clock."""

    def enable_imu(self, *, on: bool) -> None:
        """Deliver its samples, or do not."""
        ...


@runtime_checkable
class Counters(Protocol):
    """A camera that counts what it delivered and what was lost on the way."""

    @property
    def counters(self) -> Mapping[str, float]:
        """What was counted since it was opened, by name. Never waits."""
        ...


@runtime_checkable
class Reopens(Protocol):
    """A camera that can come back after it was lost, without being built anew."""

    def reopen(self) -> bool:
        """Take one step towards being open again, never waiting; say whether it is.

        Call it now and then; between two attempts it lets time pass, more each time, and says no. Raises
        ``CameraError`` with the reason when an attempt failed. Once open, ``start`` delivers.
        """
        ...


@runtime_checkable
class Latency(Protocol):
    """A camera that knows how long its data take at the least, from pixel to host."""

    @property
    def min_latency_us(self) -> float:
        """The shortest delay between an event and the host's receipt of its packet."""
        ...


@runtime_checkable
class Identified(Protocol):
    """A camera or a lens that knows which one of its kind it is."""

    @property
    def serial(self) -> str:
        """The serial number."""
        ...


@runtime_checkable
class LearnsStops(Protocol):
    """A lens whose driver takes what was measured of its stops in place of what it assumes."""

    def learn_stops(self, measured: Mapping[StopMode, StopTiming]) -> None:
        """Model stops by *measured* from now on; modes that are not in it stay as they are."""
        ...


@runtime_checkable
class Outputs(Protocol):
    """A lens whose controller can switch something else too, over the same line: an iris, a lamp."""

    @property
    def outputs(self) -> Sequence[str]:
        """The outputs' names; none where this controller has no output that it can be told to switch."""
        ...

    def set_output(self, name: str, *, on: bool) -> CommandStamp:
        """Switch an output. Raises ``UsageError`` if there is none of that name, ``LensError`` if it cannot be now."""
        ...


@runtime_checkable
class Remarks(Protocol):
    """A device that notices what a person should change about how it is connected."""

    @property
    def remarks(self) -> Sequence[str]:
        """Whole sentences: what was measured, what is expected, what to do; none where all is well."""
        ...


@runtime_checkable
class TakesMarks(Protocol):
    """A lens whose controller makes an edge on a line each time a certain position is reached, wired to the camera."""

    @property
    def mark_channel(self) -> int | None:
        """On which of the camera's trigger channels the edges come; ``None`` where nothing is wired."""
        ...

    def mark(self, when: HostNs) -> bool:
        """Take an edge that the camera stamped, so at one of those positions; say whether it is believed."""
        ...


@runtime_checkable
class Closeable(Protocol):
    """Anything to give back at the end."""

    def close(self) -> None:
        """Give everything back. Idempotent."""
        ...


# --- whole rigs, boards and files: what the entry-point groups deliver -------------------------------------------


class Truth(Protocol):
    """What only a simulated rig knows."""

    def errors(self, result: FocusResult) -> dict[str, float | None]:
        """Return ``focus_um estimate_error_um stop_error_um final_error_um`` for a finished cycle."""
        ...


@runtime_checkable
class Scenery(Protocol):
    """A truth that can show the scene."""

    def picture(self) -> NDArray[np.float32]:
        """Return what falls on the sensor now, behind an open aperture: log intensity, (height, width)."""
        ...

    def carriage_error_um(self) -> float:
        """Return how far the glass is from focus now, signed."""
        ...


@runtime_checkable
class Paced(Protocol):
    """A clock that tries to keep up with the wall's."""

    @property
    def lag_s(self) -> float:
        """How far behind the wall clock it is; negative if ahead, 0 if it does not try."""
        ...


@dataclass(frozen=True, slots=True)
class RigParts:
    """Devices that share a world: what an entry point of the group ``elpd.rigs`` returns."""

    clock: Clock
    camera: EventCamera
    lens: Lens
    aperture: Aperture | None
    scale: LensScale
    truth: Truth | None = None

    @property
    def um_per_step(self) -> float:
        """The nominal length of a step; where it depends on the place, ``scale`` knows."""
        return self.scale.um_per_step


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """Something that is plugged in: a serial port, a camera on the USB.

    ``next_step`` says what a person must do before it can be used, ``None`` where nothing stands in the way.
    ``drivers`` are the installed entry points that would open it, as far as that can be told without opening it.
    """

    kind: str
    name: str
    where: str
    next_step: str | None = None
    drivers: tuple[str, ...] = ()


class Discovery(Protocol):
    """A look around without opening anything: what an entry point of the group ``elpd.discovery`` names."""

    def __call__(self) -> Sequence[FoundDevice]:
        """Return what is there now. Raises ``DeviceError`` if looking is impossible, with the reason."""
        ...


class RunningBoard(Protocol):
    """A simulated controller behind a pty."""

    @property
    def port(self) -> str:
        """The path that any program can open as a serial port."""
        ...

    def close(self) -> None:
        """Stop serving and remove the pty. Idempotent."""
        ...


class Board(Protocol):
    """A simulated controller: what an entry point of the group ``elpd.boards`` names."""

    def serve(self, settings: Mapping[str, Any]) -> RunningBoard:
        """Open a pty and serve it from a thread, in real time, until closed."""
        ...


class RecordingReader(Protocol):
    """An open event file."""

    @property
    def geometry(self) -> Geometry | None:
        """The sensor's size, where the file or its sensor's name says it."""
        ...

    @property
    def notes(self) -> Mapping[str, Any]:
        """What the file says beside events: header fields, counters, warnings, loss; complete once read through."""
        ...

    def packets(self, max_bytes: int = 1 << 20) -> Iterator[CameraPacket]:
        """Yield the file from its beginning, in pieces of bounded memory; ``received_ns`` is zero."""
        ...

    def close(self) -> None:
        """Close the file. Idempotent."""
        ...


class RecordingFormat(Protocol):
    """A file format: what an entry point of the group ``elpd.formats`` names."""

    @property
    def name(self) -> str:
        """The word that `elpd decode` prints, such as ``EVT3``; a family name where one reader serves several."""
        ...

    def recognises(self, path: Path) -> bool:
        """Say from the first bytes (not the suffix) whether this format can read the file."""
        ...

    def open(self, path: Path) -> RecordingReader:
        """Open for reading. Raises ``FormatError`` with what was found and what was expected."""
        ...


@dataclass(frozen=True, slots=True)
class WriterTraits:
    """What a file being written can hold.

    ``encoding`` names the raw words that are taken as they are, beside arrays, ``None`` where there are none;
    ``triggers``, ``frames`` and ``imu`` say what else is kept. ``first_limit_us`` is the largest time that the first
    event may have (``None``: any).
    """

    encoding: Encoding | None = None
    triggers: bool = False
    frames: bool = False
    imu: bool = False
    first_limit_us: int | None = None


class RecordingWriter(Protocol):
    """An event file being written, in bounded memory."""

    @property
    def traits(self) -> WriterTraits:
        """What it can hold."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences about what could not be written as it was, so far."""
        ...

    def write(self, packet: CameraPacket) -> None:
        """Append a packet: an array of events, or words of ``traits.encoding``, and what came with them.

        Raises ``FormatError`` for what the format cannot say, ``OSError`` when there is no room; what was written
        before stays whole, and ``close`` may follow.
        """
        ...

    def close(self, *, complete: bool = True) -> None:
        """Finish the file. Idempotent. ``complete=False`` leaves it marked as cut short, where that can be said."""
        ...


@runtime_checkable
class WritableFormat(Protocol):
    """A ``RecordingFormat`` that can be written too; asked for once."""

    @property
    def writes(self) -> Mapping[str, str]:
        """The words of ``--format`` that this writes, and each one's usual suffix; first the preferred one."""
        ...

    def can_write(self, word: str) -> str | None:
        """Say what is missing to write *word* here (a package, as a line to type), ``None`` if nothing is."""
        ...

    def appends(self, word: str) -> bool:
        """Say whether what was written is readable at any moment: then a full disk costs only what comes after."""
        ...

    def create(self, path: Path, word: str, geometry: Geometry, facts: Mapping[str, str]) -> RecordingWriter:
        """Begin a file, overwriting *path*. *facts* are what is known of the camera, such as ``serial_number``.

        Raises ``FormatError`` if *word* cannot be written here or the sensor does not fit, ``OSError`` from the disk.
        """
        ...
