"""What motion alone costs: a simulated lens on every board is swept, stopped and brought back, without a camera.

    python tools/motion_error.py --seeds 20 [--board tic] [--calibrated] [--adapters] [--json]

Each seed draws where focus is, from which side and from where the sweep comes, and how late it is seen. The sweep, the
stop and the way back are the ones of a focus cycle; that focus was passed is told, at an instant, and where that was
is looked up in the lens's own trajectory. So what is left between the glass at rest and focus is the motion's doing:
the position's model, rounding, backlash (4 um), and whatever the final approach gets wrong. Printed for each board:
the strategy; that error's median, 95th percentile and largest; how near the rotor came to a limit; and of the position
model, asked at random instants of the motion at once and after it, how often 1.96 of its standard deviations cover the
truth, its median standard deviation in motion and at rest, and the error's own. A run that ends in a fault is named.

No two boards are alike: each seed's takes another time over commands, as far as its driver says not to know it. They
are wired straight to the host. With ``--adapters`` each seed has another USB adapter between, as slow as
drivers suppose of those that they open by name: how slow this one is, they are not told.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from elpd_drivers.lenses.avr_wire import FASTEST_SPS
from elpd_drivers.lenses.axis import ADAPTER_LATENCY_SIGMA_US, ADAPTER_LATENCY_US
from elpd_drivers.sim.boards import avr as avr_board
from elpd_drivers.sim.controllers import CONTROLLERS, Wanted, controller, fitted
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens
from elpd_drivers.sim.world import World, random_stream

from elpd.calibrate.lens import measure_lens
from elpd.calibrate.lens_live import LensBench
from elpd.errors import LensError
from elpd.focus.approach import WayBack
from elpd.focus.settings import CycleSettings
from elpd.focus.stage import REST_LIMIT_MS, Stage
from elpd.motion.braking import braking_from
from elpd.ports import LearnsStops, RigParts
from elpd.records import CameraPacket, Encoding, Geometry, StopMode
from elpd.scale import LensScale
from elpd.units import HostNs, SensorUs, after_ms

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.ports import Clock, Lens
    from elpd.records import StopTiming

UM_PER_STEP, TRAVEL_UM, BACKLASH_UM = 0.3125, 2500.0, 4.0
SPEED_UM_S, ACCELERATION_UM_S2 = 4000.0, 400_000.0
DEPTH_OF_FOCUS_UM = 6.0
OWN_US = {"avr": 115.0, "grbl": 225.0, "scf4": 300.0, "theia": 300.0, "tic": 100.0, "tmcl": 250.0, "zaber": 300.0}
"""What the boards here take over a command by themselves, on average."""
SQRT_2 = 2.0**0.5
SEEN_MS = (3.0, 12.0)
"""How late it is noticed that focus was passed."""

ROUGHLY_UM = 3.0
"""Standard deviation of where focus is first said to be: the way back sets out on that."""

ASKED_PER_S = 2000
COVERING = 1.96


class BlindCamera:
    """A camera that delivers nothing in time."""

    geometry = Geometry(16, 16)

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def start(self) -> None:
        """Do nothing."""

    def stop(self) -> None:
        """Do nothing."""

    def read(self, timeout_s: float) -> CameraPacket:
        """Let the time pass and say that nothing happened in it."""
        self._clock.sleep_until(HostNs(self._clock.now_ns() + round(timeout_s * 1e9)))
        now = self._clock.now_ns()
        return CameraPacket(np.empty(0, np.uint16), Encoding.EVT3, now, SensorUs(now // 1000))


@dataclass
class Asked:
    """A question to the position model: when it was about, and the answer."""

    when_ns: int
    steps: float
    sigma_steps: float


@dataclass
class Run:
    """One sweep and return."""

    strategy: str
    final_error_um: float
    nearest_limit_um: float
    seen: list[tuple[float, float, bool]]
    """Error and standard deviation of the position model, in steps, and whether the motor moved."""


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--board", choices=sorted(CONTROLLERS), action="append")
    parser.add_argument("--calibrated", action="store_true", help="Calibrate the lens's stops first, and use them.")
    parser.add_argument("--adapters", action="store_true", help="A USB adapter between, each seed another.")
    parser.add_argument("--json", action="store_true", dest="as_json")
    chosen = parser.parse_args()
    rows = []
    for board in chosen.board or sorted(CONTROLLERS):
        hindrance = avr_board.hindrance() if board == "avr" else None
        if hindrance is not None:
            print(f"{board}: left out, {hindrance}", file=sys.stderr)
            continue
        if not made(board, 0, 1250.0)[2].capabilities.stop_on_command:
            print(f"{board}: left out, it cannot stop on command", file=sys.stderr)
            continue
        measured = calibrated(board) if chosen.calibrated else {}
        runs, faults = [], []
        for seed in range(chosen.first, chosen.first + chosen.seeds):
            try:
                runs.append(one_run(board, seed, measured, adapters=chosen.adapters))
            except LensError as error:
                faults.append(f"seed {seed}: {error}")
        rows.append({**summary(board, runs), "faults": faults})
        if not chosen.as_json:
            print(told(rows[-1]), flush=True)
    if chosen.as_json:
        print(json.dumps({"um_per_step": UM_PER_STEP, "backlash_um": BACKLASH_UM, "rows": rows}))
    return 0


def made(board: str, seed: int, start_um: float, *, adapters: bool = False) -> tuple[World, SimulatedLens, Lens]:
    """Make a lens with backlash on a board, homed and open; what adapters add, a board's own latency is part of."""
    world = World()
    fastest_um_s = 3 * SPEED_UM_S if board != "avr" else min(3 * SPEED_UM_S, FASTEST_SPS * UM_PER_STEP)
    mechanics = LensMechanics(um_per_step=UM_PER_STEP, travel_um=TRAVEL_UM, backlash_um=BACKLASH_UM)
    mechanism = SimulatedLens(mechanics, start_um=start_um, history_s=100.0)
    wanted = Wanted(UM_PER_STEP, TRAVEL_UM, fastest_um_s, ACCELERATION_UM_S2)
    adapter_us = 0.0
    own = of_its_own(board, seed)
    if adapters:
        usual_us, sigma_us = ADAPTER_LATENCY_US - OWN_US[board], ADAPTER_LATENCY_SIGMA_US
        adapter_us = max(0.0, float(random_stream(seed, "adapter").normal(usual_us, sigma_us)))
    port, table = fitted(board, mechanism, wanted, world, seed=seed, adapter_ns=round(adapter_us * 1000), own=own)
    if adapters:
        table = {**table, "latency_us": ADAPTER_LATENCY_US, "latency_sigma_us": ADAPTER_LATENCY_SIGMA_US}
    world.add(port)
    return world, mechanism, controller(board).open_lens(table, world, port)


