"""What only some devices can do: each a small protocol of its own, asked for once with ``isinstance``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from elpd.records import BiasSet, CommandStamp, Roi, StopMode, StopTiming
    from elpd.units import HostNs


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
