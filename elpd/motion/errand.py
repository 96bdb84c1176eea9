"""Errands: motions that a person asks for, each to its end. Home, go there, go so much further, stop.

An errand ends at rest, by report and not by hope, or with a ``DeviceError`` after the strongest stop has been sent. A
cancelled errand stops on its ramp and ends where that leads. Nothing here looks at events.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from elpd.errors import DeviceError, LensError, UsageError
from elpd.records import LensFlag, StopMode
from elpd.units import NS_PER_MS, HostNs, after_ms

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.ports import Clock, Lens
    from elpd.records import LensReport
    from elpd.scale import LensScale

POLL_MS = 2.0
"""A waiting errand looks this often."""

SPARE_MS = 1000.0
"""Beyond what the way and the speed explain, a lens may take this much longer to be at rest."""

REPORT_UM = 1.0
"""Some controllers (GRBL) report micrometres, not steps."""

REST_MS = 1500.0
"""No lens this is for rings or brakes longer after a stop."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """Where an errand ended: at rest. ``from_um`` is ``None`` where the lens did not know where it was."""

    steps: float
    um: float
    from_um: float | None
    referenced: bool
    cancelled: bool
    duration_ms: float

    def fields(self) -> dict[str, Any]:
        """Return the JSON of `elpd home`, `move`, `jog` and `stop`."""
        return {
            "outcome": "CANCELLED" if self.cancelled else "OK",
            "position_um": self.um,
            "position_steps": self.steps,
            "from_um": self.from_um,
            "referenced": self.referenced,
            "duration_ms": self.duration_ms,
        }


class Errands:
    """A lens, ready to be sent somewhere.

    Parameters
    ----------
    clock, lens, scale
        The lens, what tells its time, and its ruler.
    cancelled
        Asked every 2 ms while the lens moves; true stops it, or lets it come to rest if it cannot be stopped.

    """

    def __init__(
        self, clock: Clock, lens: Lens, scale: LensScale, cancelled: Callable[[], bool] = lambda: False
    ) -> None:
        self._clock = clock
        self._lens = lens
        self._scale = scale
        self._cancelled = cancelled

    @property
    def limits_um(self) -> tuple[float, float]:
        """The ends of the travel."""
        limits = self._lens.limits
        return self._scale.to_um(limits.min_steps), self._scale.to_um(limits.max_steps)

    def home(self, limit_ms: float) -> Arrival:
        """Find the reference. Raises ``LensError`` past *limit_ms*, ``UsageError`` if the controller cannot home."""
        if not self._lens.capabilities.homing:
            raise UsageError("lens: this controller does not home by itself; see its page in tools/docs/lenses.md")
        begun_ns, from_um = self._clock.now_ns(), self._here_um()
        try:
            report = self._lens.home(after_ms(begun_ns, limit_ms))
        except BaseException:
            self._stop_hard()
            raise
        return self._arrival(report, from_um, begun_ns, cancelled=False)

    def move_to(self, target_um: float, speed_um_s: float) -> Arrival:
        """Go to a place on the lens's ruler and rest there.

        Raises ``UsageError`` for a target outside the limits or no number, ``LensError`` if unreferenced or if the lens
        does not arrive.
        """
        low_um, high_um = self.limits_um
        if not math.isfinite(target_um) or not low_um - 1e-6 <= target_um <= high_um + 1e-6:
            raise UsageError(
                f"lens: {target_um:g} um is outside the travel of {low_um:.1f} to {high_um:.1f} um; "
                "choose a place inside"
            )
        begun_ns, from_um = self._clock.now_ns(), self._here_um()
        target = self._scale.to_steps(target_um)
        limits = self._lens.limits
        speed_sps = min(speed_um_s / self._scale.um_per_step_at(target_um), limits.max_speed_sps)
        try:
            self._lens.move_to(target, speed_sps)
            way = abs(target - self._lens.position_at(begun_ns).steps)
            longest_ms = SPARE_MS + 3000.0 * (way / speed_sps + 2 * speed_sps / max(limits.acceleration_sps2, 1.0))
            report, cancelled = self._rest(longest_ms)
        except BaseException:
            self._stop_hard()
            raise
        off_um = abs(self._scale.to_um(report.steps) - self._scale.to_um(target))
        if not cancelled and abs(report.steps - target) >= 1.0 and off_um >= REPORT_UM:
            raise LensError(
                f"lens: rests at {self._scale.to_um(report.steps):.2f} um, sent to {target_um:.2f} um; "
                "check its limit switches and the motor's current, then home it"
            )
        return self._arrival(report, from_um, begun_ns, cancelled=cancelled)

    def jog(self, by_um: float, speed_um_s: float) -> Arrival:
        """Go so much further than here; what leads beyond a limit is refused as a whole."""
        report, _ = self._rest(REST_MS)
        if LensFlag.REFERENCED not in report.flags:
            raise LensError("lens: cannot jog by um, its position is unknown; home it first")
        return self.move_to(self._scale.to_um(report.steps) + by_um, speed_um_s)

    def stop(self) -> Arrival:
        """Stop now, as hard as the controller can, and say where that was. Idempotent."""
        begun_ns, from_um = self._clock.now_ns(), self._here_um()
        self._lens.stop(StopMode.ABRUPT)
        report, _ = self._rest(REST_MS, heed=False)
        return self._arrival(report, from_um, begun_ns, cancelled=False)

    def _rest(self, limit_ms: float, *, heed: bool = True) -> tuple[LensReport, bool]:
        """Wait for two reports in a row of no motion at one place; return the second, and whether it was cancelled."""
        asked_ns = self._clock.now_ns()
        deadline, cancelled = after_ms(asked_ns, limit_ms), False
        before: LensReport | None = None
        while True:
            now = self._clock.now_ns()
            if now >= deadline:
                raise LensError(
                    f"lens: not at rest within {limit_ms:.0f} ms; "
                    "check that it obeys STOP and that nothing else drives it"
                )
            if heed and not cancelled and self._cancelled():
                self._lens.stop(StopMode.RAMPED)
                cancelled, before, asked_ns = True, None, self._clock.now_ns()
                if self._lens.capabilities.stop_on_command:
                    deadline = after_ms(asked_ns, REST_MS)
            report = self._lens.poll()
            if report is not None and report.earliest_ns >= asked_ns:
                if not report.moving and before is not None and report.steps == before.steps:
                    return report, cancelled
                before = None if report.moving else report
            self._clock.sleep_until(after_ms(now, POLL_MS))

    def _here_um(self) -> float | None:
        try:
            return self._scale.to_um(self._lens.position_at(self._clock.now_ns()).steps)
        except LensError:
            return None

    def _arrival(self, report: LensReport, from_um: float | None, begun_ns: HostNs, *, cancelled: bool) -> Arrival:
        return Arrival(
            steps=report.steps,
            um=self._scale.to_um(report.steps),
            from_um=from_um,
            referenced=LensFlag.REFERENCED in report.flags,
            cancelled=cancelled,
            duration_ms=(self._clock.now_ns() - begun_ns) / NS_PER_MS,
        )

    def _stop_hard(self) -> None:
        try:
            self._lens.stop(StopMode.ABRUPT)
        except DeviceError:
            return  # the fault that brought us here is the one to tell
