"""The examples of tools/docs/socket.md, run against a daemon whose engine answers at once."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from sockets import serving

from elpd.service.lines import DEEPEST, LONGEST_LINE
from elpd.service.messages import METHODS, PhaseEvent, ResultEvent

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fake_engine import FakeEngine

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "tools/docs/socket.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```(sh|python)\n(.*?)```\n```\n(.*?)```", TEXT, flags=re.DOTALL)


@pytest.fixture
def engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeEngine]:
    monkeypatch.setenv("ELPD_SOCKET", str(tmp_path / "elpd.sock"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *sys.path]))
    with serving(tmp_path / "elpd.sock") as engine:
        yield engine


def test_there_are_examples() -> None:
    assert len(EXAMPLES) == 6


@pytest.mark.skipif(not (shutil.which("socat") and shutil.which("jq")), reason="socat and jq are not installed")
@pytest.mark.parametrize(("kind", "script", "told"), EXAMPLES)
def test_an_example_prints_what_the_page_says(engine: FakeEngine, kind: str, script: str, told: str) -> None:
    ended = threading.Event()

    def live() -> None:
        """Finish what was asked for; tell those who watch, again and again, that something goes on."""
        while not ended.wait(0.05):
            if engine.accepted and engine.accepted[-1].answer is None:
                engine.finish()
            if "subscribe" in script:
                engine.tell(PhaseEvent(phase="sweep"))

    alive = threading.Thread(target=live)
    alive.start()
    command = [sys.executable, "-c", script] if kind == "python" else ["bash", "-c", script]
    answered = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    ended.set()
    alive.join()
    assert answered.stdout == told


def test_the_page_names_every_method_event_and_limit() -> None:
    for method in METHODS:
        assert f"`{method}`" in TEXT
    for event in ("sample", "phase", "result", "fault", "state", "position", "dropped"):
        assert f"| `{event}` |" in TEXT
    assert ResultEvent.model_fields.keys() >= {"outcome", "run"}
    assert f"| {LONGEST_LINE >> 10} KiB, nested {DEEPEST} deep" in TEXT
