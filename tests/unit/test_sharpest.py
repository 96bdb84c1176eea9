"""The picture in focus as a ruler: what a sweep shows of a change of focus, on both sides."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from elpd.records import Geometry, Roi
from elpd.vision.memory import EventMemory
from elpd.vision.sharpest import REACH, sharpest

SIDE = 96
ROI = Roi(16, 16, 64, 64)
THRESHOLD = 0.1
DISTANCE_UM = 12.0


def blurred(scene: np.ndarray, defocus_um: float) -> np.ndarray:
    return cv2.GaussianBlur(scene, (0, 0), float(np.hypot(0.6, 0.05 * defocus_um)))


def swept(rng: np.random.Generator, until_um: float, late_um: float) -> tuple[EventMemory, np.ndarray]:
    """Sweep from -80 um on, one event for each threshold that a level has moved by; the levels come late."""
    scene = rng.normal(0.0, 1.0, (SIDE, SIDE)).astype(np.float32)
    scene = cv2.GaussianBlur(scene, (0, 0), 1.0) * 4
    memory = EventMemory(ROI, Geometry(SIDE, SIDE))
    held = blurred(scene, -80.0)
    places = np.arange(-80.0, until_um, 1.0)
    for k, place in enumerate(places):
        steps = np.trunc((blurred(scene, place - late_um) - held) / THRESHOLD).astype(int)
        held = held + THRESHOLD * steps
        y, x = np.nonzero(steps)
        memory.add(
            np.full(y.size, 250 * k), x.astype(np.uint16), y.astype(np.uint16), (steps[y, x] > 0).astype(np.uint8)
        )
        memory.advance(250 * k + 1, float(place))
    return memory, scene


def test_it_is_the_laplacian_of_the_sharp_picture() -> None:
    memory, scene = swept(np.random.default_rng(1), 60.0, 0.0)
    ruler = sharpest(memory, ROI, 0.0, DISTANCE_UM)
    assert ruler is not None
    assert ruler.weights.shape == (ROI.height, ROI.width)
    assert ruler.weights.mean() == pytest.approx(0.0, abs=1e-9)
    laplacian = cv2.Laplacian(blurred(scene, 0.0), cv2.CV_32F)[16:80, 16:80]
    assert np.corrcoef(ruler.weights.ravel(), laplacian.ravel())[0, 1] > 0.7


@pytest.mark.parametrize("late_um", [0.0, 6.0])
def test_a_loss_is_measured_as_a_knock_would_show_it_however_late_events_come(late_um: float) -> None:
    memory, scene = swept(np.random.default_rng(2), 60.0, late_um)
    ruler = sharpest(memory, ROI, 0.0, DISTANCE_UM)
    assert ruler is not None
    assert ruler.distance_um == REACH * DISTANCE_UM
    knock = (blurred(scene, ruler.distance_um) - blurred(scene, 0.0))[16:80, 16:80] / THRESHOLD
    assert ruler.loss == pytest.approx(float((ruler.weights * knock).sum()), rel=0.35)
    assert ruler.at(DISTANCE_UM) == pytest.approx(ruler.loss / REACH**2)


def test_a_pass_that_ended_too_early_is_no_ruler() -> None:
    memory, _ = swept(np.random.default_rng(3), 8.0, 0.0)
    assert sharpest(memory, ROI, 0.0, DISTANCE_UM) is None
    assert sharpest(EventMemory(ROI, Geometry(SIDE, SIDE)), ROI, 0.0, DISTANCE_UM) is None
