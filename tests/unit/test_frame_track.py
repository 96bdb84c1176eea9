"""What the frames of a pass say of the lens."""

from __future__ import annotations

import numpy as np
import pytest

from elpd.focus.frame_track import FrameTrack, show_change
from elpd.records import Roi
from elpd.units import SensorUs
from elpd.vision.track import Sharpness


def seen(values: np.ndarray) -> FrameTrack:
    track = FrameTrack(Roi(0, 0, 32, 32), follow=False)
    track.seen = [(SensorUs(20_000 * k), Sharpness(np.full(4, value))) for k, value in enumerate(values)]
    return track


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("count", [0, 1, 2, 5, 20, 60])
def test_noise_is_no_change(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    assert not show_change([seen(random.normal(level, 3.0, count)) for level in (-12.0, -8.0)])


@pytest.mark.parametrize("count", [20, 60])
def test_a_hill_of_sharpness_is_one_also_under_noise(count: int) -> None:
    place = np.linspace(-1.5, 1.5, count)
    hill = -6.0 - 8.0 * place**2
    assert show_change([seen(hill)])
    assert show_change([seen(hill + np.random.default_rng(1).normal(0.0, 1.5, count)), seen(hill[::-1])])


def test_a_picture_that_never_changes_at_all_says_that_the_lens_stands() -> None:
    assert not show_change([seen(np.full(30, -8.0))])
    assert not show_change([])
