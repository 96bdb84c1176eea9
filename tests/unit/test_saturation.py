"""A read-out that is full is seen, one that is busy is not."""

import numpy as np
import pytest

from elpd.vision.saturation import RateWatch


def times(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([1000 * k + (np.arange(n) * 1000) // max(n, 1) for k, n in enumerate(counts)])


def heard(counts: np.ndarray) -> float | None:
    watch = RateWatch()
    for part in np.array_split(times(counts), 13):
        watch.add(part)
    return watch.plateau_mev_s()


def test_independent_events_at_any_rate_are_no_plateau() -> None:
    for seed in range(200):
        rng = np.random.default_rng(seed)
        hill = 2000 * np.exp(-0.5 * ((np.arange(100) - 60) / 15) ** 2) + 20
        assert heard(rng.poisson(hill)) is None
        assert heard(rng.poisson(np.full(80, 300.0))) is None


def test_a_limit_is_seen_and_measured() -> None:
    rng = np.random.default_rng(0)
    hill = rng.poisson(2000 * np.exp(-0.5 * ((np.arange(100) - 60) / 15) ** 2) + 20)
    assert heard(np.minimum(hill, 1000)) == pytest.approx(1.0, rel=0.01)


def test_short_or_silent_recordings_say_nothing() -> None:
    assert heard(np.full(10, 500)) is None
    assert heard(np.full(100, 10)) is None
    assert RateWatch().plateau_mev_s() is None


def test_a_clock_that_jumps_is_not_counted() -> None:
    watch = RateWatch()
    watch.add(np.array([0, 1]))
    watch.add(np.array([1 << 60]))
    assert watch.plateau_mev_s() is None
