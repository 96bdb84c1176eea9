"""How well passes there and back know focus on the benchmark's rig-like sets, as a live cycle makes them in dim light.

    python tools/two_crossings.py --set davis-dark [--seed 1] [--motions static,dynamic] [--rounds 0] [--cache DIR]

The benchmark's cases are one way: whoever is handed a record cannot go back. A live cycle can, and in dim light it does
(``focus/recross.py``). Here each case is made twice, the second time with the lens going the other way over the same
focus, behind the same lens and with a sensor that was drawn anew (``--rounds`` adds more such pairs); each pass ends as
a live one does, and what they testify is put together by the live cycle's own code. Play there is none. That a scene
moves is told beforehand, as the resting sensor tells a live cycle. One line a case: what the first pass says and what
all say together; an answer whose standard error is beyond half a depth of focus is refused. Lengths in um.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from benchmarks.cases import Case, SweepRecording, load_or_make
from benchmarks.methods import aperture_picture
from benchmarks.sets import SETS

from elpd.focus.aftermath import AFTERMATH_DOF, FLAT_DOF
from elpd.focus.course import FAR_DROP, TICK_DOF
from elpd.focus.passes import NO_PLAY, Pass, Passes
from elpd.focus.settings import MAX_SIGMA_DOF
from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.memory import EventMemory
from elpd.vision.reference import reference_from_frame, reference_from_temporal_image
from elpd.vision.slowness import DARK, DARK_OF_MAP
from elpd.vision.track import FrameEnergy
from elpd.vision.witness import LAG_UNEXPLAINED, WIDTHS_PER_DEPTH_OF_FOCUS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import FocusEstimate

BACK = "-back"
RIGS = ("davis-bright", "davis-dark", "evk4-bright", "evk4-dark")


def main() -> int:
    """Print a line for each case and a summary of each motion; exit 1 if an answer is false."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", default="davis-dark", choices=RIGS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--motions", default="static,dynamic", type=lambda text: text.split(","))
    parser.add_argument("--rounds", type=int, default=0, help="further passes, there and back, at the most (live: 4)")
    parser.add_argument("--cache", type=Path, help="where cases are kept, as of tools/benchmark.py")
    asked = parser.parse_args()
    chosen = SETS[asked.set]
    SETS[asked.set + BACK] = replace(chosen, start_um=-chosen.start_um, speed_um_s=-chosen.speed_um_s)
    limit_um, false = MAX_SIGMA_DOF * chosen.depth_of_focus_um, 0
    for motion in asked.motions:
        answers: list[list[FocusEstimate | None]] = []
        for scene in chosen.scenes:
            said = passes_over(asked, scene, motion, 2 + 2 * asked.rounds)
            answers.append([said[0], said[-1]])
            print(
                f"{scene:12s}{motion:9s}"
                + "".join(
                    f"{name} {told(one, limit_um)}   "
                    for name, one in zip(("one", f"{len(said)}"), answers[-1], strict=True)
                ),
                flush=True,
            )
        for name, column in zip(("one pass", "there and back"), zip(*answers, strict=True), strict=True):
            print(f"  {motion}, {name}: {summary(column, limit_um)}")
            false += sum(is_false(one, limit_um, chosen.depth_of_focus_um) for one in column)
    return int(false > 0)


