from __future__ import annotations

import io
from typing import TYPE_CHECKING

import cv2
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from elpd.cli.drawing import LABEL, Ink, curve, lens_bar, picture, save_png, side_by_side, to_grey
from elpd.cli.view import PLOT_ROWS, LiveView, PlainView, Seen, frame, ink_of, open_view, plain_view, result_line
from elpd.records import ElpSample, FocusResult, Outcome

if TYPE_CHECKING:
    from pathlib import Path

ESCAPE = "\x1b"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def sample(position_um: float, begin_us: int = 0, elp: int = 1) -> ElpSample:
    return ElpSample(begin_us, begin_us + 1000, elp=elp, energy=1, n_on=1, n_off=1, position_um=position_um)


def focused(**changes: object) -> FocusResult:
    values = {
        "outcome": Outcome.FOCUSED,
        "reason": "in focus",
        "reversals": 0,
        "focus_um": 60.0,
        "sigma_um": 0.4,
        "stop_um": 70.0,
        "final_um": 60.5,
        "stop_latency_us": 2300,
        "duration_ms": 412.0,
        "phases": (),
        "events": 10,
        "lost": 0,
    }
    return FocusResult(**(values | changes))  # type: ignore[arg-type]


def watch_a_sweep(view: LiveView | PlainView) -> None:
    with view:
        view.phase("expose")
        view.phase("sweep", sign=1, position_um=12.3456)
        for step in range(100):
            view.sample(sample(float(step), 1000 * step, 60 - step), 6.0)
        view.phase("done")
        view.result(focused())


# --- without a terminal ------------------------------------------------------------------------------------------


def test_without_a_terminal_there_are_plain_lines_and_no_escape_codes() -> None:
    stream = io.StringIO()
    watch_a_sweep(open_view(stream))
    assert stream.getvalue().splitlines() == [
        "expose",
        "sweep         sign=1  position_um=12.35",
        "done            (100 windows)",
        "FOCUSED at 60.50 um (sigma 0.40 um) in 412 ms, stopped 2.3 ms after deciding",
    ]


def test_a_dumb_terminal_counts_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    assert isinstance(open_view(Terminal()), PlainView)
    assert ink_of(Terminal()) is Ink.PLAIN
    monkeypatch.delenv("TERM")
    assert isinstance(open_view(Terminal()), PlainView)


def test_plain_view_is_plain_on_a_terminal_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    watch_a_sweep(plain_view(stream))
    assert ESCAPE not in stream.getvalue()


def test_an_unfound_focus_gives_its_reason() -> None:
    lost = focused(outcome=Outcome.NO_CROSSING, reason="aim elsewhere", final_um=None, focus_um=None)
    assert result_line(lost) == "NO_CROSSING: aim elsewhere"


# --- in a terminal -----------------------------------------------------------------------------------------------


def test_in_a_terminal_the_last_drawing_shows_everything_and_the_cursor_returns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "81")
    stream = Terminal()
    view = open_view(stream)
    assert isinstance(view, LiveView)
    watch_a_sweep(view)
    text = stream.getvalue()
    assert text.startswith("\x1b[?25l")
    assert text.endswith("\x1b[?25h")
    last = text.rpartition("F✓")[2] or text
    assert "FOCUSED at 60.50 um" in last
    assert "sweep" in last


def test_a_terminal_that_goes_away_does_not_disturb_the_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")

    class Gone(Terminal):
        asked = 0

        def write(self, text: str) -> int:
            self.asked += 1
            raise OSError(5, "Input/output error")

    gone = Gone()
    watch_a_sweep(open_view(gone))
    assert gone.asked >= 1


def test_a_terminal_that_takes_nothing_does_not_hold_the_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    import threading  # noqa: PLC0415

    monkeypatch.setenv("TERM", "xterm")
    resume = threading.Event()

    class Held(Terminal):
        def write(self, text: str) -> int:
            resume.wait(60)
            return len(text)

    view = LiveView(Held())
    view.__enter__()
    for step in range(1000):
        view.sample(sample(float(step)), 1.0)
    assert len(view._seen.elps) == 1000
    resume.set()
    view.__exit__()


@pytest.mark.parametrize("columns", [40, 79, 110])
@pytest.mark.parametrize("count", [0, 1, 2, 300])
def test_a_drawing_has_always_the_same_height_and_fits(columns: int, count: int) -> None:
    seen = Seen(phases=["expose", "sweep"])
    for step in range(count):
        seen.times_us.append(1000 * step)
        seen.positions_um.append(5.0 + step)
        seen.elps.append(150.0 - step)
    for result in (None, focused(), focused(final_um=None, focus_um=None, outcome=Outcome.NO_CROSSING)):
        seen.result = result
        lines = frame(seen, columns, colour=False)
        assert len(lines) == PLOT_ROWS + 5 <= 60
        assert max(map(len, lines)) <= columns
        assert ESCAPE not in "".join(lines)


