"""Thresholds by there-and-backs, against sensors whose thresholds are known."""

import numpy as np
import pytest
from elpd_drivers.sim.sensor import BiasLevels
from sensor_evidence import there_and_back

from elpd.calibrate.quantity import Quantity
from elpd.calibrate.thresholds import Balance, NoiseRates, measure_absolute, measure_balance

NOISE = NoiseRates(0.6, 0.5)


def balance(seed: int, scene: str, focus: BiasLevels, **other: float | bool) -> Balance:
    _, evidence = there_and_back(seed, scene, focus=focus, **other)
    good = np.ones((evidence.geometry.height, evidence.geometry.width), np.bool_)
    return measure_balance(evidence.sweeps, NOISE, good, evidence.geometry)


def sigmas_off(found: Quantity, truth: float) -> float:
    assert found.value is not None, str(found)
    assert found.sigma is not None, str(found)
    return abs(found.value - truth) / found.sigma


@pytest.mark.parametrize(
    ("seed", "scene", "c_on", "c_off", "refractory_us"),
    [(1, "camera", 0.2, 0.15, 500), (2, "coffee", 0.15, 0.22, 1000), (3, "astronaut", 0.18, 0.18, 300)],
)
def test_ratio_and_mismatch_are_found_within_their_errors(
    seed: int, scene: str, c_on: float, c_off: float, refractory_us: int
) -> None:
    mismatch = 0.08
    found = balance(seed, scene, BiasLevels(c_on, c_off, refractory_us), mismatch=mismatch)
    assert sigmas_off(found.ratio, c_on / c_off) < 4
    assert sigmas_off(found.mismatch, mismatch) < 4
    assert found.ratio.sigma is not None
    assert found.ratio.sigma < 0.03
    assert found.mismatch.sigma is not None
    assert found.mismatch.sigma < 0.02


def test_deafness_is_extrapolated_away() -> None:
    """With a long refractory period the raw ratio of either speed is off by many of its errors."""
    focus = BiasLevels(0.2, 0.13, 1500)
    _, evidence = there_and_back(4, "camera", focus=focus)
    on, off = evidence.sweeps[1].events.counts(evidence.geometry)
    good = np.ones(on.shape, np.bool_)
    found = measure_balance(evidence.sweeps, NOISE, good, evidence.geometry)
    truth = focus.c_on / focus.c_off
    assert sigmas_off(found.ratio, truth) < 4
    assert found.ratio.sigma is not None
    assert abs(off.sum() / on.sum() - truth) > 4 * found.ratio.sigma


def test_a_lens_that_stands_still_is_noticed() -> None:
    found = balance(1, "camera", BiasLevels(0.18, 0.18, 500), still=True)
    assert "nothing changed while the lens should have moved" in str(found.ratio)
    assert "check that the motor moves the lens" in str(found.mismatch)


def test_one_speed_is_not_enough() -> None:
    _, evidence = there_and_back(1, "camera", size=(48, 48))
    good = np.ones((48, 48), np.bool_)
    found = measure_balance(evidence.sweeps[:1], NOISE, good, evidence.geometry)
    assert str(found.ratio) == "not measurable, because that takes there-and-backs at two speeds"


def test_little_texture_is_said_to_be_little() -> None:
    _, evidence = there_and_back(1, "camera", size=(48, 32))
    good = np.zeros((32, 48), np.bool_)
    good[20:, :] = True
    found = measure_balance(evidence.sweeps, NOISE, good, evidence.geometry)
    assert "pixels only made" in str(found.ratio)
    absolute = measure_absolute((), found.ratio, good, evidence.geometry)
    assert "takes the ratio" in str(absolute.on)
