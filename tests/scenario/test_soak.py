"""A quarter of an hour of the day that tools/soak.py lives through, misfortunes come thick and fast."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from soaks.day import Day

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("seed", [1, 2])
def test_a_short_soak_leaves_nothing_unanswered(tmp_path: Path, seed: int) -> None:
    day = Day(seed, tmp_path, people_every_s=60.0, misfortune_every_s=60.0)
    day.run(0.25)
    day.finish()
    figures = day.figures()
    counts = figures["counts"]
    assert figures["cycles"] >= 3
    # a killed daemon answers nobody
    assert counts["requests"] >= counts["answers"] + sum(
        times for name, times in counts.items() if name.startswith("refused")
    )
    assert counts.get("26 killed") or counts["requests"] == counts["answers"] + sum(
        times for name, times in counts.items() if name.startswith("refused")
    )
    assert figures["error_um"]["max"] < 12.0
