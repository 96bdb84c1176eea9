"""Evidence for a sensor's calibration, from the simulated sensor without a rig: there-and-backs around focus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.sim.world import BIRTH_NS
from sim_rigs import MARGIN_PX, Setup

from elpd.calibrate.evidence import Columns, Evidence, Pass, Rest, Sweeps
from elpd.records import Geometry
from elpd.vision.ruler import Ruler

if TYPE_CHECKING:
    from elpd_drivers.sim.sensor import BiasLevels
    from numpy.typing import NDArray

PAUSE_S = 0.03
SPEEDS_UM_S = (500.0, 1000.0)


class Knots:
    """A lens that goes straight from knot to knot."""

    def __init__(self, knots: list[tuple[float, float]]) -> None:
        self.t_s, self.um = np.array(knots).T

    def carriage_um(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(np.interp((np.asarray(times_ns) - BIRTH_NS) / 1e9, self.t_s, self.um))


def columns(events: NDArray[Any]) -> Columns:
    return Columns(events["t"].astype(np.int64), events["x"].copy(), events["y"].copy(), events["on"].astype(np.uint8))


def rest_of(setup: Setup, seconds: float) -> Rest:
    return Rest(columns(setup.run(seconds)), 0, round(1e6 * seconds))


def there_and_back(
    seed: int,
    scene: str,
    *,
    size: tuple[int, int] = (96, 72),
    focus: BiasLevels | None = None,
    reach_um: float = 100.0,
    still: bool = False,
    **sensor: Any,
) -> tuple[Setup, Evidence]:
    """Return a world and what a calibration sees in it: rest, then two speeds, three rounds each after one."""
    begun_s = 0.3
    knots, sweeps = [(0.0, 0.0), (begun_s, 0.0)], []
    for speed_um_s in SPEEDS_UM_S:
        passes: list[tuple[float, float, int]] = []
        for target_um in (-reach_um, reach_um, -reach_um, *(3 * (reach_um, -reach_um))):
            from_s, from_um = knots[-1]
            to_s = from_s + abs(target_um - from_um) / speed_um_s
            knots += [(to_s, target_um), (to_s + PAUSE_S, target_um)]
            passes.append((from_s, to_s, 1 if target_um > from_um else -1))
        sweeps.append((speed_um_s, passes[3:], knots[-1][0]))
    lens = Knots([(t_s, 0.0) for t_s, _ in knots] if still else knots)
    told = Knots(knots)
    if focus is not None:
        sensor["focus"] = focus
    setup = Setup(lens, seed=seed, scene=scene, size=size, sensor=sensor)
    events = columns(setup.run(knots[-1][0]))
    grid = np.arange(0.0, 1e6 * knots[-1][0], 500.0)
    path = Ruler.of_path(grid, np.asarray(np.interp(1e-6 * grid, told.t_s, told.um)))
    found = []
    for speed_um_s, passes, end_s in sweeps:
        begin_us, end_us = round(1e6 * passes[0][0]), round(1e6 * end_s)
        single = tuple(Pass(round(1e6 * from_s), round(1e6 * to_s), sign) for from_s, to_s, sign in passes)
        found.append(Sweeps(speed_um_s, events.between(begin_us, end_us), path, begin_us, end_us, single))
    rest = Rest(events.between(0, round(1e6 * begun_s)), 0, round(1e6 * begun_s))
    return setup, Evidence(Geometry(*size), rest, tuple(found), brightness=true_brightness(setup))


def true_brightness(setup: Setup) -> NDArray[np.float32]:
    """Return linear light in focus over that of the brightest per cent."""
    light = setup.canvas[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    return np.minimum(light / np.percentile(light, 99), 1.0).astype(np.float32)
