"""Photoreceptor lag, against sensors whose time constants are known."""

import numpy as np
import pytest
from elpd_drivers.sim.optics import DARK
from elpd_drivers.sim.sensor import BiasLevels
from sensor_evidence import there_and_back

from elpd.calibrate.evidence import Evidence
from elpd.calibrate.lag import Lag, measure_lag

DEPTH_UM = 6.0


def measured(evidence: Evidence) -> Lag:
    good = np.ones((evidence.geometry.height, evidence.geometry.width), np.bool_)
    return measure_lag(evidence.sweeps, evidence.brightness, good, evidence.geometry, DEPTH_UM)


@pytest.mark.parametrize(
    ("seed", "scene", "lag_us"), [(1, "camera", 60.0), (2, "astronaut", 40.0), (3, "camera", 20.0)]
)
def test_the_lag_of_bright_and_dark_is_found_within_its_error(seed: int, scene: str, lag_us: float) -> None:
    setup, evidence = there_and_back(seed, scene, focus=BiasLevels(0.18, 0.18, 300), lag_us=lag_us)
    found = measured(evidence)
    light = setup.canvas[32:-32, 32:-32]
    truth_us = lag_us / (np.percentile(light, 99) + DARK)
    assert found.per_slowness.value is not None, str(found.per_slowness)
    assert found.per_slowness.sigma is not None, str(found.per_slowness)
    assert abs(found.per_slowness.value - truth_us) < 3 * found.per_slowness.sigma
    assert found.per_slowness.sigma < truth_us
    assert found.constant.value is not None
    assert found.constant.sigma is not None
    assert abs(found.constant.value + 300) < 4 * found.constant.sigma  # events come a refractory period early
    assert len(found.classes) >= 3
    lags = [one.lag.value or 0.0 for one in found.classes]
    assert lags[0] > lags[-1]  # the darkest is the slowest


def test_without_light_and_shade_or_a_crossing_it_says_why() -> None:
    _, evidence = there_and_back(1, "camera", size=(64, 64))
    good = np.ones((64, 64), np.bool_)
    no_picture = measure_lag(evidence.sweeps, None, good, evidence.geometry, DEPTH_UM)
    assert "nothing says which pixels are bright" in str(no_picture.per_slowness)
    grey = np.full((64, 64), 0.5, np.float32)
    no_shade = measure_lag(evidence.sweeps, grey, good, evidence.geometry, DEPTH_UM)
    assert "not apart enough" in str(no_shade.per_slowness)
    _, still = there_and_back(1, "camera", size=(64, 64), still=True)
    nothing = measure_lag(still.sweeps, still.brightness, good, still.geometry, DEPTH_UM)
    assert "focus was not passed at two speeds" in str(nothing.per_slowness)
