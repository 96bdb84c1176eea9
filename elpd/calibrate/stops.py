"""How a lens stops, from ways: the farther it goes after a stop the later the stop bit, or the softer it braked.

A report is a step count with an interval, too coarse in time to see where braking begins. But how *far* a motor went
after a stop is known to a step: it stood at a place on a straight line when the stop was sent, and where it rests is
reported as often as one likes. Over speeds the two parts of that way differ,

    way = v·onset + v²/2a,   so   way / v = onset + v/2a

and a straight line through ``way / v`` against ``v`` gives both, with their errors. What the line leaves over is the
scatter of the onset from one stop to the next (GRBL: which segment was running).

When a report was taken inside its interval is the same unknown for all of them: the line's place in time is known to
that much and no better, and its standard error says so. The way out to the controller does not enter: a question takes
it as well as a stop does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, ConfigDict

from elpd.calibrate.quantity import Quantity
from elpd.records import StopMode, StopTiming

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

FEWEST_REPORTS = 4
"""On the straight line before a stop: two for the line, the others to say how straight it is."""

FEWEST_STOPS = 6

STEP_SIGMA = 1 / math.sqrt(12.0)
"""Of a position that is counted in whole steps."""

COUNTING_STEPS = 0.5
"""Where between two steps a motor counts and rests is the controller's own habit, the same in every stop: known to half
a step. At low speeds that is time."""

SAME_SIGMAS = 3.0
"""A ramp that differs from the controller's own setting by no more of its errors is that setting."""

RAMP_SIGMAS = 3.0
"""A ramp is believed if it stands so far out of its error; else the stop has none that can be seen."""


@dataclass(frozen=True, slots=True)
class Cruise:
    """Reports of a motion at a steady speed: their places, and the intervals in which they were taken, in ns."""

    steps: NDArray[np.float64]
    earliest_ns: NDArray[np.int64]
    latest_ns: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class StopTrial:
    """One stop: the reports before it, when it was sent and where the motor came to rest.

    ``settled_ms`` is the time from the stop to rest, halfway between the last report of motion and the first of rest,
    and ``settled_doubt_ms`` half of what lies between the two.
    """

    mode: StopMode
    speed_sps: float
    """As commanded, signed."""
    cruise: Cruise
    sent_ns: int
    rest_steps: float
    settled_ms: float
    settled_doubt_ms: float


class Way(BaseModel):
    """The way after a stop at one speed and in one direction, over its repeats; ``scatter`` is a standard deviation."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    speed_sps: float
    stops: int
    way_steps: float
    scatter_steps: float
    settled_ms: float


class ModeFound(BaseModel):
    """How one kind of stop was measured to be."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    onset_ms: Quantity
    """From the stop's bytes being handed over to the first slower step, on average; with the error of that average."""
    onset_scatter_ms: Quantity
    """Its standard deviation from one stop to the next."""
    deceleration_sps2: Quantity
    set_ramp_onset_ms: Quantity
    """The onset if the controller brakes as it is set to, which is then better known; else the reason why it does not.
    """
    settle_ms: Quantity
    """From the stop's bytes to rest as reported, at the highest speed."""
    ways: tuple[Way, ...]

    def timing(self) -> StopTiming | None:
        """Return what a driver may learn from this; ``None`` if nothing was measured."""
        as_set = self.set_ramp_onset_ms.value is not None
        onset = self.set_ramp_onset_ms if as_set else self.onset_ms
        if onset.value is None or onset.sigma is None:
            return None
        sigma_ms = math.hypot(onset.sigma, self.onset_scatter_ms.value or 0.0)
        braking = self.deceleration_sps2
        if as_set or braking.value is None:
            return StopTiming(max(onset.value, 0.0), sigma_ms)
        return StopTiming(max(onset.value, 0.0), sigma_ms, braking.value, braking.sigma or 0.0)


@dataclass(frozen=True, slots=True)
class _Gone:
    """The way of one stop, its error, and the speed it was made from."""

    speed_sps: float
    steps: float
    sigma_steps: float