def of_its_own(board: str, seed: int) -> Mapping[str, Any]:
    """Return how soon this seed's board obeys, in us: no two are alike, and a driver knows only what they may be.

    It supposes half of the variance of a command's time to be chance, command by command, and half the board's own.
    """
    usual = getattr(controller(board).board.config(), "latency_us", None)
    if usual is None:
        return {}
    middle_us, half_us = (usual[0] + usual[1]) / 2, (usual[1] - usual[0]) / 2
    chance = random_stream(seed, "board")
    own_us = middle_us + float(chance.uniform(-half_us, half_us)) / SQRT_2
    return {"latency_us": (round(max(own_us - half_us / SQRT_2, 0.0)), round(own_us + half_us / SQRT_2))}


def calibrated(board: str) -> Mapping[StopMode, StopTiming]:
    """Return what `elpd calibrate lens` finds on this board."""
    world, _, lens = made(board, 4711, 1250.0)
    bench = LensBench(world, lens, LensScale(UM_PER_STEP), speed_um_s=SPEED_UM_S, repeats=4)
    return measure_lens(bench.measure(homing=False)).timings()


def one_run(board: str, seed: int, measured: Mapping[StopMode, StopTiming], *, adapters: bool = False) -> Run:
    """Sweep past focus, stop, go back, rest."""
    chance = random_stream(seed, "motion error")
    sign = int(chance.choice([-1, 1]))
    focus_um = float(chance.uniform(60.0, TRAVEL_UM - 60.0))
    room_um = focus_um if sign > 0 else TRAVEL_UM - focus_um
    start_um = focus_um - sign * float(chance.uniform(30.0, min(400.0, room_um)))
    world, mechanism, lens = made(board, seed, round(start_um / UM_PER_STEP) * UM_PER_STEP, adapters=adapters)
    if measured and isinstance(lens, LearnsStops):
        lens.learn_stops(measured)
    parts = RigParts(world, BlindCamera(world), lens, None, LensScale(UM_PER_STEP))
    stage = Stage(parts)
    settings = CycleSettings(speed_um_s=SPEED_UM_S, backlash_um=BACKLASH_UM + 2.0)
    capabilities = lens.capabilities
    braking = braking_from(SPEED_UM_S, capabilities, lens.limits, UM_PER_STEP)
    asked: list[Asked] = []
    stage.listener = lambda _: ask(asked, lens, world, chance)
    stage.rest(REST_LIMIT_MS)
    begun_ns = world.now_ns()

    # out: past focus, and on until somebody notices, or the limit is near
    edge_um = stage.to_um(lens.limits.max_steps if sign > 0 else lens.limits.min_steps)
    lens.run(sign * SPEED_UM_S / UM_PER_STEP, after_ms(begun_ns, 2000.0))
    passed_ns: int | None = None
    seen_ns = HostNs(1 << 62)
    while world.now_ns() < seen_ns and sign * (edge_um - stage.here_um()) > braking.longest_um:
        stage.read(0.001)
        if passed_ns is None:
            passed_ns = crossing(mechanism, focus_um, sign, begun_ns, world.now_ns())
            if passed_ns is not None:
                seen_ns = after_ms(HostNs(passed_ns), float(chance.uniform(*SEEN_MS)))
    stop = lens.stop(StopMode.ABRUPT if capabilities.abrupt_stop else StopMode.RAMPED)
    way = WayBack(stage, settings, sign)
    if capabilities.abrupt_stop and capabilities.native_velocity:
        way.set_out(focus_um + float(chance.normal(0.0, ROUGHLY_UM)))
        stage.wait_ms(10.0)
    else:
        stage.rest(REST_LIMIT_MS)
    passed_ns = passed_ns or crossing(mechanism, focus_um, sign, begun_ns, world.now_ns())
    if passed_ns is None:
        raise RuntimeError(f"{board}, seed {seed}: focus at {focus_um:.0f} um was not passed; stop at {stop.done_ns}")
    way.arrive(stage.to_um(lens.position_at(HostNs(passed_ns)).steps))
    stage.wait_ms(50.0)
    now_ns = world.now_ns()
    times = np.arange(begun_ns, now_ns, 100_000, dtype=np.int64)
    rotor = mechanism.motor_steps(times) * UM_PER_STEP
    final_um = float(mechanism.carriage_um(np.array([now_ns]))[0])
    seen = checked(mechanism, asked)
    nearest_um = min(float(rotor.min()), TRAVEL_UM - float(rotor.max()))
    strategy = "stop_on_detect" if braking.stops_on_detect(DEPTH_OF_FOCUS_UM) else "sweep_and_return"
    return Run(strategy, final_um - focus_um, nearest_um, seen)


