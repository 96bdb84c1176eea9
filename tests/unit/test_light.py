"""What an event is worth follows from that a lens makes no light."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elpd.vision.light import BRIGHTEST, in_focus, worth_of_an_event

MARGIN = 14


def pictures(seed: int, blur_px: float) -> tuple[np.ndarray, np.ndarray]:
    """A scene of grey blocks, bright and dark, in focus and out of it; (height, width), linear."""
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(0.05, 1.0, (16, 16)).astype(np.float32)
    sharp = cv2.resize(blocks, (128, 128), interpolation=cv2.INTER_NEAREST)
    return sharp, cv2.GaussianBlur(sharp, (0, 0), blur_px, borderType=cv2.BORDER_REFLECT)


def levels(sharp: np.ndarray, blurred: np.ndarray, worth: float) -> np.ndarray:
    """Return whole events of the change: pixels start anywhere within a threshold."""
    held_back = np.random.default_rng(9).random(sharp.shape)
    return np.floor(np.log(sharp / blurred) / worth + held_back).astype(np.float32)


@pytest.mark.parametrize("worth", [0.05, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_worth_is_found_from_one_blurred_picture(worth: float, seed: int) -> None:
    sharp, blurred = pictures(seed, 6.0)
    found = worth_of_an_event(blurred, levels(sharp, blurred, worth), MARGIN)
    assert found == pytest.approx(worth, rel=0.2)


@given(st.floats(0.1, 250.0))
@settings(deadline=None, max_examples=20)
def test_the_unit_of_light_does_not_matter(unit: float) -> None:
    sharp, blurred = pictures(3, 6.0)
    level = levels(sharp, blurred, 0.2)
    plain = worth_of_an_event(blurred, level, MARGIN)
    assert worth_of_an_event(np.float32(unit) * blurred, level, MARGIN) == pytest.approx(plain, rel=1e-3)


def test_light_that_only_grows_is_not_a_lens_and_has_no_worth() -> None:
    _, blurred = pictures(1, 6.0)
    assert worth_of_an_event(blurred, np.ones_like(blurred), MARGIN) is None
    assert worth_of_an_event(blurred, -np.ones_like(blurred), MARGIN) is None
    assert worth_of_an_event(np.zeros_like(blurred), np.ones_like(blurred), MARGIN) is None
    assert worth_of_an_event(blurred, np.zeros_like(blurred), MARGIN) is None


def test_the_picture_in_focus_is_nearer_to_the_scene_than_the_blurred_one() -> None:
    sharp, blurred = pictures(2, 6.0)
    level = levels(sharp, blurred, 0.2)
    worth = worth_of_an_event(blurred, level, MARGIN)
    assert worth is not None
    seen = in_focus(blurred, level, worth, MARGIN)
    inside = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    scene = np.minimum(sharp / np.percentile(sharp[inside], BRIGHTEST), 1.0)
    before = np.minimum(blurred / np.percentile(blurred[inside], BRIGHTEST), 1.0)
    far, near = (np.abs(np.log(one[inside] / scene[inside])).mean() for one in (before, seen))
    assert near < 0.4 * far
    assert seen.max() <= 1.0
