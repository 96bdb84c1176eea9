"""Noise and hot pixels, against counts and sensors whose truth is known."""

import numpy as np
import pytest
from elpd_drivers.sim.optics import Lamp
from sensor_evidence import rest_of
from sim_rigs import Setup

from elpd.calibrate.evidence import Columns, Rest
from elpd.calibrate.resting import FALSE_ALARMS, hot_limit, measure_rest
from elpd.records import Geometry

SIZE = (96, 80)


@pytest.mark.parametrize("seed", range(3))
def test_noise_rates_are_found_within_their_errors(seed: int) -> None:
    noise_hz, leak_hz = (0.2, 1.0, 4.0)[seed], 0.1
    setup = Setup(seed=seed, size=SIZE, sensor={"noise_hz": noise_hz, "leak_hz": leak_hz, "memories": False})
    found = measure_rest(rest_of(setup, 0.8), Geometry(*SIZE))
    for quantity, truth in ((found.on_hz, noise_hz / 2 + leak_hz), (found.off_hz, noise_hz / 2)):
        assert quantity.value is not None
        assert quantity.sigma is not None
        assert abs(quantity.value - truth) < 4 * quantity.sigma + 1e-3 * truth  # deafness costs a thousandth
        assert quantity.sigma < 0.1 * truth
    assert found.hot == ()
    assert found.dispersion_pixels.value == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("hertz", [2000.0, 40.0])
def test_hot_pixels_are_named_and_no_other(hertz: float) -> None:
    setup = Setup(seed=5, size=SIZE, sensor={"hot_pixels": 9, "hot_pixel_hz": hertz})
    found = measure_rest(rest_of(setup, 0.8), Geometry(*SIZE))
    assert found.hot is not None
    assert found.hot_above_hz is not None
    assert {(x, y) for x, y, _ in found.hot} == set(setup.sensor.hot)
    assert found.hot_above_hz < min(hz for _, _, hz in found.hot)
    assert found.on_hz.value == pytest.approx(0.6, abs=0.06)  # the rate of the others


def test_good_pixels_that_differ_are_not_called_hot() -> None:
    """Rates spread over pixels by a gamma distribution: a Poisson bound would name thousands."""
    random = np.random.default_rng(8)
    rates = random.gamma(2.0, 2.0, 200_000)
    counts = random.poisson(rates)
    assert (counts > 17).sum() > 500  # where a Poisson count of this mean ends
    assert (counts > hot_limit(counts)).sum() <= 1


def test_the_false_alarm_rate_is_what_is_stated() -> None:
    random = np.random.default_rng(4)
    alarms = sum(int((counts > hot_limit(counts)).sum()) for counts in random.poisson(0.7, (300, 10_000)))
    assert alarms <= 300 * FALSE_ALARMS + 4 * np.sqrt(300 * FALSE_ALARMS)


def test_hundreds_of_hot_pixels_do_not_hide_each_other() -> None:
    random = np.random.default_rng(4)
    counts = random.poisson(3.0, 10_000)
    counts[:400] = 500
    assert (counts > hot_limit(counts)).sum() == 400


def test_a_scene_that_is_not_at_rest_is_no_noise() -> None:
    setup = Setup(seed=1, size=SIZE, light={"lamp": Lamp(100.0, 0.4)})
    found = measure_rest(rest_of(setup, 0.5), Geometry(*SIZE))
    assert found.on_hz.value is None
    assert "not at rest" in str(found.on_hz)
    assert "limit 2" in str(found.on_hz)


def test_a_silent_or_short_rest_says_so() -> None:
    none = Columns(np.empty(0, np.int64), np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8))
    silent = measure_rest(Rest(none, 0, 1_000_000), Geometry(*SIZE))
    assert silent.on_hz.value == 0.0
    assert silent.on_hz.sigma is not None
    assert 0 < silent.on_hz.sigma < 1e-3
    assert "0 ON and 0 OFF" in str(silent.on_off_ratio)
    short = measure_rest(Rest(none, 0, 20_000), Geometry(*SIZE))
    assert "20 ms only" in str(short.on_hz)
    assert short.hot is None
