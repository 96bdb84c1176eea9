"""A quarter of an hour of the day that tools/soak.py lives through, misfortunes come thick and fast."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import soak

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("seed", [1, 2])
def test_a_short_soak_leaves_nothing_unanswered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(soak, "MISFORTUNE_EVERY_S", 60.0)
    monkeypatch.setattr(soak, "PEOPLE_EVERY_S", 60.0)
    day = soak.Soak(seed, tmp_path)
    day.run(0.25)
    day.finish()
    figures = day.figures()
    assert figures["cycles"] >= 3
    assert day.counts["requests"] == day.counts["answers"] + sum(
        times for name, times in day.counts.items() if name.startswith("refused")
    )
    assert figures["error_um"]["max"] < 12.0