def passes_over(asked: argparse.Namespace, scene: str, motion: str, most: int) -> list[FocusEstimate | None]:
    """Return what the passes have said together after each; no more are made once it is certain."""
    chosen, passes, found = SETS[asked.set], Passes(), []
    brightness: NDArray[np.float32] | None = None
    past_um = 0.0
    for number, back in zip(range(most), cycle((False, True)), strict=False):
        name = asked.set + (BACK if back else "")
        recording = load_or_make(Case(name, scene, 1, motion, asked.seed + 1000 * (number // 2)), asked.cache)
        if brightness is None:
            brightness = brightness_of(recording)
        one, went_um = pass_of(recording, past_um, moves=motion != "static")
        past_um = past_um or went_um
        if one is None:
            found.append(None)
            continue
        locate = recording.case.of_set.position_um
        dark = DARK_OF_MAP if chosen.expose is not None else DARK
        testimony = replace(one, deaf=passes.deaf).testify(locate, brightness, LAG_UNEXPLAINED, dark)
        passes.add(testimony, one.sign, (0.0, 0.0), FLAT_DOF * chosen.depth_of_focus_um)
        estimate = passes.estimate(NO_PLAY)
        believed = number == 0 or passes.scene_moves or passes.flat
        found.append(estimate if believed else found[0])
        last = found[-1]
        if number > 0 and last is not None and 3.0 * last.sigma_um <= chosen.depth_of_focus_um and number % 2:
            break
    return found


def brightness_of(recording: SweepRecording) -> NDArray[np.float32]:
    """Return the picture that is there before the first pass."""
    if recording.case.of_set.expose is not None:
        return reference_from_temporal_image(aperture_picture(recording), recording.roi).brightness
    return reference_from_frame(recording.frames[0], recording.roi).brightness


def pass_of(recording: SweepRecording, past_um: float, *, moves: bool) -> tuple[Pass | None, float]:
    """Return a pass up to where a live cycle would end it, and how far past its peak that is; none if unseen."""
    chosen = recording.case.of_set
    sign = 1 if chosen.speed_um_s > 0.0 else -1
    memory = EventMemory(recording.roi, recording.geometry)
    first = int(np.searchsorted(recording.t_us, chosen.sweep_begin_us))
    memory.add(*(column[first:] for column in (recording.t_us, recording.x, recording.y, recording.on)))
    tick_us = 1e6 * TICK_DOF * chosen.depth_of_focus_um / abs(chosen.speed_um_s)
    aftermath_us = AFTERMATH_DOF / TICK_DOF * tick_us
    track = memory.track
    for at in np.arange(chosen.sweep_begin_us + tick_us, chosen.end_us - aftermath_us, tick_us):
        memory.advance(round(at), sign * chosen.position_um(at))
        far = track.positions[-1] - track.positions[track.peak]
        if track.drop > FAR_DROP and memory.peak_passed and (moves or far >= past_um):
            end_us = round(at + aftermath_us)
            width_um = WIDTHS_PER_DEPTH_OF_FOCUS * chosen.depth_of_focus_um
            frames = frames_of(recording, end_us, moves=moves)
            speed = abs(chosen.speed_um_s)
            return Pass(memory, frames, chosen.sweep_begin_us, end_us, sign, speed, width_um, moves), far
    return None, 0.0


def frames_of(recording: SweepRecording, end_us: int, *, moves: bool) -> tuple[tuple[int, NDArray[np.float64]], ...]:
    """Return the sharpness of the frames that are there at the end of a pass, at the set's own rate."""
    chosen = recording.case.of_set
    if chosen.expose is not None:
        return ()
    energy = FrameEnergy(recording.roi, ROI_MARGIN_PX, follow=moves)
    there = [one for one in recording.frames_at(chosen.rates[0]) if one.t_us + chosen.frame_age_us <= end_us]
    return tuple((one.t_us, energy.measure(one.pixels)) for one in there)


def is_false(one: FocusEstimate | None, limit_um: float, depth_of_focus_um: float) -> bool:
    """Say whether an answer would have been FOCUSED and is not in focus."""
    return one is not None and one.sigma_um <= limit_um and abs(one.focus_um) > depth_of_focus_um


def told(one: FocusEstimate | None, limit_um: float) -> str:
    """Return an answer in words."""
    if one is None:
        return f"{'not seen to pass':24s}"
    refused = "refused" if one.sigma_um > limit_um else ""
    return f"{one.focus_um:+7.2f} +- {one.sigma_um:5.2f} {refused:7s}"


def summary(column: tuple[FocusEstimate | None, ...], limit_um: float) -> str:
    """Return how many were answered, and how well."""
    kept = [one for one in column if one is not None and one.sigma_um <= limit_um]
    if not kept:
        return f"0 of {len(column)} answered"
    errors = np.abs([one.focus_um for one in kept])
    ratio = float(np.sqrt(np.mean(np.square([one.focus_um / one.sigma_um for one in kept]))))
    return (
        f"{len(kept)} of {len(column)} answered, mean {errors.mean():.2f}, worst {errors.max():.2f}, "
        f"error / sigma {ratio:.2f} rms"
    )


if __name__ == "__main__":
    sys.exit(main())
