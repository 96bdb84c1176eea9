"""What a profile changes: hot pixels are not heard, the lag is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scenes_of_turns import turns_of_a_lag

from elpd.records import Geometry, Roi, SensorProfile
from elpd.vision.filters import PixelCap
from elpd.vision.lag import Lag, LagPrior
from elpd.vision.memory import EventMemory

if TYPE_CHECKING:
    from elpd.vision.turns import Line

GEOMETRY = Geometry(64, 48)


def test_a_silenced_pixel_never_speaks_again() -> None:
    cap = PixelCap(4, 4)
    cap.silence(2, 1)
    t_us = np.array([0, 10, 10_000_000, 1 << 40, (1 << 40) + 1], np.int64)
    x, y = np.array([2, 1, 2, 2, 3], np.uint16), np.array([1, 2, 1, 1, 3], np.uint16)
    assert cap.keep(t_us, x, y).tolist() == [False, True, False, False, True]


def test_the_memory_leaves_hot_pixels_of_its_region_out() -> None:
    roi = Roi(20, 16, 20, 16)
    sensor = SensorProfile(hot_pixels=((25, 20), (0, 0), (63, 47)))
    t_us = np.arange(40, dtype=np.int64) * 10_000
    x = np.where(np.arange(40) % 2, 25, 30).astype(np.uint16)
    y = np.full(40, 20, np.uint16)
    on = np.ones(40, np.uint8)
    kept = []
    for known in (None, sensor):
        memory = EventMemory(roi, GEOMETRY, sensor=known)
        memory.add(t_us, x, y, on)
        kept.append(memory.capped)
    assert kept == [0, 20]


def pairs_line(lag_um: float, spread: float, seed: int) -> Line | None:
    """What pairs say of a scene whose pixels are up to *spread* times slower than the brightest."""
    turns, slowness = turns_of_a_lag(lag_um, spread=spread, seed=seed)
    return turns.line(slowness)[0]


@pytest.mark.parametrize("seed", range(5))
def test_a_calibrated_lag_is_used_where_the_scene_cannot_tell_it(seed: int) -> None:
    prior = LagPrior.of(SensorProfile(lag_us=500.0, lag_sigma_us=20.0), 4e-3)
    assert prior is not None
    assert prior.at == pytest.approx(2.0)
    lag = prior.with_line(pairs_line(2.0, 1.05, seed))
    assert lag.sigma < 1.1  # half of the lag: the light may be another
    assert abs(lag.at - 2.0) < 3 * lag.sigma


def test_a_scene_that_tells_its_lag_outvotes_the_calibration() -> None:
    prior = LagPrior.of(SensorProfile(lag_us=750.0, lag_sigma_us=100.0), 4e-3)
    assert prior is not None
    lag = prior.with_line(pairs_line(1.0, 6.0, 1))
    assert lag.at == pytest.approx(1.0, abs=0.1)
    assert lag.sigma < 0.3
    assert prior.with_line(None) == Lag(prior.at, prior.sigma)


def test_without_a_lag_there_is_no_prior() -> None:
    assert LagPrior.of(None, 4e-3) is None
    assert LagPrior.of(SensorProfile(), 4e-3) is None
    assert LagPrior.of(SensorProfile(lag_us=1.0, lag_sigma_us=1.0), 0.0) is None
