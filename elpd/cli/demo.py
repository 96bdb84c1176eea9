"""`elpd demo`: the embedded simulated rig focuses itself while you watch.

The very cycle that drives hardware runs here, on event bytes and a lens protocol that a simulator makes, held to the
wall clock's pace. Where the machine cannot keep that pace the demo says by how much it fell behind; no decision depends
on it. What is shown at the end, the scene before and after and the true errors, comes from the simulator alone: the
cycle never sees it.
"""

from __future__ import annotations

import shutil
import sys
import textwrap
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, TextIO

import click
import cv2
import numpy as np

from elpd.cli.common import config_options, interruptible, json_option, print_json
from elpd.cli.drawing import picture, save_png, side_by_side
from elpd.cli.view import LiveView, Seen, frame, ink_of, open_view
from elpd.config import Config, load
from elpd.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.cli.view import View
    from elpd.record.session import Session
    from elpd.records import ElpSample

DEMO_RIG = ("sim.seed=7", "sim.scene=camera", "sim.start_um=-200", "sim.pace=1")
"""What is shown without ``--config``: a person recognises the scene, and focus lies behind at first."""

MAGNIFIED_PX = 96
"""Side of the part of the scene that is drawn before and after: a terminal has no room for a whole sensor."""

PICTURE = "before-after.png"

COLUMNS = 80
"""Where there is no terminal to ask."""

KEPT_PACE_S = 0.05
"""A clock less than this behind has kept its pace."""


