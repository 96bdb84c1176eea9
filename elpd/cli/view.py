"""Watching a cycle: live in a terminal, in plain lines anywhere else.

A cycle must never wait for whoever watches it, and a terminal can stop taking characters at any moment (a slow line, a
pressed Ctrl-S). So the cycle only appends a number to a list; a thread of its own draws what is there, at most fifteen
times a second, and the terminal can make only that thread wait. Drawing is a pure function of what was seen.

The frame is redrawn in place with four escape codes: 0.4 ms of interpreter time for 300 windows. rich's live display
would add 1.3 ms to each frame, taken from the loop that stops the lens, for nothing that is needed here.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, Self, TextIO

import numpy as np

from elpd.cli.drawing import BOLD, DIM, GREEN, LABEL, RED, RESET, Ink, curve, lens_bar
from elpd.records import Outcome, Phase

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import ElpSample, FocusResult

REDRAW_S = 1 / 15
PLOT_ROWS = 12
SMOOTHED_WINDOWS = 5
MIN_COLUMNS, MAX_COLUMNS = 40, 110

_ORDER = tuple(phase.value for phase in Phase if phase not in {Phase.IDLE, Phase.DONE})


class View(Protocol):
    """Somebody who watches a cycle and must be closed."""

    def phase(self, name: str, /, **fields: Any) -> None:
        """Hear that a phase begins."""
        ...

    def sample(self, sample: ElpSample, score: float, /) -> None:
        """Hear of one window."""
        ...

    def result(self, result: FocusResult, /) -> None:
        """Hear how it ended."""
        ...

    def __enter__(self) -> Self:
        """Begin to show."""
        ...

    def __exit__(self, *_: object) -> None:
        """Show the last state and leave the terminal as it was."""
        ...


def open_view(stream: TextIO | None = None) -> LiveView | PlainView:
    """Return a live view where *stream* (stderr unless given) is a terminal that moves its cursor, else a plain one."""
    stream = sys.stderr if stream is None else stream
    if stream.isatty() and os.environ.get("TERM", "dumb") != "dumb":
        return LiveView(stream)
    return PlainView(stream)


def plain_view(stream: TextIO | None = None) -> PlainView:
    """Return a view that prints a line per phase."""
    return PlainView(sys.stderr if stream is None else stream)


def ink_of(stream: TextIO) -> Ink:
    """Say what pictures *stream* can show."""
    if not stream.isatty() or os.environ.get("TERM", "dumb") == "dumb" or os.environ.get("NO_COLOR"):
        return Ink.PLAIN
    return Ink.TRUE if os.environ.get("COLORTERM") in {"truecolor", "24bit"} else Ink.GREY


class PlainView:
    """A line per phase and one for the result; no escape codes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._windows = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def phase(self, name: str, /, **fields: Any) -> None:
        """Print the phase's name and what came with it."""
        windows = f"  ({self._windows} windows)" if self._windows and name != Phase.PROBE.value else ""
        self._say(f"{name:14s}{_described(fields)}{windows}".rstrip())

    def sample(self, sample: ElpSample, score: float, /) -> None:
        """Count."""
        del sample, score
        self._windows += 1

    def result(self, result: FocusResult, /) -> None:
        """Print the outcome in one line."""
        self._say(result_line(result))

    def _say(self, line: str) -> None:
        with suppress(OSError, ValueError):  # nobody listens any more: no reason to disturb a cycle
            print(line, file=self._stream, flush=True)


@dataclass(slots=True)
class Seen:
    """What a live view has been told; lists only grow, so a reader in another thread sees a beginning of each."""

    phases: list[str] = field(default_factory=list)
    fields: dict[str, Any] = field(default_factory=dict)
    positions_um: list[float] = field(default_factory=list)
    times_us: list[int] = field(default_factory=list)
    elps: list[float] = field(default_factory=list)
    evidence: float = 0.0
    result: FocusResult | None = None

    def take(self, sample: ElpSample, score: float) -> None:
        """Append one window."""
        self.times_us.append(sample.begin_us)
        self.positions_um.append(sample.position_um)
        self.evidence = score
        self.elps.append(float(sample.elp))  # last: whoever reads takes as many as there are


