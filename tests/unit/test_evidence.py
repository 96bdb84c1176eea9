"""Whether sharpness was lost: noise is not counted, a picture that blurs is, a pixel that fires alone is not."""

from __future__ import annotations

import numpy as np
import pytest

from elpd.events.decoder import EventArrays
from elpd.records import Roi
from elpd.service.evidence import AFTERGLOW_S, BIN_S, Evidence

SIDE = 40
ROI = Roi(10, 10, SIDE, SIDE)
ALLOWANCE = 100_000.0


def evidence(rng: np.random.Generator) -> tuple[Evidence, np.ndarray]:
    weights = np.zeros((60, 60))
    weights[10:50, 10:50] = rng.normal(0, 300, (SIDE, SIDE))
    return Evidence(weights[10:50, 10:50], ROI, ALLOWANCE), weights


def events(x: np.ndarray, y: np.ndarray, on: np.ndarray) -> EventArrays:
    return EventArrays(np.zeros(x.size, np.int64), x.astype(np.uint16), y.astype(np.uint16), on.astype(np.uint8))


def noise(rng: np.random.Generator, count: int) -> EventArrays:
    return events(rng.integers(0, 60, count), rng.integers(0, 60, count), rng.integers(0, 2, count))


def listen(heard: Evidence, rng: np.random.Generator, begin_s: float, seconds: float) -> float:
    now_s = begin_s
    while now_s < begin_s + seconds:
        now_s += 0.05
        heard.hear(noise(rng, 100), now_s)
    return now_s


def test_noise_alone_is_no_loss() -> None:
    rng = np.random.default_rng(1)
    heard, _ = evidence(rng)
    listen(heard, rng, 0.0, 120.0)
    assert heard.loss == 0.0
    assert heard.quiet_s > 1.0


@pytest.mark.parametrize("sign", [1, -1])
def test_a_picture_that_blurs_is_a_loss_and_one_that_sharpens_again_takes_it_back(sign: int) -> None:
    rng = np.random.default_rng(2)
    heard, weights = evidence(rng)
    now_s = listen(heard, rng, 0.0, 5.0)
    rows, columns = np.nonzero(np.abs(weights) > 250)
    losing = weights[rows, columns] * sign > 0
    for _ in range(4):
        now_s += BIN_S
        heard.hear(events(columns, rows, losing), now_s)
    assert (heard.loss > 1.0) is (sign == 1)
    assert heard.quiet_s < 1.0
    now_s = listen(heard, rng, now_s, 2.0)
    for _ in range(4):
        now_s += BIN_S
        heard.hear(events(columns, rows, ~losing), now_s)
    assert (heard.loss > 1.0) is (sign == -1)


def test_a_pixel_that_fires_by_itself_is_left_out() -> None:
    rng = np.random.default_rng(3)
    heard, weights = evidence(rng)
    row, column = np.unravel_index(int(np.argmax(weights)), weights.shape)
    now_s = 0.0
    for _ in range(100):
        now_s += BIN_S
        hot = 200
        heard.hear(events(np.full(hot, column), np.full(hot, row), np.ones(hot)), now_s)
        heard.hear(noise(rng, 100), now_s)
    assert heard.loss == 0.0


def test_what_comes_before_the_pixels_have_settled_is_not_heard() -> None:
    rng = np.random.default_rng(4)
    heard, weights = evidence(rng)
    rows, columns = np.nonzero(np.abs(weights) > 250)
    heard.hear(events(columns, rows, weights[rows, columns] > 0), 0.0)
    heard.hear(events(columns, rows, weights[rows, columns] > 0), 0.9 * AFTERGLOW_S)
    listen(heard, rng, AFTERGLOW_S, 3.0)
    assert heard.loss == 0.0
