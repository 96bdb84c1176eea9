"""`elpd report`: a page that holds the run's own numbers, needs nothing else, and survives a damaged run."""

from __future__ import annotations

import json
import re
import shutil
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from command_line import SMALL_RIG, caller
from hypothesis import given
from hypothesis import strategies as st

from elpd.config import load
from elpd.errors import FormatError
from elpd.focus.cycle import FocusCycle, result_fields
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.record.journal import RunWriter
from elpd.record.report import report_html
from elpd.record.svg_plot import short, ticks
from elpd.rig import build

if TYPE_CHECKING:
    from collections.abc import Callable

    from command_line import Answer


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record one cycle on the simulated rig."""
    folder = tmp_path_factory.mktemp("recorded")
    settings = (*SMALL_RIG[1::2], "sim.seed=7", f"journal.directory={folder}", "state.profiles=false")
    config = load(None, settings)
    parts = build(config)
    request = FocusRequest()
    with RunWriter.begin(config, request, parts) as run:
        result = FocusCycle(run.parts, CycleSettings.from_config(config), request, run).run()
        run.finish(result_fields(result))
    assert run.path is not None
    return run.path


@pytest.fixture
def run(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / recorded.name))


class Page(HTMLParser):
    """Tags in order, every attribute, all text; unbalanced tags are an error."""

    VOID = frozenset({"meta", "rect", "line", "polyline", "path", "image"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words = ""
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


def change(run: Path, **fields: Any) -> None:
    head = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(head | fields))


def test_the_page_holds_the_runs_numbers_and_needs_nothing_else(elpd: Callable[..., Answer], run: Path) -> None:
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    answer = elpd("report", str(run), "--json").json
    text = Path(answer["out"]).read_text(encoding="utf-8")
    assert len(text.encode()) == answer["bytes"]
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    page = Page(text)
    assert "script" not in page.tags
    for name, value in page.attributes:
        assert not (name in {"src", "href", "action", "data"} and not value.startswith("data:")), (name, value[:60])
        assert not name.startswith("on")
    assert not re.search(r"@import|url\(", text)
    result = json.loads((run / "run.json").read_text())["result"]
    for number in (f"{result['focus_um']:.2f}", f"{result['final_um']:.2f} µm", f"{result['events']:,}", "pairs"):
        assert number in page.words
    assert result["reason"].replace(" um", " µm") in page.words
    assert page.tags.count("svg") == 4
    assert page.tags.count("image") == 1
    windows = sum(json.loads(line)["event"] == "window" for line in (run / "decisions.jsonl").read_text().splitlines())
    assert windows > 20


def test_words_of_a_run_are_never_markup(run: Path) -> None:
    evil = '"><script>alert(1)</script>&amp;'
    head = json.loads((run / "run.json").read_text())
    change(run, result=head["result"] | {"reason": evil, "warnings": [evil]}, elpd=evil, request={"reference": evil})
    page = Page(report_html(run))
    assert "script" not in page.tags
    assert page.words.count(evil) == 4


def test_a_run_that_broke_says_how(run: Path) -> None:
    change(run, result=None, error={"kind": "LensError", "message": "lens: no reply for 52 ms (limit 50)"})
    page = Page(report_html(run))
    assert "Error" in page.words
    assert "no reply for 52 ms" in page.words
    assert page.tags.count("svg") == 4  # what it saw is there all the same


@pytest.mark.parametrize("missing", ["decisions.jsonl", "tape.jsonl", "events.raw"])
def test_what_is_left_of_a_damaged_run_is_shown(run: Path, missing: str) -> None:
    (run / missing).unlink()
    page = Page(report_html(run))
    assert "Focused" in page.words
    assert page.tags.count("image") == 0
    assert ("never swept" in page.words) == (missing == "decisions.jsonl")


def test_notes_that_were_cut_off_in_the_middle_count_as_far_as_they_go(run: Path) -> None:
    notes = run / "decisions.jsonl"
    notes.write_bytes(notes.read_bytes()[: len(notes.read_bytes()) // 2])
    assert Page(report_html(run)).tags.count("svg") == 4


def test_a_folder_that_is_no_run_is_named(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    answer = elpd("report", str(tmp_path), "--json")
    assert answer.code == 2
    assert answer.json["error"]["kind"] == "FormatError"
    with pytest.raises(FormatError):
        report_html(tmp_path / "nowhere")


def test_a_renamed_run_keeps_its_name(elpd: Callable[..., Answer], run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "kept for ever")
    assert elpd("report", "kept for ever").out == "kept for ever.html\n"


@given(st.floats(-1e9, 1e9), st.floats(1e-3, 1e9), st.integers(3, 12))
def test_ticks_are_few_round_and_inside(low: float, width: float, count: int) -> None:
    high = low + width
    if high - low < 1e-6 * max(abs(low), 1.0):
        return  # no numbers to tell apart
    found = ticks(low, high, count)
    assert 1 <= len(found) <= count + 1
    room = 1e-9 * max(abs(low), abs(high))
    assert all(low - room <= tick <= high + room for tick in found)
    steps = {float(f"{b - a:.3g}") for a, b in pairwise(found)}
    assert len(steps) <= 1 or max(steps) <= 1.01 * min(steps)


@pytest.mark.parametrize(
    ("value", "text"), [(0, "0"), (-250, "−250"), (12_500, "12.5k"), (600_000, "600k"), (2e6, "2M"), (0.05, "0.05")]
)
def test_ticks_read_well(value: float, text: str) -> None:
    assert short(value) == text


def test_a_run_is_found_by_the_name_that_it_is_listed_by(
    elpd: Callable[..., Answer], run: Path, tmp_path: Path
) -> None:
    journal = tmp_path / "journal"
    shutil.copytree(run, journal / "of-yesterday")
    answer = elpd("report", "of-yesterday", "--set", f"journal.directory={journal}", "--json")
    assert answer.json["run"] == str(journal / "of-yesterday")
    assert elpd("replay", "of-yesterday", "--set", f"journal.directory={journal}").code == 0
    assert "`elpd runs` lists them" in elpd("report", "nothing-of-this-name").err