def test_the_drawing_marks_start_crossing_and_focus() -> None:
    seen = Seen()
    for step in range(100):
        seen.times_us.append(1000 * step)
        seen.positions_um.append(float(step))
        seen.elps.append(50.5 - step)
    bar = frame(seen, LABEL + 100, colour=False)[-3]
    assert (bar.index("S"), bar.index("x"), bar.index("●")) == (LABEL, LABEL + 50, LABEL + 99)
    seen.result = focused(focus_um=20.0, final_um=20.0)
    assert frame(seen, LABEL + 100, colour=False)[-3].index("F") in {LABEL + 20, LABEL + 21}


def test_without_a_lens_path_the_curve_runs_over_time() -> None:
    seen = Seen(times_us=[0, 1000, 2000], positions_um=[float("nan")] * 3, elps=[1.0, 0.0, -1.0])
    lines = frame(seen, 60, colour=False)
    assert any(chr(0x2800) < letter <= chr(0x28FF) for letter in "".join(lines))


# --- curves ------------------------------------------------------------------------------------------------------


def test_a_rising_line_is_a_diagonal_of_dots() -> None:
    x = np.linspace(0.0, 1.0, 8)
    lines = curve(x, x, (LABEL + 4, 2), (0.0, 1.0))
    assert [line[LABEL:] for line in lines] == ["  ⡠⠊", "⡠⠊──"]


@settings(max_examples=60, deadline=None)
@given(
    y=arrays(np.float64, st.integers(0, 40), elements=st.floats(-1e9, 1e9) | st.just(float("nan"))),
    columns=st.integers(LABEL + 2, 80),
    rows=st.integers(2, 20),
)
def test_a_curve_keeps_its_size_whatever_it_is_given(y: np.ndarray, columns: int, rows: int) -> None:
    x = np.arange(y.size, dtype=np.float64)
    lines = curve(x, y, (columns, rows), (0.0, max(1.0, y.size - 1.0)))
    assert [len(line) for line in lines] == [columns] * rows
    dotted = any(chr(0x2800) < letter <= chr(0x28FF) for letter in "".join(lines))
    assert dotted == bool(np.isfinite(y).any())


def test_a_bar_puts_marks_where_they_are() -> None:
    line, scale = lens_bar({"S": 0.0, "F": 5.0, "x": None, "E": float("nan")}, LABEL + 10, (0.0, 10.0))
    assert line == "    lens ├S────F────"
    assert scale == " " * LABEL + "0    10 um"


# --- pictures ----------------------------------------------------------------------------------------------------

GRADIENT = np.tile(np.linspace(0.0, 1.0, 64), (32, 1))


def test_a_picture_without_a_terminal_is_a_ramp_of_characters() -> None:
    text = picture(GRADIENT, 20)
    lines = text.split("\n")
    assert len(lines) == 5
    assert set(map(len, lines)) == {20}
    assert lines[0][0] == " "
    assert lines[0][-1] == "@"
    assert ESCAPE not in text
    assert lines[0] == "".join(sorted(lines[0], key=" .:-=+*#%@".index))


@pytest.mark.parametrize(("ink", "code"), [(Ink.TRUE, "\x1b[38;2;"), (Ink.GREY, "\x1b[38;5;")])
def test_a_picture_in_a_terminal_is_made_of_half_blocks(ink: Ink, code: str) -> None:
    lines = picture(GRADIENT, 20, ink=ink).split("\n")
    assert len(lines) == 5
    for line in lines:
        assert line.startswith(code)
        assert line.endswith("\x1b[0m")
        assert line.count("▀") == 20


def test_two_pictures_share_their_limits() -> None:
    dark = to_grey(GRADIENT / 4, limits=(0.0, 1.0))
    assert dark.max() == 64
    assert to_grey(np.full((4, 4), np.nan)).max() == 0
    assert to_grey(np.zeros((4, 4))).max() == 0


def test_pictures_stand_beside_each_other() -> None:
    assert side_by_side("ab\ncd", "ef\ngh", ("1", "2"), 2) == "1   2\nab  ef\ncd  gh"


def test_a_saved_picture_can_be_read(tmp_path: Path) -> None:
    save_png(tmp_path / "scene.png", GRADIENT, limits=(0.0, 1.0))
    again = cv2.imread(str(tmp_path / "scene.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(again, np.round(GRADIENT * 255).astype(np.uint8))


def test_what_a_stream_can_show(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.delenv("COLORTERM", raising=False)
    assert ink_of(io.StringIO()) is Ink.PLAIN
    assert ink_of(Terminal()) is Ink.GREY
    monkeypatch.setenv("COLORTERM", "truecolor")
    assert ink_of(Terminal()) is Ink.TRUE
    monkeypatch.setenv("NO_COLOR", "1")
    assert ink_of(Terminal()) is Ink.PLAIN