def crossing(mechanism: SimulatedLens, focus_um: float, sign: int, begin_ns: int, end_ns: int) -> int | None:
    """Return when the glass passed focus, to the microsecond; ``None`` if it has not."""
    low, high = begin_ns, end_ns
    at = mechanism.carriage_um(np.array([high]))[0]
    if sign * (at - focus_um) < 0.0:
        return None
    while high - low > 1000:
        middle = (low + high) // 2
        at = mechanism.carriage_um(np.array([middle]))[0]
        low, high = (low, middle) if sign * (at - focus_um) >= 0.0 else (middle, high)
    return high


def ask(asked: list[Asked], lens: Lens, world: World, chance: np.random.Generator) -> None:
    """Ask the position model about now, and about some time ago."""
    if chance.random() > ASKED_PER_S * 0.001:
        return
    for back_ms in (0.0, float(chance.uniform(2.0, 30.0))):
        when = HostNs(world.now_ns() - round(back_ms * 1e6))
        estimate = lens.position_at(when)
        asked.append(Asked(int(when), estimate.steps, estimate.sigma_steps))


def checked(mechanism: SimulatedLens, asked: list[Asked]) -> list[tuple[float, float, bool]]:
    """Compare answers with where the pulses were."""
    times = np.array([one.when_ns for one in asked], dtype=np.int64)
    truth = mechanism.motor_steps(times)
    moving = np.abs(mechanism.motor_steps(times + 500_000) - truth) > 0.01
    return [
        (one.steps - float(at), one.sigma_steps, bool(moved))
        for one, at, moved in zip(asked, truth, moving, strict=True)
    ]