def measure_stops(trials: Sequence[StopTrial], set_sps2: float | None = None) -> ModeFound:
    """Measure one kind of stop.

    Trials whose motion was not steady are left out; too few left is said so. *set_sps2* is the ramp that the controller
    is set to brake with, ``None`` for stops that should have none.
    """
    heard = [one.cruise for one in trials if one.cruise.steps.size]
    narrowest_ns = min((int((one.latest_ns - one.earliest_ns).min()) for one in heard), default=0)
    gone: list[_Gone] = []
    kept: list[StopTrial] = []
    for trial in trials:
        way = _way(trial, narrowest_ns)
        if way is not None:
            gone.append(way)
            kept.append(trial)
    if len(gone) < FEWEST_STOPS or len({round(abs(one.speed_sps)) for one in kept}) < 2:
        unheard = sum(one.cruise.steps.size < FEWEST_REPORTS for one in trials)
        why = f"only {len(gone)} of {len(trials)} stops came from a steady speed; allow more travel, or lower the speed"
        if unheard:
            why += (
                f" (before {unheard} of them fewer than {FEWEST_REPORTS} reports came: "
                "the line is slow, or the machine busy)"
            )
        none = Quantity.none(why, "ms")
        return ModeFound(
            onset_ms=none,
            onset_scatter_ms=none,
            deceleration_sps2=Quantity.none(why, "steps/s2"),
            set_ramp_onset_ms=none,
            settle_ms=none,
            ways=(),
        )
    common_s = 1e-9 * narrowest_ns / math.sqrt(12.0)
    onset, scatter, braking, as_set = _line(gone, common_s, set_sps2)
    return ModeFound(
        onset_ms=onset,
        onset_scatter_ms=scatter,
        deceleration_sps2=braking,
        set_ramp_onset_ms=as_set,
        settle_ms=_settle(kept),
        ways=tuple(_rows(kept, gone)),
    )


def _way(trial: StopTrial, narrowest_ns: int) -> _Gone | None:
    """Return how far the motor went after the stop, by the straight line through the reports before it."""
    cruise = trial.cruise
    if cruise.steps.size < FEWEST_REPORTS:
        return None
    width_ns = (cruise.latest_ns - cruise.earliest_ns).astype(np.float64)
    when_s = 1e-9 * (cruise.earliest_ns - trial.sent_ns + 0.5 * narrowest_ns)
    doubt_s = 1e-9 * (width_ns - narrowest_ns) / math.sqrt(12.0)
    sigma = np.hypot(STEP_SIGMA, trial.speed_sps * doubt_s)
    design = np.stack([np.ones_like(when_s), when_s], axis=1)
    normal = design.T @ (design / sigma[:, None] ** 2)
    inverse = np.linalg.inv(normal)
    place, speed_sps = (float(one) for one in inverse @ (design.T @ (cruise.steps / sigma**2)))
    residual = (cruise.steps - design @ np.array([place, speed_sps])) / sigma
    misfit = max(1.0, float(residual @ residual) / (cruise.steps.size - 2))
    place_sigma, speed_sigma = (math.sqrt(misfit * float(inverse[k, k])) for k in (0, 1))
    if abs(speed_sps - trial.speed_sps) > 4 * speed_sigma + 0.05 * abs(trial.speed_sps):
        return None
    direction = math.copysign(1.0, trial.speed_sps)
    return _Gone(abs(speed_sps), direction * (trial.rest_steps - place), math.hypot(place_sigma, STEP_SIGMA))


