"""The tool that passes the benchmark's dark cases twice."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import two_crossings
from benchmarks.sets import SETS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

NAME = "davis-dark"


@pytest.fixture
def small() -> Iterator[None]:
    """Make the set small, and the way back another set beside it."""
    kept = dict(SETS)
    chosen = replace(SETS[NAME], size_px=96, margin_px=16, start_um=-120.0, scenes=("camera",), step_us=500)
    SETS[NAME] = chosen
    SETS[NAME + two_crossings.BACK] = replace(chosen, start_um=120.0, speed_um_s=-chosen.speed_um_s)
    yield
    SETS.clear()
    SETS.update(kept)


@pytest.mark.usefixtures("small")
def test_the_mean_of_two_passes_in_the_dark_knows_focus_better_than_one(tmp_path: Path) -> None:
    asked = argparse.Namespace(set=NAME, seed=5, cache=tmp_path)
    first, both = two_crossings.passes_over(asked, "camera", "static", 2)
    assert first is not None
    assert both is not None
    assert both.method == "two_crossings"
    assert both.sigma_um < 0.5 * first.sigma_um
    assert abs(both.focus_um) < 3.0
    assert two_crossings.is_false(replace(both, focus_um=7.0, sigma_um=1.0), 3.0, 6.0)
    assert "1 of 2 answered" in two_crossings.summary((replace(both, sigma_um=1.0), None), 3.0)
