"""What several passes over focus make of a scene: whether it moved between them, and what is believed then."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from elpd.focus import passes as room
from elpd.focus.heading import Stale
from elpd.focus.passes import NO_PLAY, Passes
from elpd.records import Geometry, Roi
from elpd.vision.image_parts import ImageParts
from elpd.vision.memory import BuiltImage, EventMemory
from elpd.vision.witness import Witness

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import FocusEstimate

SIDE = 128


def scene(shift_px: int = 0) -> NDArray[np.float32]:
    grain = np.random.default_rng(4).standard_normal((SIDE, SIDE + 40)).astype(np.float32)
    return np.ascontiguousarray(30.0 * cv2.GaussianBlur(grain, (0, 0), 1.5)[:, 20 + shift_px : 20 + shift_px + SIDE])


def said(at_um: float, shift_px: int) -> room.Testimony:
    still = Witness("pairs", at_um, 0.5, shared=12.0)
    moving = Witness("vertex", at_um, 1.0, shared=12.0)
    return room.Testimony((still,), if_it_moves=(moving,), picture=scene(shift_px))


def test_a_scene_that_lies_elsewhere_in_the_second_pass_moves_and_its_pairs_are_not_believed() -> None:
    passes = Passes()
    passes.add(said(57.0, 0), 1, (0.0, 1.0))
    passes.add(said(-43.0, 1), -1, (2.0, 3.0))
    assert passes.scene_moves
    found = passes.estimate(NO_PLAY)
    assert found is not None
    assert found.focus_um == pytest.approx(50.0, abs=0.1)
    assert {name for name, *_ in found.contributions} == {"vertex"}


def test_a_scene_that_lies_where_it_lay_is_still_however_often_it_is_passed() -> None:
    passes = Passes()
    for k, sign in enumerate((1, -1, 1)):
        passes.add(said(sign * 50.0, 0), sign, (2.0 * k, 2.0 * k + 1.0))
    assert not passes.scene_moves


def events(memory: EventMemory, begin_us: int, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = (rng.integers(SIDE, size=count).astype(np.uint16) for _ in range(2))
    memory.add(begin_us + np.arange(count, dtype=np.int64), x, y, rng.integers(2, size=count).astype(np.uint8))


def test_the_sharpest_image_is_that_of_the_peak_upon_what_was_there_before() -> None:
    start = BuiltImage(scene(), 1000)
    memory = EventMemory(Roi(0, 0, SIDE, SIDE), Geometry(SIDE, SIDE), start=start)
    memory.advance(1, 0.0)
    peak = memory.sharpest()
    assert np.array_equal(peak, scene())
    assert np.shares_memory(peak, start.levels) is False


@pytest.mark.parametrize("earlier", [0, 10_000_000])
def test_what_was_shuffled_before_a_pass_does_not_hide_its_peak(earlier: int) -> None:
    """The image becomes sharp and dull again, upon one to which any number of events had come before."""
    sharp = np.abs(scene())
    start = BuiltImage(np.float32(0.3) * scene(), earlier)
    memory = EventMemory(Roi(0, 0, SIDE, SIDE), Geometry(SIDE, SIDE), start=start)
    memory.advance(0, 0.0)
    bright = np.argwhere(sharp > np.percentile(sharp, 60))
    t_us, place = 1, 0.0
    for way in (1, -1):
        for _ in range(8):
            on = (way * scene()[bright[:, 0], bright[:, 1]] > 0).astype(np.uint8)
            times = np.full(len(bright), t_us, np.int64)
            memory.add(times, bright[:, 1].astype(np.uint16), bright[:, 0].astype(np.uint16), on)
            t_us, place = t_us + 6000, place + 3.0
            memory.advance(t_us, place)
    assert memory.peak_passed


def test_a_picture_is_stale_once_the_scene_has_gone_two_pixels_and_not_while_it_only_sharpens() -> None:
    picture = cv2.GaussianBlur(scene(), (0, 0), 5.0)
    follows, stands = Stale(picture), Stale(picture)
    for k in range(40):
        sharper = cv2.GaussianBlur(scene(), (0, 0), 5.0 - 0.1 * k)
        stands.tick(sharper - picture, 750 * k)
        moved = cv2.warpAffine(sharper, np.array([[1.0, 0.0, 0.1 * k], [0.0, 1.0, 0.0]]), (SIDE, SIDE))
        follows.tick(moved - picture, 750 * k)
        assert not follows.is_so or k > 12
    assert follows.is_so
    assert not stands.is_so


def in_motion(at_um: float, parts_um: NDArray[np.float64]) -> room.Testimony:
    moving = Witness("vertex", at_um, 1.0, shared=12.0)
    return room.Testimony((moving,), scene_moves=True, image_parts=ImageParts(parts_um, np.ones(parts_um.size)))


def passed_there_and_back(there_um: NDArray[np.float64], back_um: NDArray[np.float64]) -> tuple[Passes, FocusEstimate]:
    passes = Passes()
    passes.add(in_motion(57.0, 57.0 + there_um), 1, (0.0, 1.0), 3.0)
    passes.add(in_motion(-43.0, -43.0 + back_um), -1, (2.0, 3.0), 3.0)
    found = passes.estimate(NO_PLAY)
    assert found is not None
    return passes, found


def test_of_two_depths_in_a_scene_that_moves_the_first_met_is_taken() -> None:
    apart = np.repeat([-8.0, 7.0], [7, 8])
    passes, found = passed_there_and_back(apart, -apart)
    assert found.focus_um == pytest.approx(42.0)
    assert passes.depths_um == pytest.approx((42.0, 57.0))


def test_parts_that_lie_apart_by_chance_are_at_one_depth() -> None:
    apart = np.repeat([-8.0, 7.0], [7, 8])
    passes, found = passed_there_and_back(apart, np.zeros(15))
    assert found.focus_um == pytest.approx(50.0, abs=0.1)
    assert passes.depths_um == ()


def test_parts_at_many_depths_are_in_the_error() -> None:
    slope = np.linspace(-10.0, 10.0, 16)
    passes, found = passed_there_and_back(slope, -slope)
    assert found.focus_um == pytest.approx(50.0, abs=0.1)
    assert found.sigma_um > 5.0
    assert passes.depths_um == ()
