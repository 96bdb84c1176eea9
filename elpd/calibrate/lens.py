"""A lens's profile: how it stops, how its replies travel, and its ruler where somebody measured one.

What is made of it: the driver models stops by what was measured (``LearnsStops``), which makes braking predictable and
positions after a stop better; a table of steps and um is the lens's ruler unless the configuration has its own.
"""

from __future__ import annotations

import csv
import math
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import structlog
from pydantic import BaseModel, ConfigDict

from elpd.calibrate.profile import MeasuredOn, Profile, load, path_of, save, state_directory
from elpd.calibrate.quantity import Quantity
from elpd.calibrate.stops import ModeFound, measure_stops
from elpd.errors import ConfigError, UsageError
from elpd.log.once import Once
from elpd.ports import LearnsStops
from elpd.records import StopMode
from elpd.scale import LensScale

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

    from elpd.calibrate.lens_live import LensEvidence
    from elpd.config import Config
    from elpd.ports import Lens
    from elpd.records import StopTiming

_once = Once()

SLOW_REPLIES_MS = 8.0
"""Half of the 16 ms that an FTDI adapter holds short replies back unless told otherwise."""

SAME_ACCELERATION = 0.01
"""Relative difference up to which a controller's ramps are the ones that were measured."""


class Stopping(BaseModel):
    """What runs and stops showed; speeds and accelerations in steps. ``None``: this kind of stop was not tried."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    ramped: ModeFound | None
    abrupt: ModeFound | None
    round_trip_ms: Quantity
    """From the end of a question to the beginning of its answer; the median."""
    round_trip_jitter_ms: Quantity
    """From the fastest to the slowest but five in a hundred."""
    lost_steps: Quantity
    """How much further from the switch the motor was than its count said, after all those stops."""
    acceleration_sps2: float
    """The controller's ramps, as set while it was measured."""
    warnings: tuple[str, ...]

    def timings(self) -> dict[StopMode, StopTiming]:
        """Return what a driver may learn, by kind of stop."""
        found = {StopMode.RAMPED: self.ramped, StopMode.ABRUPT: self.abrupt}
        timed = {mode: one.timing() for mode, one in found.items() if one is not None}
        return {mode: one for mode, one in timed.items() if one is not None}


class LensCalibration(Profile):
    """What was measured of a lens; either part may be missing."""

    KIND: ClassVar[str] = "lens"
    VERSION: ClassVar[int] = 1

    stopping: Stopping | None
    steps_to_um: tuple[tuple[float, float], ...]


def measure_lens(evidence: LensEvidence) -> Stopping:
    """Make numbers of what the rig showed."""
    by_mode = {mode: [one for one in evidence.trials if one.mode is mode] for mode in StopMode}
    ramps = {StopMode.RAMPED: evidence.acceleration_sps2, StopMode.ABRUPT: None}
    found = {mode: measure_stops(trials, ramps[mode]) for mode, trials in by_mode.items() if trials}
    trips_ms = 1e-6 * np.array(evidence.round_trips_ns, np.float64)
    if trips_ms.size < 20:
        why = f"only {trips_ms.size} replies came"
        trip, jitter = Quantity.none(why, "ms"), Quantity.none(why, "ms")
    else:
        low, middle, high = (float(one) for one in np.percentile(trips_ms, [5, 50, 95]))
        error = 1.2533 * float(trips_ms.std(ddof=1)) / math.sqrt(trips_ms.size)  # of a median
        trip, jitter = Quantity.of(middle, error, "ms"), Quantity.of(high - low, 2.0 * error, "ms")
    return Stopping(
        ramped=found.get(StopMode.RAMPED),
        abrupt=found.get(StopMode.ABRUPT),
        round_trip_ms=trip,
        round_trip_jitter_ms=jitter,
        lost_steps=evidence.lost_steps,
        acceleration_sps2=evidence.acceleration_sps2,
        warnings=(*evidence.notes, *_of_replies(trips_ms), *_of_loss(evidence.lost_steps)),
    )


def _of_replies(trips_ms: np.ndarray) -> list[str]:
    late_ms = float(np.percentile(trips_ms, 95)) if trips_ms.size else 0.0
    if late_ms <= SLOW_REPLIES_MS:
        return []
    words = (
        f"replies take up to {late_ms:.1f} ms (at most {SLOW_REPLIES_MS:.0f} are good): an FTDI adapter holds short "
        "replies back for 16 ms unless told not to; run `setserial /dev/ttyUSB0 low_latency`, or for good the udev "
        'rule ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"; then calibrate again'
    )
    return [words]


