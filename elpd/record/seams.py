"""A rig whose every device asks one channel: the same doubles record and replay.

A run is recorded at the seams. Each device is replaced by a double that turns a method call into
``channel.ask("camera.read", timeout_s)``. While recording, the channel passes the question on to the true device and
keeps the answer; while replaying, it answers from the tape. So whatever the cycle can notice of a double (its methods,
its optional abilities) is the same both times by construction.

Properties are read once, when the rig is taped, and are constants from then on, for the same reason.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from elpd.ports import Identified, Latency, Outputs, RigParts, TakesMarks
from elpd.record.abilities import ABILITIES, abilities_of, ability_methods
from elpd.record.double import Double, RigFacts
from elpd.scale import LensScale

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from elpd.ports import Aperture, Clock, EventCamera, Lens
    from elpd.record.double import Channel
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


def facts_of(parts: RigParts) -> RigFacts:
    """Read every property of *parts* once. ``opening_ms`` is ``None`` where there is no aperture."""
    devices = _devices(parts)
    camera = parts.camera
    return RigFacts(
        geometry=camera.geometry,
        limits=parts.lens.limits,
        capabilities=parts.lens.capabilities,
        um_per_step=parts.um_per_step,
        steps_to_um=parts.scale.table,
        opening_ms=None if parts.aperture is None else parts.aperture.opening_ms,
        min_latency_us=camera.min_latency_us if isinstance(camera, Latency) else None,
        mark_channel=parts.lens.mark_channel if isinstance(parts.lens, TakesMarks) else None,
        serials={name: device.serial for name, device in devices.items() if isinstance(device, Identified)},
        outputs=tuple(parts.lens.outputs) if isinstance(parts.lens, Outputs) else (),
        abilities={name: abilities_of(name, device) for name, device in devices.items()},
    )


def build_doubles(facts: RigFacts, channel: Channel) -> RigParts:
    """Return a rig that asks *channel* for everything that is not constant. It knows no truth."""

    def make(device: str, base: type) -> Any:
        mixins = tuple(ABILITIES[device][name].double for name in facts.abilities.get(device, ()))
        return type(base.__name__, (base, *mixins), {})(facts, channel)

    return RigParts(
        clock=cast("Clock", make("clock", _ClockDouble)),
        camera=cast("EventCamera", make("camera", _CameraDouble)),
        lens=cast("Lens", make("lens", _LensDouble)),
        aperture=None if facts.opening_ms is None else cast("Aperture", make("aperture", _ApertureDouble)),
        scale=LensScale(facts.um_per_step, facts.steps_to_um),
    )


def methods_of(parts: RigParts) -> dict[str, Callable[..., Any]]:
    """Return the bound method behind every call that a double of *parts* can make."""
    clock, camera, lens, aperture = parts.clock, parts.camera, parts.lens, parts.aperture
    methods: dict[str, Callable[..., Any]] = {
        "clock.now_ns": clock.now_ns,
        "clock.sleep_until": clock.sleep_until,
        "camera.start": camera.start,
        "camera.read": camera.read,
        "camera.stop": camera.stop,
        "lens.home": lens.home,
        "lens.move_to": lens.move_to,
        "lens.run": lens.run,
        "lens.stop": lens.stop,
        "lens.poll": lens.poll,
        "lens.position_at": lens.position_at,
    }
    if aperture is not None:
        methods |= {
            "aperture.open": aperture.open,
            "aperture.close": aperture.close,
            "aperture.transmittance": aperture.transmittance,
        }
    for name, device in _devices(parts).items():
        methods |= ability_methods(name, device)
    return methods


def _devices(parts: RigParts) -> dict[str, object]:
    devices: dict[str, object] = {"clock": parts.clock, "camera": parts.camera, "lens": parts.lens}
    return devices if parts.aperture is None else {**devices, "aperture": parts.aperture}


class _ClockDouble(Double):
    device = "clock"

    def now_ns(self) -> HostNs:
        return cast("HostNs", self._ask("clock.now_ns"))

    def sleep_until(self, when: HostNs) -> None:
        self._ask("clock.sleep_until", when)


class _CameraDouble(Double):
    device = "camera"

    @property
    def geometry(self) -> Geometry:
        return self._facts.geometry

    def start(self) -> None:
        self._ask("camera.start")

    def read(self, timeout_s: float) -> CameraPacket | None:
        return cast("CameraPacket | None", self._ask("camera.read", timeout_s))

    def stop(self) -> None:
        self._ask("camera.stop")


class _LensDouble(Double):
    device = "lens"
    learnt: LensCapabilities | None = None
    """What it can do, as far as it was taught since it was taped."""

    @property
    def limits(self) -> LensLimits:
        return self._facts.limits

    @property
    def capabilities(self) -> LensCapabilities:
        return self.learnt or self._facts.capabilities

    def home(self, deadline: HostNs) -> LensReport:
        return cast("LensReport", self._ask("lens.home", deadline))

    def move_to(self, target: Steps, speed_sps: float) -> CommandStamp:
        return cast("CommandStamp", self._ask("lens.move_to", target, speed_sps))

    def run(self, velocity_sps: float, until: HostNs) -> CommandStamp:
        return cast("CommandStamp", self._ask("lens.run", velocity_sps, until))

    def stop(self, mode: StopMode) -> CommandStamp:
        return cast("CommandStamp", self._ask("lens.stop", mode))

    def poll(self) -> LensReport | None:
        return cast("LensReport | None", self._ask("lens.poll"))

    def position_at(self, when: HostNs) -> PositionEstimate:
        return cast("PositionEstimate", self._ask("lens.position_at", when))


class _ApertureDouble(Double):
    device = "aperture"

    def open(self) -> CommandStamp:
        return cast("CommandStamp", self._ask("aperture.open"))

    def close(self) -> CommandStamp:
        return cast("CommandStamp", self._ask("aperture.close"))

    @property
    def opening_ms(self) -> float:
        return cast("float", self._facts.opening_ms)

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._ask_array("aperture.transmittance", since_open_us)
