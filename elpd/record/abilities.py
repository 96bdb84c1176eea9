"""The optional abilities of a taped rig: what each double gains where its device has one, and what it then asks.

Every protocol of ``elpd.ports`` that a device may have beside its own stands in ``ABILITIES``, by device. One that were
missing there would be hidden from a cycle by the mere fact that it is recorded.

What is constant is read once (``RigFacts``); what changes with every look (counters, remarks) is a question like any
other, so that the answer is on the tape.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

from elpd.ports import (
    Biases,
    Closeable,
    Counters,
    HardwareRoi,
    Identified,
    Inertial,
    Latency,
    LearnsStops,
    Outputs,
    Paced,
    PixelMask,
    RateLimit,
    Remarks,
    Reopens,
    TakesMarks,
    Temperature,
    TriggerInput,
)
from elpd.record.double import Double

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from elpd.records import BiasSet, CommandStamp, LensCapabilities, Roi, StopMode, StopTiming
    from elpd.units import HostNs


class _WithHardwareRoi(Double):
    def set_window(self, window: Roi | None) -> None:
        self._ask("camera.set_window", window)


class _WithBiases(Double):
    def apply_biases(self, biases: BiasSet) -> None:
        self._ask("camera.apply_biases", biases)


class _WithPixelMask(Double):
    def set_mask(self, pixels: Sequence[tuple[int, int]]) -> int:
        return cast("int", self._ask("camera.set_mask", tuple(pixels)))


class _WithTriggerInput(Double):
    def enable_trigger(self, *, on: bool) -> None:
        self._ask("camera.enable_trigger", on)


class _WithRateLimit(Double):
    def limit_rate(self, mev_s: float | None) -> None:
        self._ask("camera.limit_rate", mev_s)


class _WithTemperature(Double):
    def temperature_c(self) -> float:
        return cast("float", self._ask("camera.temperature_c"))


class _WithInertial(Double):
    def enable_imu(self, *, on: bool) -> None:
        self._ask("camera.enable_imu", on)


class _WithCounters(Double):
    @property
    def counters(self) -> Mapping[str, float]:
        return cast("Mapping[str, float]", self._ask("camera.counters"))


class _WithReopens(Double):
    def reopen(self) -> bool:
        return cast("bool", self._ask("camera.reopen"))


class _WithLatency(Double):
    @property
    def min_latency_us(self) -> float:
        return cast("float", self._facts.min_latency_us)


class _WithIdentity(Double):
    @property
    def serial(self) -> str:
        return self._facts.serials[self.device]


class _WithLearning(Double):
    def learn_stops(self, measured: Mapping[StopMode, StopTiming]) -> None:
        self.learnt: LensCapabilities = self._ask("lens.learn_stops", dict(measured))


class _WithOutputs(Double):
    @property
    def outputs(self) -> Sequence[str]:
        return self._facts.outputs

    def set_output(self, name: str, *, on: bool) -> CommandStamp:
        return cast("CommandStamp", self._ask("lens.set_output", name, on))


class _WithRemarks(Double):
    @property
    def remarks(self) -> Sequence[str]:
        return cast("Sequence[str]", self._ask(f"{self.device}.remarks"))


class _WithMarks(Double):
    @property
    def mark_channel(self) -> int | None:
        return self._facts.mark_channel

    def mark(self, when: HostNs) -> bool:
        return cast("bool", self._ask("lens.mark", when))


class _WithPace(Double):
    @property
    def lag_s(self) -> float:
        return cast("float", self._ask("clock.lag_s"))


class _WithClose(Double):
    def close(self) -> None:
        self._ask(f"{self.device}.close")


class Ability(NamedTuple):
    """A protocol, what a double of a device with it has more, and what answers the questions of that."""

    protocol: Any
    double: type[Double]
    methods: Callable[[Any], dict[str, Callable[..., Any]]]


def _learnt(lens: Any) -> Callable[..., Any]:
    """Teach, and answer with what the lens can do from then on."""

    def learn(measured: Mapping[StopMode, StopTiming]) -> LensCapabilities:
        lens.learn_stops(measured)
        return cast("LensCapabilities", lens.capabilities)

    return learn


_CLOSEABLE = Ability(Closeable, _WithClose, lambda device: {"close": device.close})
_IDENTIFIED = Ability(Identified, _WithIdentity, lambda _: {})
_REMARKS = Ability(Remarks, _WithRemarks, lambda device: {"remarks": lambda: tuple(device.remarks)})
ABILITIES: dict[str, dict[str, Ability]] = {
    "clock": {
        "Paced": Ability(Paced, _WithPace, lambda clock: {"lag_s": lambda: clock.lag_s}),
        "Closeable": _CLOSEABLE,
    },
    "camera": {
        "HardwareRoi": Ability(HardwareRoi, _WithHardwareRoi, lambda camera: {"set_window": camera.set_window}),
        "Biases": Ability(Biases, _WithBiases, lambda camera: {"apply_biases": camera.apply_biases}),
        "PixelMask": Ability(PixelMask, _WithPixelMask, lambda camera: {"set_mask": camera.set_mask}),
        "TriggerInput": Ability(
            TriggerInput, _WithTriggerInput, lambda camera: {"enable_trigger": lambda on: camera.enable_trigger(on=on)}
        ),
        "RateLimit": Ability(RateLimit, _WithRateLimit, lambda camera: {"limit_rate": camera.limit_rate}),
        "Temperature": Ability(Temperature, _WithTemperature, lambda camera: {"temperature_c": camera.temperature_c}),
        "Inertial": Ability(
            Inertial, _WithInertial, lambda camera: {"enable_imu": lambda on: camera.enable_imu(on=on)}
        ),
        "Counters": Ability(Counters, _WithCounters, lambda camera: {"counters": lambda: dict(camera.counters)}),
        "Reopens": Ability(Reopens, _WithReopens, lambda camera: {"reopen": camera.reopen}),
        "Latency": Ability(Latency, _WithLatency, lambda _: {}),
        "Identified": _IDENTIFIED,
        "Remarks": _REMARKS,
        "Closeable": _CLOSEABLE,
    },
    "lens": {
        "TakesMarks": Ability(TakesMarks, _WithMarks, lambda lens: {"mark": lens.mark}),
        "LearnsStops": Ability(LearnsStops, _WithLearning, lambda lens: {"learn_stops": _learnt(lens)}),
        "Outputs": Ability(
            Outputs, _WithOutputs, lambda lens: {"set_output": lambda name, on: lens.set_output(name, on=on)}
        ),
        "Identified": _IDENTIFIED,
        "Remarks": _REMARKS,
        "Closeable": _CLOSEABLE,
    },
    "aperture": {},
}


def abilities_of(device: str, taped: object) -> tuple[str, ...]:
    """Return the names of what a device can do beside its own."""
    return tuple(name for name, ability in ABILITIES[device].items() if isinstance(taped, ability.protocol))


def ability_methods(device: str, taped: object) -> dict[str, Callable[..., Any]]:
    """Return what answers each question that a double of a device may ask for the sake of its abilities."""
    return {
        f"{device}.{call}": method
        for name in abilities_of(device, taped)
        for call, method in ABILITIES[device][name].methods(taped).items()
    }