def _line(
    gone: Sequence[_Gone], common_s: float, set_sps2: float | None
) -> tuple[Quantity, Quantity, Quantity, Quantity]:
    """Fit ``way / v = onset + v/2a``.

    Return the onset (ms), its scatter (ms), the deceleration (steps/s2), and the onset by the deceleration that is set.
    """
    speed = np.array([one.speed_sps for one in gone])
    late_s = np.array([one.steps for one in gone]) / speed
    error_s = np.array([one.sigma_steps for one in gone]) / speed
    fit = ramped = _fitted(speed, late_s, error_s, ramp=True)
    if fit.slope > RAMP_SIGMAS * fit.slope_sigma:
        a = 1.0 / (2.0 * fit.slope)
        braking = Quantity.of(a, a * fit.slope_sigma / fit.slope, "steps/s2")
    else:
        least = 1.0 / (2.0 * (max(fit.slope, 0.0) + 2.0 * fit.slope_sigma))
        why = f"no ramp is seen: it stops at once, or brakes with more than {least:.3g} steps/s2"
        braking = Quantity.none(why, "steps/s2")
        fit = _fitted(speed, late_s, error_s, ramp=False)

    def onset(of: _Fit) -> Quantity:
        return Quantity.of(1e3 * of.onset_s, 1e3 * math.hypot(of.onset_sigma_s, common_s), "ms")

    scatter = Quantity.of(1e3 * fit.scatter_s, 1e3 * fit.scatter_s / math.sqrt(2.0 * (len(gone) - 1)), "ms")
    if set_sps2 is None:
        return onset(fit), scatter, braking, Quantity.none("this kind of stop has no ramp that is set", "ms")
    off = (ramped.slope - 0.5 / set_sps2) / ramped.slope_sigma
    if abs(off) > SAME_SIGMAS:
        why = f"it does not brake with the {set_sps2:.4g} steps/s2 that it is set to ({off:+.1f} sigma in 1/2a)"
        return onset(fit), scatter, braking, Quantity.none(why, "ms")
    given = _fitted(speed, late_s - 0.5 * speed / set_sps2, error_s, ramp=False)
    return onset(fit), scatter, braking, onset(given)


@dataclass(frozen=True, slots=True)
class _Fit:
    onset_s: float
    onset_sigma_s: float
    slope: float
    slope_sigma: float
    scatter_s: float


def _fitted(
    speed: NDArray[np.float64], late_s: NDArray[np.float64], error_s: NDArray[np.float64], *, ramp: bool
) -> _Fit:
    """Fit ``late = count/v + onset + slope·v``, without the slope unless *ramp*; *count* is 0 but for half a step.

    Times scatter by more than their errors: by as much as makes the misfit what chance makes it.
    """
    columns = [1.0 / speed, np.ones_like(speed), speed][: 3 if ramp else 2]
    design = np.stack(columns, axis=1)
    expected = np.zeros((len(columns), len(columns)))
    expected[0, 0] = COUNTING_STEPS**-2
    freedom = late_s.size - len(columns) + 1

    def fit(scatter_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        weight = 1.0 / (error_s**2 + scatter_s**2)
        inverse = np.asarray(np.linalg.inv(design.T @ (design * weight[:, None]) + expected), np.float64)
        found = inverse @ (design.T @ (weight * late_s))
        return found, inverse, float(weight @ (late_s - design @ found) ** 2)

    low_s, high_s = 0.0, float(np.ptp(late_s)) + 1e-9
    if fit(0.0)[2] > freedom:
        for _ in range(60):
            middle_s = 0.5 * (low_s + high_s)
            low_s, high_s = (middle_s, high_s) if fit(middle_s)[2] > freedom else (low_s, middle_s)
    found, inverse, _ = fit(low_s)
    slope, slope_sigma = (float(found[2]), math.sqrt(float(inverse[2, 2]))) if ramp else (0.0, 0.0)
    return _Fit(float(found[1]), math.sqrt(float(inverse[1, 1])), slope, slope_sigma, low_s)


def _settle(trials: Sequence[StopTrial]) -> Quantity:
    fastest = max(abs(one.speed_sps) for one in trials)
    chosen = [one for one in trials if abs(one.speed_sps) > 0.99 * fastest]
    times = np.array([one.settled_ms for one in chosen])
    doubt = np.array([one.settled_doubt_ms for one in chosen]) / math.sqrt(3.0)
    spread = float(times.std(ddof=1)) if times.size > 1 else 0.0
    return Quantity.of(float(times.mean()), math.hypot(spread, float(doubt.mean())) / math.sqrt(times.size), "ms")


def _rows(trials: Sequence[StopTrial], gone: Sequence[_Gone]) -> list[Way]:
    rows = []
    for speed_sps in sorted({one.speed_sps for one in trials}):
        chosen = [k for k, one in enumerate(trials) if one.speed_sps == speed_sps]
        ways = np.array([gone[k].steps for k in chosen])
        rows.append(
            Way(
                speed_sps=speed_sps,
                stops=len(chosen),
                way_steps=float(ways.mean()),
                scatter_steps=float(ways.std(ddof=1)) if ways.size > 1 else 0.0,
                settled_ms=float(np.mean([trials[k].settled_ms for k in chosen])),
            )
        )
    return rows
