"""The proposed region: where there is texture, nothing where there is none, whatever the scale of the picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elpd.errors import UsageError
from elpd.records import Roi
from elpd.vision.choose import has_texture, noise_sigma, propose_roi, texture

HEIGHT, WIDTH = 160, 220
ALL = np.ones((HEIGHT, WIDTH), bool)


def noise(seed: int, sigma: float = 0.05) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, sigma, (HEIGHT, WIDTH)).astype(np.float32)


def with_patch(seed: int, x: int, y: int, side: int = 50, contrast: float = 0.5) -> np.ndarray:
    picture = noise(seed)
    detail = cv2.GaussianBlur(np.random.default_rng(seed + 1).normal(size=(side, side)), (0, 0), 2.0)
    picture[y : y + side, x : x + side] += (contrast * detail / detail.std()).astype(np.float32)
    return picture


@given(st.integers(0, 1000), st.integers(12, 150), st.integers(12, 90))
@settings(max_examples=20)
def test_the_textured_patch_is_proposed(seed: int, x: int, y: int) -> None:
    roi = propose_roi(with_patch(seed, x, y), ALL, (50, 50))
    assert roi is not None
    assert abs(roi.x - x) <= 10
    assert abs(roi.y - y) <= 10
    assert roi == propose_roi(with_patch(seed, x, y), ALL, (50, 50))


@given(st.floats(1e-3, 1e3), st.floats(-100, 100))
@settings(max_examples=20)
def test_scale_and_offset_of_the_picture_do_not_matter(scale: float, offset: float) -> None:
    for picture, found in ((with_patch(3, 60, 40), True), (noise(3), False)):
        changed = (picture.astype(np.float64) * scale + offset * scale).astype(np.float32)
        assert (propose_roi(changed, ALL, (50, 50)) is not None) is found


@pytest.mark.parametrize("seed", range(25))
def test_flat_and_shaded_walls_yield_nothing(seed: int) -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    vignette = -((y - 80) ** 2 + (x - 110) ** 2) / 110**2 * 0.5
    for shade in (0.0, x / WIDTH * 1.5, vignette):
        assert propose_roi((noise(seed) + shade).astype(np.float32), ALL, (64, 48)) is None


def test_a_picture_without_noise_is_judged_too() -> None:
    assert propose_roi(np.zeros((HEIGHT, WIDTH), np.float32), ALL, (40, 40)) is None
    bars = np.zeros((HEIGHT, WIDTH), np.float32)
    bars[60:90, 100:140:8] = 1.0
    roi = propose_roi(bars, ALL, (40, 30))
    assert roi is not None
    assert abs(roi.x - 100) <= 12


def test_a_lamp_does_not_outweigh_a_page_of_text() -> None:
    picture = with_patch(5, 20, 20, side=60, contrast=0.4)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    picture[np.hypot(x - 170, y - 110) < 7] += 8.0
    roi = propose_roi(picture, ALL, (60, 60))
    assert roi is not None
    assert roi.x < 60


def test_holes_and_their_rims_do_not_count() -> None:
    picture, valid = noise(6), ALL.copy()
    picture[50:100, 60:120] = -5.0
    valid[50:100, 60:120] = False
    assert propose_roi(picture, valid, (40, 40)) is None
    assert propose_roi(picture, np.zeros_like(valid), (40, 40)) is None


def test_scores_of_a_given_region() -> None:
    picture = with_patch(8, 60, 40)
    patch, wall = Roi(60, 40, 50, 50), Roi(150, 100, 50, 50)
    assert has_texture(picture, ALL, patch)
    assert not has_texture(picture, ALL, wall)
    assert texture(picture, ALL, patch) > 20 * max(texture(picture, ALL, wall), 0.1)
    assert not has_texture(picture, np.zeros_like(ALL), patch)


def test_noise_is_measured_past_edges_and_slopes() -> None:
    picture = noise(9, 0.07) + np.linspace(0, 5, WIDTH, dtype=np.float32)
    picture[:, 100:] += 3.0
    assert noise_sigma(picture, ALL) == pytest.approx(0.07, rel=0.05)
    assert noise_sigma(picture, np.zeros_like(ALL)) == 0.0


@pytest.mark.parametrize(
    ("size", "margin_px"), [((0, 5), 8), ((300, 20), 8), ((20, 150), 8), ((20, 20), -1), ((1, 1), 90)]
)
def test_a_region_that_does_not_fit_is_refused(size: tuple[int, int], margin_px: int) -> None:
    with pytest.raises(UsageError, match="does not fit"):
        propose_roi(noise(1), ALL, size, margin_px)


def test_the_largest_region_that_fits_is_the_whole_inside() -> None:
    roi = propose_roi(with_patch(1, 60, 40), ALL, (WIDTH - 16, HEIGHT - 16))
    assert roi == Roi(8, 8, WIDTH - 16, HEIGHT - 16)
