"""README is read by people who try what it says: its driver works, its paths exist, its words are the program's."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from elpd.cli import COMMANDS
from elpd.errors import CameraError
from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.stream import PacketDecoder
from elpd.records import Geometry, Outcome
from elpd.timebase import MonotonicClock

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "tools" / "docs").rglob("*.md"))]


def test_the_strangers_camera_works(tmp_path: Path) -> None:
    module = ModuleType("pipe_camera")
    exec(_block("python", "PipeCamera"), module.__dict__)  # noqa: S102  (README's own example)
    path = tmp_path / "events"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    camera = module.PipeCamera({"path": str(path), "width": 64, "height": 48}, MonotonicClock())
    camera.start()
    assert camera.read(0.0) is None
    sent = Evt3Encoder(64).encode(np.arange(100) * 10, np.arange(100) % 64, np.arange(100) % 48, np.arange(100) % 2)
    data = sent.tobytes()
    decoder, got = PacketDecoder(Geometry(64, 48)), []
    for piece in (data[:31], data[31:]):  # cut within a word
        os.write(writer, piece)
        got.append(decoder.feed(camera.read(1.0)).t.copy())
    assert np.concatenate(got).tolist() == list(range(0, 1000, 10))
    os.close(writer)
    with pytest.raises(CameraError):
        camera.read(1.0)
    camera.stop()


def test_the_entry_point_names_the_example() -> None:
    assert tomllib.loads(_block("toml", "entry-points"))["project"]["entry-points"]["elpd.cameras"] == {
        "pipe": "pipe_camera:PipeCamera"
    }


def test_the_documents_are_found() -> None:
    assert {page.name for page in PAGES} >= {"README.md", "detection.md", "json.md"}


def test_every_command_and_outcome_is_in_readme() -> None:
    for name in COMMANDS:
        assert f"`elpd {name}" in README, name
    for outcome in Outcome:
        assert outcome.value in README, outcome


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert all((page.parent / link).exists() for link in links), links
    rooms = re.findall(r"`((?:vision|focus|motion|events|record|cli)/\w+\.py)", text)
    assert all((ROOT / "elpd" / room).is_file() for room in rooms), rooms
    tools = re.findall(r"(tools/\w+\.py)", text)
    assert all((ROOT / tool).is_file() for tool in tools), tools


def _block(language: str, holding: str) -> str:
    blocks: list[str] = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    return next(block for block in blocks if holding in block)
