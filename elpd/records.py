"""The frozen records that everything passes around.

Data here, behaviour elsewhere: a record can be logged, compared, replayed and faked without any of the rooms that
made it. Every quantity carries its unit in its name. Arrays inside records are views unless said otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, IntEnum, IntFlag
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from elpd.units import HostNs, SensorUs, Steps


# --- where on the sensor -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Geometry:
    """Pixels of a sensor. Origin top left, x to the right, y down."""

    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Roi:
    """A rectangle of pixels: columns ``x .. x+width-1``, rows ``y .. y+height-1``."""

    x: int
    y: int
    width: int
    height: int

    def fits(self, geometry: Geometry) -> bool:
        """Say whether the rectangle has an area and lies inside the sensor."""
        return (
            self.width > 0
            and self.height > 0
            and self.x >= 0
            and self.y >= 0
            and self.x + self.width <= geometry.width
            and self.y + self.height <= geometry.height
        )


# --- what a camera delivers --------------------------------------------------------------------------------------


class Encoding(Enum):
    """How ``CameraPacket.data`` is to be read."""

    EVT2 = "evt2"  # uint32 words
    EVT21 = "evt21"  # uint64 words, Prophesee's documented bit order
    EVT3 = "evt3"  # uint16 words
    ARRAY = "array"  # structured array with fields t|timestamp, x, y, and p|on|polarity


@dataclass(frozen=True, slots=True)
class Frame:
    """A grey image and when it was exposed.

    ``pixels`` is (height, width), 8 or 16 bit. ``t_us`` is the middle of the exposure; ``available_us`` is the
    earliest sensor time at which the host can have it (end of exposure and read-out).
    """

    t_us: SensorUs
    available_us: SensorUs
    exposure_us: int
    pixels: NDArray[Any]


@dataclass(frozen=True, slots=True)
class Trigger:
    """An edge on the camera's trigger input."""

    t_us: SensorUs
    id: int
    rising: bool


@dataclass(frozen=True, slots=True)
class ImuSample:
    """What a camera's inertial sensor said at one time, in the axes of the camera's maker.

    ``acceleration_m_s2`` and ``rotation_rad_s`` are (x, y, z); at rest the first has the length of gravity. ``nan``
    where the sensor does not measure it.
    """

    t_us: SensorUs
    acceleration_m_s2: tuple[float, float, float]
    rotation_rad_s: tuple[float, float, float]
    temperature_c: float


@dataclass(frozen=True, slots=True)
class CameraPacket:
    """What one ``EventCamera.read`` returned.

    ``data`` is a *view*, valid until the next ``read``. ``complete_until_us`` promises that no earlier event will
    follow; it closes windows in which nothing happened. ``None`` means that the camera makes no promise beyond the
    time stamps in ``data``. Loss travels with the data: ``gap_before`` says that something is missing between the
    previous packet and this one, ``lost_events`` how much where that is known, ``backlog`` how many packets wait.
    """

    data: NDArray[Any]
    encoding: Encoding
    received_ns: HostNs
    complete_until_us: SensorUs | None = None
    frames: tuple[Frame, ...] = ()
    triggers: tuple[Trigger, ...] = ()
    gap_before: bool = False
    lost_events: int = 0
    backlog: int = 0
    imu: tuple[ImuSample, ...] = ()


class BiasSet(Enum):
    """The two settings of a sensor's biases: one for the aperture opening, one for the sweep."""

    EXPOSE = "expose"
    FOCUS = "focus"


@dataclass(frozen=True, slots=True)
class SensorProfile:
    """What focusing takes from a sensor's calibration; ``None`` or empty where it is not known.

    ``hot_pixels`` are (x, y). ``lag_us`` is the time constant of the photoreceptors in the brightest parts of a
    picture, ``lag_sigma_us`` its standard error; it grows in inverse proportion to brightness. Noise rates and the
    mismatch of thresholds are not among them: a cycle measures both itself, at rest and in the image that events build.
    """

    hot_pixels: tuple[tuple[int, int], ...] = ()
    lag_us: float | None = None
    lag_sigma_us: float | None = None


# --- what a lens says --------------------------------------------------------------------------------------------


class StopMode(IntEnum):
    """How hard to stop. Ordered: the strongest is the largest."""

    RAMPED = 1
    ABRUPT = 2


class LensFlag(IntFlag):
    """What a report says beside the position."""

    NONE = 0
    MOVING = 1
    REFERENCED = 2
    LIMIT = 4
    ALARM = 8
    POSITION_UNCERTAIN = 16


@dataclass(frozen=True, slots=True)
class LensLimits:
    """The travel and speed that nothing may exceed."""

    min_steps: Steps
    max_steps: Steps
    max_speed_sps: float
    acceleration_sps2: float


@dataclass(frozen=True, slots=True)
class LensCapabilities:
    """What a controller can truly do; the cycle chooses its strategy from it.

    ``stop_onset_ms`` is the time from the stop byte to the first slower step (a calibrated number, GRBL: 45 ms), and
    ``stop_onset_sigma_ms`` how well it is known. ``watchdog_ms`` is the controller's own dead-man, where it has one.
    ``stop_deceleration_sps2`` is how hard it brakes, with its standard error, where that was measured: else a ramp
    brakes by the limits' acceleration, and an abrupt stop has no ramp.
    """

    native_velocity: bool
    abrupt_stop: bool
    stop_on_command: bool
    homing: bool
    stop_onset_ms: float
    stop_onset_sigma_ms: float
    watchdog_ms: float | None = None
    stop_deceleration_sps2: float | None = None
    stop_deceleration_sigma_sps2: float = 0.0


