"""iniVation cameras through the maker's dv-processing: events, a DAVIS346's frames with their exposure, triggers, IMU.

The library hands each stream out by itself and says nothing of how far it is. What dates a packet is the newest stamp
in it, of events, of the inertial sensor (a thousand a second, also in the dark) or of a frame; a promise of
completeness stays one commit interval behind that, because streams are not handed out in step.

Its stamps are microseconds of the Unix epoch. They are counted from a second before the first one here, so that they
look like every other camera's.
"""

from __future__ import annotations

import time
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from elpd.errors import CameraError, ConfigError
from elpd.records import BiasSet, Encoding, Frame, Geometry, ImuSample, Trigger
from elpd.units import US_PER_S, SensorUs
from elpd_drivers.cameras.capture import CapturedCamera, open_captured
from elpd_drivers.cameras.refusals import explain
from elpd_drivers.cameras.ring import Captured
from elpd_drivers.cameras.source import CaptureSettings, SourceFacts, layout_of, need, read_table
from elpd_drivers.inertia import acceleration_m_s2, rotation_rad_s

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from elpd.ports import Clock

INSTALL = "pip install 'elpd[davis]'"
EVENTS = np.dtype({
    "names": ["timestamp", "x", "y", "polarity"],
    "formats": ["<i8", "<i2", "<i2", "i1"],
    "offsets": [0, 8, 10, 12],
    "itemsize": 16,
})  # fmt: skip
"""As the library lays its events out."""

READ_OUT_US = 9_200
"""From the end of an exposure to the end of its read-out, in a recording of a DAVIS346 (the library does not say)."""

CLOCK_JUMP_US = US_PER_S
"""Nothing on the way from the sensor's streams to here takes a second; a sensor that was reset does."""

TURN_S = 0.0003
"""The library's streams can only be asked, not waited for; this is a third of the shortest commit interval."""

CoarseFine = tuple[Annotated[int, Field(ge=0, le=7)], Annotated[int, Field(ge=0, le=255)]]


