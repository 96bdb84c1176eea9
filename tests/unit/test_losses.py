"""What deaf pixels lose, put back."""

from __future__ import annotations

from typing import Any

import naive_vision
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.vision.integral import group_by_pixel
from elpd.vision.losses import MOST_LOST, lost_levels, steps_with_losses

EVENTS = st.lists(st.tuples(st.integers(0, 900), st.integers(0, 2), st.booleans()), min_size=1, max_size=60)


@given(EVENTS, st.sampled_from([0.0, 1.0, 120.0, 500.0]))
def test_the_kernels_are_their_slow_twin(rows: Any, deaf_us: float) -> None:
    t_us = np.cumsum([row[0] for row in rows]).astype(np.int64)
    pixel = np.array([row[1] for row in rows], np.int64)
    on = np.array([row[2] for row in rows], np.uint8)
    starts, order = group_by_pixel(pixel, 3)
    steps = np.empty(on.size)
    steps_with_losses(starts, t_us[order], on[order], deaf_us, steps)
    x = pixel.astype(np.uint16)
    lost = lost_levels(t_us, x, np.zeros_like(x), on, deaf_us, (1, 3))
    for k in range(3):
        events = [(float(t), bool(p)) for t, p, one in zip(t_us, on, pixel, strict=True) if one == k]
        expected = naive_vision.steps_with_losses(events, deaf_us, MOST_LOST) if events else []
        np.testing.assert_allclose(steps[starts[k] : starts[k + 1]], expected, rtol=1e-9)
        net = sum(expected) - sum(1.0 if p else -1.0 for _, p in events)
        assert lost[0, k] == pytest.approx(net, rel=1e-4, abs=1e-4), "both say the same of a whole stretch"


@pytest.mark.parametrize("per_us", [1e-4, 5e-4, 2e-3])
def test_a_level_that_rises_evenly_is_told_whole(per_us: float) -> None:
    """A deaf pixel sends an event each time that it heard a threshold, and loses what went by meanwhile."""
    deaf_us = 500.0
    apart_us = 1.0 / per_us + deaf_us
    t_us = np.rint(apart_us * np.arange(41)).astype(np.int64)
    on = np.ones(41, np.uint8)
    steps = np.empty(41)
    steps_with_losses(np.array([0, 41]), t_us, on, deaf_us, steps)
    assert 0.99 * per_us * apart_us * 40 > 40, "so many thresholds went by, and 40 were counted"
    assert steps[1:].sum() == pytest.approx(per_us * apart_us * 40, rel=0.03)


def test_a_turn_and_events_far_apart_lose_nothing() -> None:
    t_us = np.array([0, 600, 1_000_000, 2_000_000], np.int64)
    steps = np.empty(4)
    steps_with_losses(np.array([0, 4]), t_us, np.array([1, 0, 0, 0], np.uint8), 500.0, steps)
    np.testing.assert_allclose(steps, [1.0, -1.0, -1.0, -1.0], atol=2e-3)


def test_events_as_close_as_the_period_put_back_no_more_than_the_most() -> None:
    steps = np.empty(2)
    steps_with_losses(np.array([0, 2]), np.array([0, 400], np.int64), np.ones(2, np.uint8), 500.0, steps)
    np.testing.assert_allclose(steps, 1.0 + 0.5 * MOST_LOST)
