"""One case of a benchmark set: how it is made, what it holds, and where it is kept.

A case follows from its name and the seed alone, whichever process makes it and in whatever order.
"""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.limit import SignLimit
from benchmarks.retina import Retina, RetinaEvents, joined
from benchmarks.scenery import Scenery
from benchmarks.sets import APERTURE_US, FRAME_PERIODS_US, SETS, CaseSet
from benchmarks.shutter import Shutter
from elpd.baselines import FocusStack, LensPath, StackFrame
from elpd.baselines.contrast import tenengrad
from elpd.baselines.rates import vertex
from elpd.records import Geometry, Roi

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

GENERATION = 5
"""Raised whenever the same name and seed would give other events, so that stale files are not used."""


@dataclass(frozen=True, slots=True)
class Case:
    """One sweep: to be made, or where it is recorded in ``folder``."""

    set_name: str
    scene: str
    fov: int
    motion: str
    seed: int
    folder: Path | None = None

    @property
    def name(self) -> str:
        """The name in tables, files and ``--cases`` patterns."""
        return f"{self.set_name}-{self.scene}-fov{self.fov}-{self.motion}"

    def matches(self, pattern: str) -> bool:
        """Say whether the name is one of *pattern*'s."""
        return fnmatchcase(self.name, pattern)

    @property
    def of_set(self) -> CaseSet:
        """The set it belongs to."""
        return SETS[self.set_name]


@dataclass(frozen=True, slots=True)
class SweepRecording:
    """A sweep and its truth, the time in focus. Frames (n, size, size) ``uint8`` are there from ``frame_t_us`` (n,) on.

    ``sharpest_um`` is where the noise-free picture of this scene has its highest contrast. Off the axis that is not
    where the PSF has its least RMS radius, which is what the paper and the tables call truth: no method that looks at
    pictures does better than the difference, unless it tells edges of one direction from those of another
    (``elpd.vision.astigmatism``). ``sign_limit_um`` is the statistical limit (``limit``), ``nan``
    where it is not defined.
    """

    case: Case
    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    frame_t_us: NDArray[np.int64]
    frames: NDArray[np.uint8]
    sharpest_um: float
    truth_us: float
    sign_limit_um: float

    @property
    def geometry(self) -> Geometry:
        """The simulated part of the sensor."""
        return Geometry(self.case.of_set.size_px, self.case.of_set.size_px)

    @property
    def roi(self) -> Roi:
        """The region of interest: all but a border."""
        return region(self.case.of_set)

    def frames_at(self, rate: str) -> tuple[StackFrame, ...]:
        """Return the frames of a camera that delivers *rate* of them per second, stamped amid their exposures."""
        wanted_us = np.arange(0, self.case.of_set.end_us + 1, FRAME_PERIODS_US[rate])
        if rate == "1":
            wanted_us = wanted_us[:1]
        # Recorded frames keep their own times, about as far apart as the rate says.
        nearest = np.unique(np.argmin(np.abs(self.frame_t_us[None, :] - wanted_us[:, None]), axis=1))
        return tuple(self._frame(k) for k in nearest)

    def frame_nearest(self, t_us: float) -> StackFrame:
        """Return the kept frame nearest to *t_us*."""
        return self._frame(int(np.argmin(np.abs(self.frame_t_us - self.case.of_set.frame_age_us - t_us))))

    def _frame(self, k: int) -> StackFrame:
        return StackFrame(int(self.frame_t_us[k]) - self.case.of_set.frame_age_us, self.frames[k])

    def path(self) -> LensPath:
        """Return where the lens was."""
        chosen = self.case.of_set
        knots_us = sorted({0.0, float(chosen.sweep_begin_us), float(chosen.end_us)})
        return LensPath(np.array(knots_us), np.array([chosen.position_um(t_us) for t_us in knots_us]))

    def stack(self, frames: Sequence[StackFrame]) -> FocusStack:
        """Return the sweep, without what an aperture made before it, as the peers see it."""
        chosen = self.case.of_set
        first = int(np.searchsorted(self.t_us, chosen.sweep_begin_us))
        return FocusStack(
            self.t_us[first:],
            self.x[first:],
            self.y[first:],
            self.on[first:],
            self.geometry,
            self.roi,
            chosen.sweep_begin_us,
            chosen.end_us,
            tuple(frames),
            self.path(),
        )


def region(chosen: CaseSet) -> Roi:
    """Return the region of interest of a set."""
    side = chosen.size_px - 2 * chosen.border_px
    return Roi(chosen.border_px, chosen.border_px, side, side)