@click.command("demo")
@config_options
@json_option
def command(*, config_path: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Focus the embedded simulated rig in real time: exit 0 in focus, 1 not.

    Slow motion is --set sim.pace=0.1, as fast as the CPU can --set sim.pace=0, another world --set sim.seed=8.
    """
    config = load(config_path, overrides if config_path else (*DEMO_RIG, *overrides))
    if config.rig != "sim":
        raise UsageError('the demo is of the simulated rig; for rig = "hardware" run `elpd focus --config FILE`')
    if not as_json:
        _hello(config)
    shown = run(config, None if as_json else sys.stdout)
    if as_json:
        print_json(shown.fields())
    return 0 if shown.session.focused else 1


@dataclass(frozen=True, slots=True)
class Demonstration:
    """A cycle with what the simulator showed around it."""

    session: Session
    before: NDArray[np.float32]
    after: NDArray[np.float32]
    start_error_um: float
    behind_ms: float
    wall_ms: float

    def cut(self) -> tuple[slice, slice]:
        """Return the part of the region that is worth drawing."""
        height, width = self.after.shape
        region = self.session.result.details.get("roi", (0, 0, width, height))
        return magnified(self.after, tuple(region), MAGNIFIED_PX)

    def limits(self) -> tuple[float, float]:
        """Return the black and the white of both pictures."""
        low, high = np.percentile(self.after[self.cut()], (1, 99))
        return float(low), float(high)

    def fields(self) -> dict[str, Any]:
        """Return the JSON of `elpd demo`: that of `elpd focus`, and how well the wall clock was kept up with."""
        return self.session.fields() | {
            "start_error_um": self.start_error_um,
            "behind_ms": self.behind_ms,
            "wall_ms": self.wall_ms,
        }


def run(config: Config, stream: TextIO | None) -> Demonstration:
    """Run one cycle on the simulated rig, shown on *stream* while it happens and once it is over.

    Raises ``UsageError`` if a part of the rig is not simulated, and what ``elpd.record.session.focus_on`` raises.
    """
    from elpd import rig  # noqa: PLC0415  (numba and the simulator only now)
    from elpd.focus.settings import FocusRequest  # noqa: PLC0415
    from elpd.ports import Paced, Scenery  # noqa: PLC0415
    from elpd.record.session import focus_on  # noqa: PLC0415
    from elpd.records import Roi  # noqa: PLC0415

    roi = None if config.focus.roi is None else Roi(*config.focus.roi)
    parts = rig.build(config)
    try:
        truth, clock = parts.truth, parts.clock
        if not isinstance(truth, Scenery):
            raise UsageError("the demo shows what only a simulator knows; leave camera.driver and lens.driver at 'sim'")
        before, start_error_um = truth.picture(), truth.carriage_error_um()
        lag_s = clock.lag_s if isinstance(clock, Paced) else 0.0
        begun_s = time.monotonic()
        with interruptible() as cancelled:
            if stream is None:
                session = focus_on(parts, config, FocusRequest(roi=roi), None, cancelled)
            else:
                with Audience(stream) as audience:
                    session = focus_on(parts, config, FocusRequest(roi=roi), audience, cancelled)
                    audience.result(session)
        wall_ms = 1000.0 * (time.monotonic() - begun_s)
        lag_s = clock.lag_s - lag_s if isinstance(clock, Paced) else 0.0
        shown = Demonstration(session, before, truth.picture(), start_error_um, max(0.0, 1000.0 * lag_s), wall_ms)
    finally:
        rig.release(parts)
    if session.run is not None:
        save_png(session.run / PICTURE, np.hstack([shown.before, shown.after]), shown.limits())
    if stream is not None:
        _tell(shown, config, stream)
    return shown


class Audience:
    """Watches a cycle: a live drawing in a terminal, else plain lines and the finished drawing."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._view: View = open_view(stream)
        self._drawn = isinstance(self._view, LiveView)
        self._seen = Seen()

    def __enter__(self) -> Self:
        self._view.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._view.__exit__(*raised)
        if not self._drawn and self._seen.elps:
            print("", *frame(self._seen, COLUMNS, colour=False)[1:-1], "", sep="\n", file=self._stream)

    def phase(self, name: str, /, **fields: Any) -> None:
        """Hear that a phase begins."""
        self._view.phase(name, **fields)

    def sample(self, sample: ElpSample, score: float, /) -> None:
        """Hear of one window."""
        self._view.sample(sample, score)
        self._seen.take(sample, score)

    def result(self, session: Session) -> None:
        """Hear how it ended."""
        self._seen.result = session.result
        self._view.result(session.result)


def magnified(image: NDArray[np.float32], window: tuple[int, int, int, int], side_px: int) -> tuple[slice, slice]:
    """Return the square of *side_px* inside *window* (x, y, width, height) whose fine structure is strongest."""
    x, y, width, height = window
    part = image[y : y + height, x : x + width]
    across, down = min(side_px, part.shape[1]), min(side_px, part.shape[0])
    fine = cv2.Laplacian(part, cv2.CV_32F) ** 2
    total = cv2.boxFilter(fine, cv2.CV_32F, (across, down), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    inside = total[: part.shape[0] - down + 1, : part.shape[1] - across + 1]
    top, left = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return slice(y + int(top), y + int(top) + down), slice(x + int(left), x + int(left) + across)


def _hello(config: Config) -> None:
    sim = config.sim
    print(
        _wrapped(
            f"A simulated {sim.camera} looks at {sim.scene!r} through a lens on a {sim.board} board, "
            f"{abs(sim.start_um):g} um out of focus. The controller sees event bytes and serial replies, nothing else."
        ),
        flush=True,
    )


def _tell(shown: Demonstration, config: Config, stream: TextIO) -> None:
    """Draw the scene before and after, then say the numbers."""
    before, after = shown.before[shown.cut()], shown.after[shown.cut()]
    columns = (min(100, (shutil.get_terminal_size().columns if stream.isatty() else COLUMNS) - 1) - 2) // 2
    ink = ink_of(stream)
    left, right = (picture(part, columns, ink=ink, limits=shown.limits()) for part in (before, after))
    titles = (f"before, {shown.start_error_um:+.1f} um from focus"[:columns], "after")
    print(side_by_side(left, right, titles, columns), file=stream)
    lines = ["", *(_wrapped(line) for line in _numbers(shown, config))]
    if shown.session.run is not None:
        lines.append(f"Recorded in {shown.session.run}, with {PICTURE}.")
        lines.append(f"`elpd replay {shown.session.run}` decides the same again.")
    print(*lines, sep="\n", file=stream, flush=True)


def _numbers(shown: Demonstration, config: Config) -> list[str]:
    session = shown.session
    result, truth = session.result, session.truth or {}
    lines = []
    if session.focused:
        rest, off, stop = (_um(truth.get(f"{name}_error_um")) for name in ("final", "estimate", "stop"))
        depth_um = config.sim.depth_of_focus_um
        lines.append(f"In focus. The lens rests {rest} from true focus; the depth of focus is {depth_um:g} um.")
        lines.append(f"The estimate was {off} off; the motor had stopped at {stop} and went back.")
    else:
        lines.append(f"Not in focus: {result.outcome.value}, {result.reason}.")
    took = f"It took {result.duration_ms:.0f} ms of the rig's time, {shown.wall_ms:.0f} ms here"
    if config.sim.pace == 0:
        lines.append(f"{took}: virtual time, as fast as this machine can.")
    else:
        pace = "real time" if config.sim.pace == 1 else f"{config.sim.pace:g} times real time"
        if shown.behind_ms > 1000.0 * KEPT_PACE_S:
            behind = f"simulating a sensor of this size fell {shown.behind_ms:.0f} ms behind {pace}"
            lines.append(f"{took}: {behind}. No decision depends on it.")
        else:
            lines.append(f"{took}, in {pace}.")
    return lines


def _um(value: float | None) -> str:
    return "an unknown way" if value is None else f"{value:+.2f} um"


def _wrapped(text: str) -> str:
    return textwrap.fill(text, COLUMNS - 1, break_long_words=False, break_on_hyphens=False)