class LiveView:
    """The curve, the lens and the phases, redrawn in place by a thread."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._seen = Seen()
        self._news = threading.Event()
        self._closing = threading.Event()
        self._painter = threading.Thread(target=self._paint, name="elpd-view", daemon=True)
        self._height = 0

    def __enter__(self) -> Self:
        self._painter.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._news.set()
        self._painter.join(timeout=1.0)  # a terminal that is held by Ctrl-S keeps its painter, not us

    def phase(self, name: str, /, **fields: Any) -> None:
        """Take note."""
        self._seen.phases.append(name)
        self._seen.fields = fields
        self._news.set()

    def sample(self, sample: ElpSample, score: float, /) -> None:
        """Take note; costs three appends."""
        self._seen.take(sample, score)
        self._news.set()

    def result(self, result: FocusResult, /) -> None:
        """Take note."""
        self._seen.result = result
        self._news.set()

    def _paint(self) -> None:
        """Draw whenever there is news, then pause; end after a last drawing once closing."""
        self._write("\x1b[?25l")  # hide the cursor
        while not self._closing.is_set():
            self._news.wait()
            self._news.clear()
            self._draw()
            self._closing.wait(REDRAW_S)
        self._draw()
        self._write("\x1b[?25h")

    def _draw(self) -> None:
        columns = min(MAX_COLUMNS, max(MIN_COLUMNS, shutil.get_terminal_size().columns - 1))
        lines = frame(self._seen, columns, colour=not os.environ.get("NO_COLOR"))
        up = f"\x1b[{self._height}F" if self._height else ""
        self._write(up + "".join(f"{line}\x1b[K\n" for line in lines) + "\x1b[J")
        self._height = len(lines)

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):  # the terminal went away or was closed: nobody watches any more
            self._closing.set()


def frame(seen: Seen, columns: int, *, colour: bool) -> list[str]:
    """Return the lines of one drawing, *columns* wide and always the same number of them."""
    count = len(seen.elps)
    positions = np.array(seen.positions_um[:count], dtype=np.float64)
    elps = np.array(seen.elps[:count], dtype=np.float64)
    result = seen.result
    marks: dict[str, float | None] = {"S": None, "●": None, "x": None, "F": None}
    if not np.isfinite(positions).any():  # no lens path is known: the curve runs over time, in ms
        positions = np.array(seen.times_us[:count], dtype=np.float64) / 1000.0
        positions -= positions[0] if count else 0.0
    elif count:
        finite = positions[np.isfinite(positions)]
        marks |= {"S": float(finite[0]), "●": float(finite[-1])}
        marks["x"] = _sign_change(positions, elps)
    if result is not None:
        marks |= {"●": result.final_um, "F": result.focus_um}
    known = [mark for mark in marks.values() if mark is not None]
    finite = np.concatenate([positions[np.isfinite(positions)], known])
    span = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    evidence = f" (evidence {seen.evidence:+.0f} sigma)" if count and result is None else ""
    legend = f"ELP, relative{evidence}    S start  ● lens  x sign change  F focus"
    return [
        _phase_line(seen, columns, colour=colour),
        f"{'':{LABEL}s}{legend}"[:columns],
        *curve(positions, _relative(elps), (columns, PLOT_ROWS), span, colour=colour),
        *lens_bar(marks, columns, span),
        _ending(result, columns, colour=colour),
    ]


def result_line(result: FocusResult) -> str:
    """Say how a cycle ended, in one line."""
    if result.outcome is not Outcome.FOCUSED or result.final_um is None:
        return f"{result.outcome.value}: {result.reason}"
    latency = (
        "" if result.stop_latency_us is None else f", stopped {result.stop_latency_us / 1000:.1f} ms after deciding"
    )
    return (
        f"{result.outcome.value} at {result.final_um:.2f} um "
        f"(sigma {result.sigma_um or 0.0:.2f} um) in {result.duration_ms:.0f} ms{latency}"
    )


def _phase_line(seen: Seen, columns: int, *, colour: bool) -> str:
    """List the phases: past ones ticked, the present one with what it said, those to come."""
    begun = [name for name in dict.fromkeys(seen.phases) if name in _ORDER]
    current = None if seen.result is not None or not begun else seen.phases[-1]
    furthest = max((_ORDER.index(name) for name in begun), default=-1)
    coming = () if seen.result is not None else _ORDER[furthest + 1 :]
    words, used = [], 0
    for name in (*begun, *coming):
        mark, ink = ("▸", BOLD) if name == current else ("✓", GREEN) if name in begun else ("·", DIM)
        word = f"{mark} {name.replace('_', ' ')}"
        if used + len(word) + 2 > columns:
            break
        used += len(word) + 2
        words.append(f"{ink}{word}{RESET}" if colour else word)
    rest = _described(seen.fields) if current is not None else ""
    return "  ".join(words) + f"  {rest}"[: max(0, columns - used)].rstrip()


def _ending(result: FocusResult | None, columns: int, *, colour: bool) -> str:
    if result is None:
        return ""
    text = result_line(result)[:columns]
    if not colour:
        return text
    return f"{GREEN if result.outcome is Outcome.FOCUSED else RED}{text}{RESET}"


def _relative(elps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth over a few windows, for the eye, and divide by the largest: the scene sets the size of ELP."""
    if elps.size == 0:
        return elps
    span = np.ones(min(SMOOTHED_WINDOWS, elps.size))
    smooth = np.convolve(elps, span, mode="same") / np.convolve(np.ones(elps.size), span, mode="same")
    largest = float(np.abs(smooth).max())
    return smooth / largest if largest > 0.0 else smooth


def _sign_change(positions: NDArray[np.float64], elps: NDArray[np.float64]) -> float | None:
    """Return where the running sum of ELP was highest, once it falls: for the eye, not a verdict."""
    if elps.size < 2:
        return None
    highest = int(np.argmax(np.cumsum(elps)))
    return float(positions[highest]) if 0 < highest < elps.size - 1 else None


def _described(fields: dict[str, Any]) -> str:
    return "  ".join(f"{name}={_short(value)}" for name, value in fields.items())


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
