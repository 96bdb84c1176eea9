"""What the simulated rig must show with default settings, every time: thirty seeds a board, and never a false focus.

``tools/acceptance.py`` prints the same figures, and more of them.
"""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from elpd_drivers.sim.scene import scene_canvas
from scenarios import assert_invariants, play

from elpd.focus.settings import FocusRequest
from elpd.records import Outcome

if TYPE_CHECKING:
    from pathlib import Path

REVERSAL_UM = 10.0
MEDIAN_TIC_UM = 1.0
MEDIAN_GRBL_UM = 2.0
BATCHES = [range(first, first + 3) for first in range(0, 30, 3)]


def focus(seed: int, start_um: float, board: str) -> float:
    """Run one whole cycle at full size; return how far from focus the glass rests."""
    story = play(f"sim.seed={seed}", f"sim.start_um={start_um}", f"sim.board={board}", small=False)
    assert_invariants(story)
    assert story.outcome is Outcome.FOCUSED, story.result
    assert all(travel_um <= REVERSAL_UM for travel_um in story.reversal_travels_um[:1])
    final = story.errors["final_error_um"]
    assert final is not None
    return abs(final)


@pytest.mark.parametrize("seeds", BATCHES, ids=str)
def test_tic_focuses_from_both_sides(seeds: range) -> None:
    errors_um = [focus(seed, start_um, "tic") for seed in seeds for start_um in (-200.0, 200.0)]
    assert statistics.median(errors_um) < 2 * MEDIAN_TIC_UM  # of six; the median of all sixty is the tool's to print


@pytest.mark.parametrize("seeds", BATCHES, ids=str)
def test_grbl_focuses(seeds: range) -> None:
    errors_um = [focus(seed, 200.0 if seed % 2 else -200.0, "grbl") for seed in seeds]
    assert statistics.median(errors_um) < 2 * MEDIAN_GRBL_UM


@pytest.mark.parametrize("seeds", [range(first, first + 25) for first in range(0, 100, 25)], ids=str)
def test_noise_under_a_cap_is_not_focused_on_with_a_picture_of_the_scene(seeds: range, tmp_path: Path) -> None:
    canvas = scene_canvas("camera", 160, 120, 0)
    picture = tmp_path / "scene.png"
    cv2.imwrite(str(picture), np.round(255 * canvas).astype(np.uint8))
    for seed in seeds:
        story = play(
            f"sim.seed={seed}",
            "sim.cap=true",
            "sim.width=160",
            "sim.height=120",
            "sim.noise_hz=20.0",
            request=FocusRequest(reference=picture),
        )
        assert_invariants(story)
        assert story.outcome in {Outcome.TOO_FEW_EVENTS, Outcome.NO_CROSSING}


NOTHING = [
    ("sim.scene=flat", "sim.width=160", "sim.height=120"),
    ("sim.cap=true", "sim.width=160", "sim.height=120"),
    ("sim.brightness=0.0005", "sim.width=160", "sim.height=120", "sim.noise_hz=0.005"),
]


@pytest.mark.parametrize("nothing", NOTHING, ids=["flat", "cap", "noise only"])
@pytest.mark.parametrize("seeds", [range(first, first + 25) for first in range(0, 100, 25)], ids=str)
def test_where_there_is_nothing_to_focus_on_nothing_is_claimed(nothing: tuple[str, ...], seeds: range) -> None:
    for seed in seeds:
        story = play(*nothing, f"sim.seed={seed}")
        assert_invariants(story)
        assert story.outcome is not Outcome.FOCUSED
