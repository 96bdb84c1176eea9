"""The same seed twice: identical event bytes, decisions and journal, whatever the story."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from elpd.config import load
from elpd.focus.settings import FocusRequest
from elpd.record.session import focus_once

if TYPE_CHECKING:
    from pathlib import Path

STORIES = [
    ("sim.seed=3",),
    ("sim.seed=3", "sim.board=grbl", "sim.start_um=200.0"),
    ("sim.seed=4", "sim.motion=shake"),
    ("sim.seed=4", "sim.drop_from_s=0.15", "sim.hot_pixels=20"),
    ("sim.seed=2", "sim.cap=true"),
]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def run(directory: Path, story: tuple[str, ...]) -> dict[str, bytes]:
    small = ("sim.width=320", "sim.height=240", "sim.scene=camera", "focus.roi_fraction=0.5")
    config = load(overrides=[*small, *story, f"journal.directory={directory}"])
    session = focus_once(config, FocusRequest())
    assert session.run is not None
    return contents(session.run)


@pytest.mark.parametrize("story", STORIES, ids=" ".join)
def test_the_same_seed_writes_the_same_run(tmp_path: Path, story: tuple[str, ...]) -> None:
    first, second = run(tmp_path / "first", story), run(tmp_path / "second", story)
    assert {"run.json", "decisions.jsonl", "tape.jsonl", "events.raw"} <= first.keys()
    assert first == second
