"""Parts of an image that are sharpest at different places."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from elpd.vision.bands import BandFocus
from elpd.vision.image_parts import SIDE, ImageParts, spread_of
from elpd.vision.integral import Vertex

SIZE, MARGIN = 128, 14
TICKS = np.linspace(20.0, 80.0, 31)


def halves(left_um: float, right_um: float) -> ImageParts:
    """Return what is measured of a picture whose halves are sharpest at two places, the curve 20 wide."""
    grain = 9.0 * np.random.default_rng(2).standard_normal((SIZE, SIZE)).astype(np.float32)
    images = np.empty((TICKS.size, SIZE, SIZE), np.float32)
    for k, place in enumerate(TICKS):
        for half, focus in ((slice(None, SIZE // 2), left_um), (slice(SIZE // 2, None), right_um)):
            blur_px = float(np.hypot(1.0, 0.06 * (place - focus)))
            images[k][:, half] = cv2.GaussianBlur(grain, (0, 0), blur_px)[:, half]
    whole = BandFocus(50.0, 1.0, Vertex(50.0, 1.0, 20.0, 9), 0.0, 1.0)
    return ImageParts.of(images, TICKS, np.ones((SIZE, SIZE), np.float32), MARGIN, whole, 76.0)


def test_each_part_has_its_own_place() -> None:
    parts = halves(42.0, 57.0)
    at = parts.at.reshape(SIDE, SIDE)
    np.testing.assert_allclose(at[:, 0], 42.0, atol=1.0)
    np.testing.assert_allclose(at[:, -1], 57.0, atol=1.0)
    assert (parts.energy > 0.0).all()


def test_two_depths_are_told_from_passes_there_and_back() -> None:
    there = halves(42.0, 57.0)
    back = ImageParts(-there.at + 6.0, there.energy)  # all of it is late both ways
    found = spread_of([there], [back])
    assert found is not None
    assert found.certain
    assert found.groups is not None
    assert found.groups[1] - found.groups[0] == pytest.approx(15.0, abs=2.0)
    assert spread_of([there], []) is None


def test_a_flat_region_has_one_place() -> None:
    found = spread_of([halves(50.0, 50.0)], [ImageParts(-halves(52.0, 52.0).at, np.ones(SIDE * SIDE))])
    assert found is not None
    assert found.sigma < 1.0


def test_parts_that_nobody_saw_tell_nothing() -> None:
    dark = ImageParts(np.full(SIDE * SIDE, np.nan), np.zeros(SIDE * SIDE))
    assert spread_of([dark], [dark]) is None