class BiasTables(BaseModel):
    """The two settings of a DAVIS346's biases, by the library's names, as (coarse, fine); others stay as they are."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    expose: dict[str, CoarseFine] = {}
    focus: dict[str, CoarseFine] = {}


class DavisSettings(CaptureSettings):
    """The table ``[camera]`` for the driver ``davis``.

    ``exposure_us`` is a number or ``"auto"``. ``interval_us`` is how often the library commits what it has: the
    shorter, the sooner a packet comes and the more packets there are. ``frames``, ``trigger`` and ``imu`` switch those
    streams.
    """

    exposure_us: Annotated[int, Field(ge=1, le=1_000_000)] | Literal["auto"] = "auto"
    frame_interval_us: Annotated[int, Field(ge=1_000, le=10_000_000)] = 40_000
    interval_us: Annotated[int, Field(ge=1_000, le=10_000)] = 1_000
    frames: bool = True
    trigger: bool = True
    imu: bool = True
    biases: BiasTables = BiasTables()


def encodings(settings: Mapping[str, Any]) -> frozenset[Encoding]:
    """Return how packets may be encoded."""
    del settings
    return frozenset({Encoding.ARRAY})


def open_camera(settings: Mapping[str, Any], clock: Clock) -> CapturedCamera:
    """Open an iniVation camera, in a process of its own; see ``DavisSettings``.

    Raises ``ConfigError`` for a wrong table, ``CameraError`` if there is no such camera or it cannot be opened.
    """
    table = read_table(DavisSettings, settings)
    need("dv_processing", INSTALL)
    return open_captured(f"{__name__}:open_source", table.model_dump(mode="json"), table, clock)


def open_source(settings: dict[str, Any]) -> DavisSource:
    """Open the camera, in the capture process."""
    import dv_processing as dv  # noqa: PLC0415  (a library that may abort is loaded in the capture process alone)

    table = DavisSettings.model_validate(settings)
    try:
        # To open the first of none makes the library raise an IndexError of its own: so one is looked for first.
        listed = [one for one in dv.io.camera.discover() if table.serial in {None, one.serialNumber}]
        if not listed:
            raise CameraError(
                f"camera: no iniVation camera found (asked for: {table.serial or 'any'}); check the cable and the "
                "permissions, `elpd check` lists what is plugged in"
            )
        camera = dv.io.camera.open(listed[0])
    except (RuntimeError, IndexError, ValueError) as error:
        raise CameraError(explain(str(error), "dv-processing")) from None
    return DavisSource(camera, dv, table)


class DavisSource:
    """A ``Source`` over an open camera of the library. Use ``open_source``."""

    def __init__(self, camera: Any, dv: Any, table: DavisSettings) -> None:
        self._camera, self._dv, self._table = camera, dv, table
        self._is_davis = hasattr(camera, "setCropAreaEvents")
        self._has_detector = hasattr(camera, "setDetectorRunning")  # a DVXplorer Micro has no trigger input
        self._origin_us: int | None = None
        self._newest_us = 0
        self._frames = 0
        self._with_imu = table.imu
        self._configure()
        width, height = camera.getEventResolution()
        self.facts = SourceFacts(
            geometry=Geometry(int(width), int(height)),
            encoding=Encoding.ARRAY,
            model=str(camera.getCameraName()),
            serial=str(camera.getSerialNumber()),
            min_latency_us=table.interval_us if table.min_latency_us is None else table.min_latency_us,
            layout=layout_of(EVENTS),
            abilities=tuple(self._abilities()),
        )

    def read(self, timeout_s: float) -> Captured | None:
        """Ask every stream, until one has something."""
        until = time.monotonic() + timeout_s
        while True:
            packet = self._take()
            if packet is not None:
                return packet
            if not self._camera.isRunning():
                raise CameraError(explain("no such device", "dv-processing"))
            if time.monotonic() >= until:
                return None
            time.sleep(TURN_S)

    def call(self, name: str, arguments: Sequence[Any]) -> Any:
        """Use an ability; a few register writes over USB."""
        if name == "set_window":
            geometry = self.facts.geometry
            window = tuple(arguments[0] or (0, 0, geometry.width, geometry.height))
            (self._camera.setCropAreaEvents if self._is_davis else self._camera.setCropArea)(window)
        elif name == "apply_biases":
            biases = self._table.biases
            self._set_biases(biases.expose if BiasSet(arguments[0]) is BiasSet.EXPOSE else biases.focus)
        elif name == "enable_imu":
            self._with_imu = bool(arguments[0])
        else:
            self._camera.setDetectorRunning(bool(arguments[0]))

    def notes(self) -> Mapping[str, float]:
        """Return what can be counted; the library does not tell what it loses."""
        return {"frames": self._frames}

    def close(self) -> None:
        """Stop the streams; the library closes the camera when it is forgotten. Idempotent."""
        if hasattr(self._camera, "setEventsRunning") and self._camera.isRunning():
            self._camera.setEventsRunning(False)
        self._camera = None

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _configure(self) -> None:
        camera, table = self._camera, self._table
        camera.setTimeInterval(timedelta(microseconds=table.interval_us))
        if hasattr(camera, "setUSBEarlyPacketDelay"):
            camera.setUSBEarlyPacketDelay(timedelta(microseconds=table.interval_us))
        camera.setImuRunningAccelerometer(True)  # delivered or not, it keeps time in the dark
        camera.setImuRunningGyroscope(True)
        camera.setImuRunningTemperature(True)
        if self._has_detector:
            camera.setDetectorRisingEdges(True)
            camera.setDetectorFallingEdges(True)
            camera.setDetectorRunning(table.trigger)
        if not self._is_davis:
            if table.biases != BiasTables():
                raise ConfigError("camera.biases: this camera's biases cannot be set one by one; remove the table")
            return
        self._check_biases()
        camera.setFramesRunning(table.frames)
        camera.setFrameInterval(timedelta(microseconds=table.frame_interval_us))
        camera.setAutoExposure(table.exposure_us == "auto")
        if table.exposure_us != "auto":
            camera.setExposureDuration(timedelta(microseconds=table.exposure_us))
        self._normal = {name: camera.getDavis346BiasCoarseFine(self._bias(name)) for name in self._named()}
        self._set_biases(table.biases.focus)

    def _abilities(self) -> list[str]:
        has = {"window": True, "biases": self._is_davis, "trigger": self._has_detector, "imu": True}
        return [name for name, there in has.items() if there]

    def _named(self) -> set[str]:
        return {*self._table.biases.expose, *self._table.biases.focus}

    def _bias(self, name: str) -> Any:
        return getattr(self._dv.io.camera.DAVIS.Davis346BiasCF, name)

    def _check_biases(self) -> None:
        known = set(self._dv.io.camera.DAVIS.Davis346BiasCF.__members__)
        for where, biases in (("expose", self._table.biases.expose), ("focus", self._table.biases.focus)):
            for name in biases:
                if name not in known:
                    raise ConfigError(
                        f"camera.biases.{where}.{name}: a DAVIS346 has no such bias; it has {', '.join(sorted(known))}"
                    )

    def _set_biases(self, chosen: Mapping[str, Sequence[int]]) -> None:
        """Set what is named in either table: to what this one says, else to what it was."""
        for name, normal in self._normal.items():
            self._camera.setDavis346BiasCoarseFine(self._bias(name), *chosen.get(name, normal))

    def _take(self) -> Captured | None:
        camera = self._camera
        motion = camera.getNextImuBatch()
        events = camera.getNextEventBatch()
        frame = camera.getNextFrame()
        edges = camera.getNextTriggerBatch()
        received_ns = time.monotonic_ns()
        stamps = [motion[-1].timestamp] if motion else []
        if events is not None and not events.isEmpty():
            stamps.append(events.getHighestTime())
        if frame is not None:
            stamps.append(frame.timestamp)
        if not stamps and not edges:
            return None
        if self._origin_us is None and stamps:
            self._origin_us = min(stamps) - US_PER_S
        origin_us = self._origin_us or 0
        self._watch_clock(stamps)
        self._newest_us = max([self._newest_us, *(stamp - origin_us for stamp in stamps)])
        self._frames += frame is not None
        return Captured(
            self._array(events, origin_us),
            received_ns,
            complete_until_us=self._newest_us - self._table.interval_us,
            events=0 if events is None else len(events),
            frames=() if frame is None else (_frame(frame, origin_us),),
            triggers=() if edges is None else tuple(self._edges(edges, origin_us)),
            imu=tuple(_samples(motion, origin_us)) if motion and self._with_imu else (),
        )

    def _watch_clock(self, stamps: Sequence[int]) -> None:
        """Raise ``CameraError`` if the camera's clock was set back: streams are out of step, but not by a second."""
        back_us = self._newest_us - (max(stamps, default=0) - (self._origin_us or 0))
        if stamps and back_us > CLOCK_JUMP_US:
            raise CameraError(f"camera: its clock jumped back by {back_us / US_PER_S:.3f} s; it was reset, start again")

    def _array(self, events: Any, origin_us: int) -> np.ndarray[Any, np.dtype[Any]]:
        """Copy the library's events, which are a view of its own memory, counted from our origin."""
        if events is None:
            return np.empty(0, EVENTS)
        found = events.numpy()
        if found.dtype != EVENTS:
            raise CameraError(
                f"camera: dv-processing delivers events as {found.dtype}, known is {EVENTS}; install the version that "
                f"elpd was made for: {INSTALL}"
            )
        array: np.ndarray[Any, np.dtype[Any]] = found.copy()
        array["timestamp"] -= origin_us
        return array

    def _edges(self, edges: Any, origin_us: int) -> list[Trigger]:
        kinds = self._dv.TriggerType
        rising = {
            kinds.EXTERNAL_SIGNAL_RISING_EDGE: True,
            kinds.EXTERNAL_SIGNAL_PULSE: True,
            kinds.EXTERNAL_SIGNAL_FALLING_EDGE: False,
        }
        return [
            Trigger(SensorUs(edge.timestamp - origin_us), 0, rising[edge.type]) for edge in edges if edge.type in rising
        ]


def _frame(frame: Any, origin_us: int) -> Frame:
    """Date a frame: its stamp is the beginning of the exposure (as its own exposure triggers show in recordings)."""
    exposure_us = frame.exposure // timedelta(microseconds=1)
    begin_us = frame.timestamp - origin_us
    return Frame(
        SensorUs(begin_us + exposure_us // 2),
        SensorUs(begin_us + exposure_us + READ_OUT_US),
        exposure_us,
        np.array(frame.image),
    )


def _samples(batch: Sequence[Any], origin_us: int) -> list[ImuSample]:
    """Return the library's inertial samples, in m/s^2 and rad/s."""
    return [
        ImuSample(
            SensorUs(one.timestamp - origin_us),
            acceleration_m_s2((one.accelerometerX, one.accelerometerY, one.accelerometerZ)),
            rotation_rad_s((one.gyroscopeX, one.gyroscopeY, one.gyroscopeZ)),
            one.temperature,
        )
        for one in batch
    ]