def _of_loss(lost: Quantity) -> list[str]:
    if lost.value is None or lost.sigma is None or abs(lost.value) <= max(4.0 * lost.sigma, 1.0):
        return []
    words = (
        f"the motor is {lost.value:+.0f} ± {lost.sigma:.0f} steps further from the switch than its count says: steps "
        "were lost; lower the speed or the acceleration, or raise the motor's current"
    )
    return [words]


def with_part(
    config: Config,
    on: MeasuredOn,
    *,
    stopping: Stopping | None = None,
    steps_to_um: tuple[tuple[float, float], ...] | None = None,
    when: datetime | None = None,
) -> LensCalibration:
    """Return the profile with a part replaced; the other part stays as it was, if it is of this lens.

    Raises ``FormatError`` for a stored profile that is damaged.
    """
    stored = load(state_directory(config), LensCalibration)
    if stored is not None and stored.on.difference(on) is not None:
        stored = None
    return LensCalibration(
        **LensCalibration.head(on, when),
        stopping=stopping if stopping is not None or stored is None else stored.stopping,
        steps_to_um=steps_to_um if steps_to_um is not None else stored.steps_to_um if stored is not None else (),
    )


def keep(config: Config, profile: LensCalibration) -> Path:
    """Write the profile; return its file. Raises ``UsageError`` where that cannot be done."""
    return save(state_directory(config), profile)


def lens_profile(config: Config, lens: Lens | None = None) -> LensCalibration | None:
    """Return the profile of the configured lens, ``None`` if there is none, one of another lens, or none is wanted.

    Raises ``FormatError`` for a profile that is damaged.
    """
    if not config.state.profiles:
        return None
    directory = state_directory(config)
    stored = load(directory, LensCalibration)
    if stored is None:
        return None
    difference = stored.on.difference(MeasuredOn.lens(config, lens))
    if difference is not None:
        path = path_of(directory, LensCalibration)
        if _once.new(str(path), difference):
            structlog.get_logger(__name__).warning("lens profile not used", path=str(path), reason=difference)
        return None
    return stored


def teach(lens: Lens, config: Config) -> None:
    """Let the driver of an open lens learn its measured stops, if they are this lens's and its ramps are the same."""
    if not isinstance(lens, LearnsStops):
        return
    profile = lens_profile(config, lens)
    if profile is None or profile.stopping is None:
        return
    before, now = profile.stopping.acceleration_sps2, lens.limits.acceleration_sps2
    if abs(now - before) > SAME_ACCELERATION * before:
        structlog.get_logger(__name__).warning(
            "lens profile's stops not used",
            reason=f"they were measured with ramps of {before:.4g} steps/s2, which are {now:.4g} now",
        )
        return
    lens.learn_stops(profile.stopping.timings())


def read_table(path: Path, um_per_step: float) -> tuple[tuple[float, float], ...]:
    """Read rows of ``steps,um`` (a first row of words is skipped), as measured with a gauge.

    Raises ``UsageError`` with the line that is wrong, or with what the rows as a whole lack.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UsageError(
            f"{path}: cannot be read ({error.strerror or error}); give --table a CSV of steps,um"
        ) from None
    except UnicodeDecodeError:
        raise UsageError(f"{path}: is not text; --table takes a CSV with rows of steps,um") from None
    rows: list[tuple[float, float]] = []
    for number, cells in enumerate(csv.reader(text.splitlines()), 1):
        if not any(cell.strip() for cell in cells):
            continue
        row = _row(cells)
        if row is not None:
            rows.append(row)
        elif rows or number > 1:
            raise UsageError(f"{path}:{number}: {','.join(cells)!r} is not steps,um; give two numbers a row")
    try:
        LensScale(um_per_step, tuple(rows))
    except ConfigError as error:
        raise UsageError(f"{path}: {error}") from None
    if not rows:
        raise UsageError(f"{path}: holds no row of steps,um")
    _check_size(path, rows, um_per_step)
    return tuple(rows)


def _row(cells: Sequence[str]) -> tuple[float, float] | None:
    try:
        steps, um = (float(cell) for cell in cells)
    except ValueError:
        return None
    return (steps, um) if math.isfinite(steps) and math.isfinite(um) else None


MOST_UNEVEN = 5.0
"""A step may be so many times longer or shorter than nominal: beyond it columns are swapped, or the unit is another."""


def _check_size(path: Path, rows: Sequence[tuple[float, float]], um_per_step: float) -> None:
    mean = (rows[-1][1] - rows[0][1]) / (rows[-1][0] - rows[0][0])
    if not 1.0 / MOST_UNEVEN <= mean / um_per_step <= MOST_UNEVEN:
        raise UsageError(
            f"{path}: a step is {mean:.4g} um on average, lens.um_per_step says {um_per_step:g}; are the "
            "columns steps,um in this order, and um in micrometres? correct the file or lens.um_per_step"
        )