@dataclass(frozen=True, slots=True)
class StopTiming:
    """How a controller was measured to stop.

    ``onset_ms`` is the time from the stop's bytes being handed to the port to the first slower step, ``onset_sigma_ms``
    its standard deviation from one stop to the next, its own error included. ``deceleration_sps2`` is ``None`` where
    there is no ramp, or it is the one that the controller is set to.
    """

    onset_ms: float
    onset_sigma_ms: float
    deceleration_sps2: float | None = None
    deceleration_sigma_sps2: float = 0.0


@dataclass(frozen=True, slots=True)
class CommandStamp:
    """A command's bytes and the interval in which they were handed to the port."""

    command: str
    begun_ns: HostNs
    done_ns: HostNs


@dataclass(frozen=True, slots=True)
class LensReport:
    """Where the controller said it was, some time between ``earliest_ns`` and ``latest_ns``."""

    steps: float
    earliest_ns: HostNs
    latest_ns: HostNs
    velocity_sps: float | None = None
    flags: LensFlag = LensFlag.NONE

    @property
    def moving(self) -> bool:
        """Whether the controller says that it is stepping."""
        return LensFlag.MOVING in self.flags


@dataclass(frozen=True, slots=True)
class PositionEstimate:
    """A modelled position and one standard deviation of its error, both in (fractional) steps."""

    steps: float
    sigma_steps: float


# --- what the events say -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ElpSample:
    """One window of the Event Laplacian Product, ``ELP = -Σ p·w(x, y)`` over the events in ``[begin_us, end_us)``.

    All sums are exact integers. ``elp`` has the units of the weight table, ``energy`` is ``Σ w²`` over the same
    events, ``n_on`` and ``n_off`` count events inside the ROI, ``n_capped`` those that a filter refused: a pixel's
    rate cap, or that of background activity where it is on.
    ``position_um`` is the lens position at the middle of the window and ``travel_um`` how far it moved in it, both
    ``nan`` where no lens path is known. ``shed_us`` of the window were not looked at, because too much was waiting.
    """

    begin_us: SensorUs
    end_us: SensorUs
    elp: int
    energy: int
    n_on: int
    n_off: int
    n_capped: int = 0
    position_um: float = float("nan")
    travel_um: float = float("nan")
    shed_us: int = 0


class Cancel(IntEnum):
    """Whether somebody wants a cycle to end, and where the lens is to be then."""

    NO = 0
    RETURN = 1
    """At the place that the configuration declares."""
    HOLD = 2
    """Where it stops: somebody wants no motion at all."""


class Direction(Enum):
    """Where focus lies, seen from the motion of the lens."""

    UNKNOWN = "unknown"
    APPROACHING = "approaching"
    RECEDING = "receding"


# --- what a cycle ends with --------------------------------------------------------------------------------------


class Phase(Enum):
    """Where a cycle is; internal, ordered as they happen."""

    IDLE = "idle"
    EXPOSE = "expose"
    CHOOSE = "choose"
    SETTLE_BEFORE = "settle_before"
    PROBE = "probe"
    SWEEP = "sweep"
    STOP = "stop"
    RECROSS = "recross"
    RETURN = "return"
    VERIFY = "verify"
    DONE = "done"


class Outcome(Enum):
    """How a focus request ended. Not finding focus is a result; broken machinery is a ``DeviceError``."""

    FOCUSED = "FOCUSED"
    NO_TEXTURE = "NO_TEXTURE"
    NO_CROSSING = "NO_CROSSING"
    TOO_FEW_EVENTS = "TOO_FEW_EVENTS"
    LOW_CONFIDENCE = "LOW_CONFIDENCE"
    EVENTS_LOST = "EVENTS_LOST"
    LENS_DID_NOT_MOVE = "LENS_DID_NOT_MOVE"
    CANCELLED = "CANCELLED"
    DEADLINE = "DEADLINE"


@dataclass(frozen=True, slots=True)
class FocusEstimate:
    """Where focus is, on the ruler the caller used (um of lens travel), with one standard deviation.

    ``method`` is one of ``pairs``, ``crossing``, ``two_crossings``; ``contributions`` holds every estimator that had a
    say: ``(name, focus_um, sigma_um, weight)``. ``lasting_um`` is the part of the standard deviation that is the same
    in every pass, because the lens makes it.
    """

    focus_um: float
    sigma_um: float
    method: str
    contributions: tuple[tuple[str, float, float, float], ...] = ()
    lasting_um: float = 0.0


@dataclass(frozen=True, slots=True)
class PhaseTime:
    """How long a phase took."""

    name: str
    ms: float


@dataclass(frozen=True, slots=True)
class FocusResult:
    """The one terminal result of a focus request. Lengths in um on the motor's ruler, ``None`` where unknown.

    ``warnings`` are sentences for the person, whatever the outcome: what was odd, and what to change.
    ``depths_um`` are the positions where planes of the region are in focus, if several were seen, the one that the
    sweep met first (where the lens is) first.
    """

    outcome: Outcome
    reason: str
    reversals: int
    focus_um: float | None
    sigma_um: float | None
    stop_um: float | None
    final_um: float | None
    stop_latency_us: int | None
    duration_ms: float
    phases: tuple[PhaseTime, ...]
    events: int
    lost: int
    details: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    depths_um: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class TemporalImage:
    """An HDR picture made from first-event times (EvTemMap).

    ``log_intensity`` is (height, width) float32, natural log of relative linear intensity; ``valid`` is boolean and
    false where a pixel never fired, is hot, or was filled from its neighbours.
    """

    log_intensity: NDArray[np.float32]
    valid: NDArray[np.bool_]
    open_us: SensorUs
    fired_fraction: float
    hot_pixels: int
    filled_pixels: int
    dynamic_range_db: float