def summary(board: str, runs: list[Run]) -> dict[str, Any]:
    """Return a board's row."""
    errors = np.abs([one.final_error_um for one in runs])
    seen = np.array([item for one in runs for item in one.seen])
    strategies = sorted({one.strategy for one in runs})
    row: dict[str, Any] = {
        "board": board,
        "seeds": len(runs),
        "strategy": strategies[0] if len(strategies) == 1 else strategies,
        "median_um": float(np.median(errors)),
        "p95_um": float(np.percentile(errors, 95)),
        "largest_um": float(errors.max()),
        "nearest_limit_um": min(one.nearest_limit_um for one in runs),
    }
    for name, kind in (("moving", 1.0), ("resting", 0.0)):
        part = seen[seen[:, 2] == kind]
        row[name] = asdict(
            Coverage(
                questions=len(part),
                covered=float(np.mean(np.abs(part[:, 0]) <= COVERING * part[:, 1])),
                sigma_um=float(np.median(part[:, 1])) * UM_PER_STEP,
                rms_um=float(np.sqrt(np.mean(part[:, 0] ** 2))) * UM_PER_STEP,
            )
        )
    return row


@dataclass
class Coverage:
    """Of the position model: how often it covers the truth, its median standard deviation, and its error's rms."""

    questions: int
    covered: float
    sigma_um: float
    rms_um: float


def told(row: dict[str, Any]) -> str:
    """Return a row for people."""
    over_um = -row["nearest_limit_um"]
    beyond = "never beyond a limit" if over_um <= 1e-9 else f"{over_um:.1f} um BEYOND a limit"
    off = f"{row['median_um']:.2f} um off (median), {row['p95_um']:.2f} (p95), {row['largest_um']:.2f} at most"
    words = [f"{row['board']:6s} {row['strategy']}: rests {off}, {row['seeds']} seeds; {beyond}"]
    for name in ("moving", "resting"):
        one = SimpleNamespace(**cast("dict[str, Any]", row[name]))
        words.append(
            f"       {name}: {one.covered:.1%} of {one.questions} within 1.96 sigma; sigma {one.sigma_um:.2f} um, "
            f"error {one.rms_um:.2f} um rms"
        )
    words += [f"       FAULT {fault}" for fault in row["faults"]]
    return "\n".join(words)


if __name__ == "__main__":
    sys.exit(main())