def cases_of(set_name: str, seed: int, pattern: str = "*") -> list[Case]:
    """Return the set's cases whose name matches *pattern*."""
    chosen = SETS[set_name]
    every = (
        Case(set_name, scene, field, motion, seed)
        for scene in chosen.scenes
        for field in chosen.fields
        for motion in chosen.motions
    )
    return [case for case in every if case.matches(pattern)]


def streams(case: Case) -> tuple[np.random.Generator, np.random.Generator, np.random.Generator]:
    """Return the case's chance, that of its motion, its sensor and its frames: a change to one leaves the others."""
    entropy = [case.seed, zlib.crc32(case.name.encode())]
    motion, retina, frames = (np.random.default_rng(one) for one in np.random.SeedSequence(entropy).spawn(3))
    return motion, retina, frames


def make(case: Case) -> SweepRecording:
    """Render and record *case*; some seconds of one core."""
    chosen = case.of_set
    motion_rng, retina_rng, frame_rng = streams(case)
    scenery = Scenery(case, chosen.end_us, motion_rng)
    times_us = range(0, chosen.end_us + 1, chosen.step_us)

    def picture_at(t_us: int) -> NDArray[np.float32]:
        return scenery.picture(t_us, chosen.position_um(t_us), _opened(chosen, t_us))

    shutter = Shutter(chosen.exposure_us, chosen.read_out_us, chosen.step_us)
    for t_us in range(-shutter.reach_us, 0, chosen.step_us):
        shutter.see(picture_at(t_us))
    limit = SignLimit(region(chosen))
    aperture: Retina | None = None
    retina: Retina | None = None
    kept_t_us, kept, edges = [], [], []
    for t_us in times_us:
        image = picture_at(t_us)
        shutter.see(image)
        if chosen.expose is not None and t_us <= APERTURE_US:
            dimmed = image * np.float32(_opened(chosen, t_us))
            if aperture is None:
                aperture = Retina(chosen.expose, dimmed, 0, APERTURE_US, retina_rng)
            else:
                aperture.see(dimmed, float(t_us))
            if t_us < APERTURE_US:
                continue
        if retina is None:
            retina = Retina(chosen.retina, image, t_us, chosen.end_us, retina_rng)
        else:
            retina.see(image, float(t_us))
            limit.add(retina.newest(), image, chosen.position_um(t_us - 0.5 * chosen.step_us))
        if t_us % chosen.keep_every_us == 0:
            kept_t_us.append(t_us)
            edges.append(tenengrad(image, region(chosen)))
            exposed = shutter.exposed()
            noisy = exposed + chosen.frame_noise_dn * frame_rng.standard_normal(exposed.shape)
            kept.append(np.round(np.clip(noisy, 0.0, 255.0)).astype(np.uint8))
    assert retina is not None
    parts: list[RetinaEvents] = [one.events() for one in (aperture, retina) if one is not None]
    seen = joined(parts)
    sharpest = vertex(np.array(edges), int(np.argmax(edges)))
    sharpest_us = float(np.interp(sharpest, np.arange(len(kept_t_us)), kept_t_us))
    return SweepRecording(
        case=case,
        t_us=seen.t_us,
        x=seen.x,
        y=seen.y,
        on=seen.on,
        frame_t_us=np.array(kept_t_us),
        frames=np.stack(kept),
        sharpest_um=chosen.position_um(sharpest_us),
        truth_us=chosen.truth_us,
        sign_limit_um=limit.sigma_um(chosen.depth_of_focus_um),
    )


def _opened(chosen: CaseSet, t_us: float) -> float:
    """Return the share of the aperture's area that is open."""
    return 1.0 if chosen.expose is None else min(t_us / APERTURE_US, 1.0)


def load_or_make(case: Case, cache: Path | None) -> SweepRecording:
    """Return *case* from *cache*, or make it and leave it there."""
    if cache is None:
        return make(case)
    path = cache / f"{case.name}-seed{case.seed}-g{GENERATION}.npz"
    if path.is_file():
        with np.load(path) as kept:
            columns = {name: kept[name] for name in ("x", "y", "on", "frame_t_us", "frames")}
            return SweepRecording(
                case=case,
                t_us=kept["t_us"].astype(np.int64),
                **columns,
                sharpest_um=float(kept["sharpest_um"]),
                truth_us=case.of_set.truth_us,
                sign_limit_um=float(kept["sign_limit_um"]),
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
        sharpest_um=made.sharpest_um,
        sign_limit_um=made.sign_limit_um,
    )
    aside.replace(path)
    return made
