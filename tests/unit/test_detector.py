"""Verdicts as stories: which way, passed or not, how often falsely."""

from typing import Any

import numpy as np
import pytest

from elpd.records import Direction, ElpSample
from elpd.units import SensorUs
from elpd.vision.detector import Detector, RestingRate


def sample(k: Any, elp: Any, energy: Any = 10_000, events: Any = 100) -> Any:
    return ElpSample(SensorUs(1000 * k), SensorUs(1000 * (k + 1)), int(elp), energy, events // 2, events - events // 2)


def judged(values: Any, **how: Any) -> Any:
    detector = Detector(**how)
    for k, value in enumerate(values):
        detector.feed(sample(k, value))
    return detector


def noise(count: Any, seed: Any, scale: Any = 100.0) -> Any:
    return scale * np.random.default_rng(seed).standard_normal(count)


def test_focus_ahead_is_approaching_and_soon() -> None:
    detector = judged(noise(50, 1) + 150)
    assert detector.direction is Direction.APPROACHING
    assert detector.first.decided_us <= 30_000
    assert detector.mutation is None


def test_focus_behind_is_receding_and_no_mutation() -> None:
    detector = judged(noise(50, 2) - 150)
    assert detector.direction is Direction.RECEDING
    assert detector.mutation is None
    assert detector.crossing_us is None


def test_the_sign_mutation_is_dated_to_the_zero_crossing() -> None:
    wave = 300.0 * np.cos(np.linspace(0.0, np.pi, 101))
    detector = judged(wave + noise(101, 3, 30.0))
    assert detector.mutation is not None
    assert detector.mutation.decided_us > detector.crossing_us
    assert detector.crossing_us == pytest.approx(50_500, abs=2_500)
    assert detector.direction is Direction.RECEDING
    assert detector.first.direction is Direction.APPROACHING


def test_scale_does_not_matter() -> None:
    wave = 300.0 * np.cos(np.linspace(0.0, np.pi, 101)) + noise(101, 4, 30.0)
    times = []
    for scale in (1, 7, 1000):
        detector = Detector()
        for k, value in enumerate(np.rint(wave)):
            detector.feed(sample(k, scale * value, energy=scale * scale * 10_000))
        times.append((detector.first.decided_us, detector.mutation.decided_us, detector.crossing_us))
    assert len(set(times)) == 1


def test_focus_that_moves_ahead_again_is_seen() -> None:
    detector = judged(np.concatenate([np.full(30, 300), np.full(30, -300), np.full(40, 300)]) + noise(100, 5))
    assert detector.mutation is not None
    assert detector.direction is Direction.APPROACHING


def test_noise_alone_says_nothing() -> None:
    verdicts = sum(judged(noise(400, seed)).first is not None for seed in range(200))
    assert verdicts <= 1


def test_correlated_noise_is_measured_and_says_nothing() -> None:
    """Swings ten times larger than independent events would give: overdispersion takes them into account."""
    verdicts = sum(judged(noise(400, seed, 1000.0)).first is not None for seed in range(100))
    assert verdicts <= 2
    assert 70.0 < judged(noise(400, 7, 1000.0)).overdispersion < 250.0


def test_what_the_region_says_at_rest_is_taken_off() -> None:
    drift = noise(100, 8) + 100
    assert judged(drift).first is not None
    assert judged(drift, rest=RestingRate(elp_per_us=0.1)).first is None


def test_settling_samples_are_not_judged() -> None:
    kick = np.concatenate([np.full(10, -900), noise(60, 9) + 150])
    assert judged(kick).first.direction is Direction.RECEDING
    assert judged(kick, arm_after_us=10_000).first.direction is Direction.APPROACHING


def test_a_handful_of_events_is_no_verdict() -> None:
    detector = Detector()
    for k in range(5):
        detector.feed(sample(k, 4000, energy=100_000, events=4))
    assert detector.first is None
    assert detector.events == 20
