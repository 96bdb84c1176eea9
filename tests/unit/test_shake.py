"""How much the camera turned, by its gyroscope."""

from __future__ import annotations

import math

import numpy as np
import pytest

from elpd.focus.shake import Shake
from elpd.records import ImuSample
from elpd.units import SensorUs


def samples(rotations: object) -> tuple[ImuSample, ...]:
    rows = np.asarray(rotations, float).tolist()
    return tuple(ImuSample(SensorUs(1000 * k), (0.0, 0.0, 9.8), tuple(row), 30.0) for k, row in enumerate(rows))


@pytest.mark.parametrize("offset", [0.0, 0.05])
def test_it_is_the_root_mean_square_about_the_gyroscopes_own_zero(offset: float) -> None:
    turning = np.random.default_rng(5).normal(0, [0.1, 0.02, 0.0], (1000, 3))
    shake = Shake()
    for begin in range(0, 1000, 7):
        shake.hear(samples(turning[begin : begin + 7] + offset))
    assert shake.rms_rad_s == pytest.approx(math.sqrt(turning.var(axis=0).sum()))


def test_a_rig_at_rest_is_told_as_such_and_silence_is_not() -> None:
    shake = Shake()
    assert shake.rms_rad_s is None
    shake.hear(samples([[math.nan] * 3] * 5))
    assert shake.rms_rad_s is None
    shake.hear(samples([[0.01, 0.02, 0.03]] * 5))
    assert shake.rms_rad_s == pytest.approx(0.0, abs=1e-9)
