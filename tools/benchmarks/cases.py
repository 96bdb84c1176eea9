"""The cases of a benchmark set, how each is made, and where it is kept.

``syn`` is the paper's synthetic set built again: 7 scenes x 4 fields of view x 3 motions = 84 sweeps of one second
from -400 to +400 um, 200 x 200 pixels, frames at 1, 20 and 50 fps, in the reading that reproduces the paper's table
(threshold 0.05, motion in pixels of the 600 x 600 picture). ``syn-std`` is the same with v2e's default threshold of
0.2 and motion in the sensor's pixels, which is harder. Frames are instantaneous and noise-free, as in the paper.

A case follows from its name and the seed alone, whichever process makes it and in whatever order.
"""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.optics import FocusRenderer, load_psf
from benchmarks.retina import RETINAS, Retina
from benchmarks.scenes import SCENES, load_picture
from benchmarks.shake import MOTIONS, shifts_px
from elpd.baselines import FocusStack, LensPath, StackFrame
from elpd.records import Geometry, Roi

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

GENERATION = 2
"""Raised whenever the same name and seed would give other events, so that stale files are not used."""

START_UM = -400.0
SPEED_UM_S = 800.0
FRAMES = 1001
FRAME_US = 1_000
KEEP_EVERY_US = 10_000
"""Frames kept with a case: enough for 50, 20 and 1 fps, and for the frame at 350 ms that the paper's code looks ahead
to."""
SIZE_PX = 200
MARGIN_PX = 8
ROI = Roi(10, 10, 180, 180)
DEPTH_OF_FOCUS_UM = 16.0

FRAME_PERIODS_US = {"50": 20_000, "20": 50_000, "1": 1_000_000}
"""Frame rates by name; at 1 fps there is the first frame and no other."""


@dataclass(frozen=True, slots=True)
class CaseSet:
    """What is common to a set: the retina and how large a pixel of motion is in pixels of the sensor."""

    name: str
    retina: str
    motion_px: float
    motions: tuple[str, ...] = ("static", "moderate", "violent")
    fields: tuple[int, ...] = (1, 2, 3, 4)


SETS = {
    "syn": CaseSet("syn", "c05", 1.0 / 3.0),
    "syn-std": CaseSet("syn-std", "std", 1.0),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One sweep to be made."""

    set_name: str
    scene: str
    fov: int
    motion: str
    seed: int

    @property
    def name(self) -> str:
        """The name in tables, files and ``--cases`` patterns."""
        return f"{self.set_name}-{self.scene}-fov{self.fov}-{self.motion}"


@dataclass(frozen=True, slots=True)
class SweepRecording:
    """A sweep and its truth. Frames (n, 200, 200) ``uint8`` were taken at ``frame_t_us`` (n,)."""

    case: Case
    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    frame_t_us: NDArray[np.int64]
    frames: NDArray[np.uint8]

    @property
    def truth_us(self) -> float:
        """When the PSF had its least RMS radius."""
        return -START_UM / SPEED_UM_S * 1e6

    def frames_at(self, rate: str) -> tuple[StackFrame, ...]:
        """Return the frames of a camera that delivers *rate* of them per second."""
        chosen = np.flatnonzero(self.frame_t_us % FRAME_PERIODS_US[rate] == 0)
        if rate == "1":
            chosen = chosen[:1]
        return tuple(StackFrame(int(self.frame_t_us[k]), self.frames[k]) for k in chosen)

    def frame_nearest(self, t_us: float) -> StackFrame:
        """Return the kept frame nearest to *t_us*."""
        k = int(np.argmin(np.abs(self.frame_t_us - t_us)))
        return StackFrame(int(self.frame_t_us[k]), self.frames[k])

    def stack(self, frames: Sequence[StackFrame]) -> FocusStack:
        """Return the sweep as the peers see it, with *frames*."""
        end_us = (FRAMES - 1) * FRAME_US
        ends_us = np.array([0.0, float(end_us)])
        path = LensPath(ends_us, START_UM + SPEED_UM_S * ends_us / 1e6)
        geometry = Geometry(SIZE_PX, SIZE_PX)
        return FocusStack(self.t_us, self.x, self.y, self.on, geometry, ROI, 0, end_us, tuple(frames), path)


def cases_of(set_name: str, seed: int, pattern: str = "*") -> list[Case]:
    """Return the set's cases whose name matches *pattern*."""
    chosen = SETS[set_name]
    every = (
        Case(set_name, scene, field, motion, seed)
        for scene in SCENES
        for field in chosen.fields
        for motion in chosen.motions
    )
    return [case for case in every if fnmatchcase(case.name, pattern)]


def make(case: Case) -> SweepRecording:
    """Render and record *case*; 3 to 5 s of one core."""
    chosen = SETS[case.set_name]
    # Motion and sensor have streams of their own, so that a change to one leaves the other as it was.
    entropy = [case.seed, zlib.crc32(case.name.encode())]
    motion_rng, retina_rng = (np.random.default_rng(child) for child in np.random.SeedSequence(entropy).spawn(2))
    side = 3 * (SIZE_PX + 2 * MARGIN_PX)
    renderer = FocusRenderer(load_picture(case.scene, side), load_psf(case.fov), MARGIN_PX)
    moved = chosen.motion_px * shifts_px(MOTIONS[case.motion], FRAMES, FRAME_US / 1e3, motion_rng)
    retina: Retina | None = None
    kept_t_us, kept = [], []
    for k in range(FRAMES):
        t_us = k * FRAME_US
        image = renderer.frame(START_UM + SPEED_UM_S * t_us / 1e6, (float(moved[k, 0]), float(moved[k, 1])))
        np.clip(image, 0.0, 255.0, out=image)
        if retina is None:
            retina = Retina(RETINAS[chosen.retina], image, (FRAMES - 1) * FRAME_US, retina_rng)
        else:
            retina.see(image, float(t_us))
        if t_us % KEEP_EVERY_US == 0:
            kept_t_us.append(t_us)
            kept.append(np.round(image).astype(np.uint8))
    assert retina is not None
    seen = retina.events()
    return SweepRecording(case, seen.t_us, seen.x, seen.y, seen.on, np.array(kept_t_us), np.stack(kept))


def load_or_make(case: Case, cache: Path | None) -> SweepRecording:
    """Return *case* from *cache*, or make it and leave it there."""
    if cache is None:
        return make(case)
    path = cache / f"{case.name}-seed{case.seed}-g{GENERATION}.npz"
    if path.is_file():
        with np.load(path) as kept:
            return SweepRecording(
                case,
                kept["t_us"].astype(np.int64),
                *(kept[name] for name in ("x", "y", "on", "frame_t_us", "frames")),
            )
    made = make(case)
    cache.mkdir(parents=True, exist_ok=True)
    # Written aside and renamed: an interrupted run leaves no half a case under the name.
    aside = cache / f".{path.stem}-{os.getpid()}.npz"
    np.savez(
        aside,
        t_us=made.t_us.astype(np.uint32),
        x=made.x,
        y=made.y,
        on=made.on,
        frame_t_us=made.frame_t_us,
        frames=made.frames,
    )
    aside.replace(path)
    return made
