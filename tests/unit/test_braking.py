"""Braking: the way after a stop, from what a driver assumes or from what was measured."""

from __future__ import annotations

from dataclasses import replace

import pytest

from elpd.motion.braking import braking_from
from elpd.records import LensCapabilities, LensLimits
from elpd.units import Steps

UM = 0.3125
LIMITS = LensLimits(Steps(0), Steps(8000), 38_400.0, 1_280_000.0)
GRBL = LensCapabilities(
    native_velocity=False,
    abrupt_stop=False,
    stop_on_command=True,
    homing=True,
    stop_onset_ms=45.0,
    stop_onset_sigma_ms=3.0,
)


def test_without_a_calibration_the_way_is_onset_and_ramp_of_the_limits() -> None:
    braking = braking_from(4000.0, GRBL, LIMITS, UM)
    ramp_um = 4000.0**2 / (2 * 1_280_000.0 * UM)
    assert braking.ramp_um == ramp_um
    assert braking.um == pytest.approx(180.0 + ramp_um)
    assert braking.longest_um == 4000.0 * (45.0 + 2 * 3.0) / 1000.0 + ramp_um
    assert braking.sigma_um == pytest.approx(12.0)
    assert not braking.stops_on_detect(6.0)


def test_an_abrupt_stop_has_no_ramp_unless_one_was_measured() -> None:
    tic = replace(GRBL, abrupt_stop=True, stop_onset_ms=0.2, stop_onset_sigma_ms=0.03)
    at_once = braking_from(4000.0, tic, LIMITS, UM)
    assert at_once.ramp_um == 0.0
    assert at_once.stops_on_detect(6.0)
    soft = braking_from(4000.0, replace(tic, stop_deceleration_sps2=320_000.0), LIMITS, UM)
    assert soft.ramp_um == pytest.approx(80.0)
    assert not soft.stops_on_detect(6.0)


def test_the_error_of_a_measured_deceleration_is_part_of_the_error() -> None:
    known = replace(GRBL, stop_onset_sigma_ms=0.0, stop_deceleration_sps2=640_000.0)
    doubtful = replace(known, stop_deceleration_sigma_sps2=64_000.0)
    assert braking_from(4000.0, known, LIMITS, UM).sigma_um == 0.0
    braking = braking_from(4000.0, doubtful, LIMITS, UM)
    assert braking.sigma_um == pytest.approx(0.1 * braking.ramp_um)
    assert braking.longest_um == pytest.approx(braking.um + 2 * braking.sigma_um)
