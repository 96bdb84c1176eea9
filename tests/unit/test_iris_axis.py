"""A stepper iris on another axis of the lens's controller, from the wire to the light."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from elpd_drivers.sim.aperture import StepperIris
from lens_rigs import Rig, rig

from elpd.calibrate.aperture import measured_on
from elpd.config import load
from elpd.errors import ConfigError, LensError, UsageError
from elpd.motion.lens_output import aperture_on_lens
from elpd.rig import build

STEPS, SPEED_SPS = 4800, 12_800.0
WAY_MS = 1000 * STEPS / SPEED_SPS
AXES = {"zaber": 2, "tmcl": 1, "scf4": "C", "theia": 3}
FEW = {"theia": (75, 200.0)}
"""Of full steps, as P-irises are driven by boards that do not divide them: as long on its way."""
everywhere = pytest.mark.parametrize("kind", AXES)


def with_iris(kind: str = "zaber", **more: Any) -> tuple[Rig, StepperIris]:
    steps, speed_sps = FEW.get(kind, (STEPS, SPEED_SPS))
    made, iris = rig(kind), StepperIris(steps, at_steps=steps / 2)
    made.board.add_iris(iris)
    made.open(**{"iris_axis": AXES[kind], "iris_open": steps, "iris_speed_sps": speed_sps, **more})
    return made, iris


def steps_of(iris: StepperIris, made: Rig) -> float:
    return float(iris.steps_at(made.clock.now_ns()))


@everywhere
def test_closing_for_the_first_time_homes_it_and_opening_takes_its_time(kind: str) -> None:
    made, iris = with_iris(kind)
    aperture = aperture_on_lens({"output": "iris", "opening_ms": 600}, made.lens)
    with pytest.raises(LensError, match="close it first"):
        aperture.open()
    aperture.close()
    made.live(600)
    assert steps_of(iris, made) == 0.0
    stamp = aperture.open()
    made.live(WAY_MS / 2)
    assert steps_of(iris, made) == pytest.approx(iris.steps / 2, rel=0.02)
    made.live(WAY_MS)
    assert steps_of(iris, made) == iris.steps
    assert stamp.begun_ns < iris.began_ns < stamp.begun_ns + 1e6 * WAY_MS / 10
    assert made.rotor == pytest.approx(3200.0), "the lens stays"
    aperture.close()
    made.live(2 * WAY_MS)
    assert steps_of(iris, made) == 0.0


@pytest.mark.parametrize("kind", ["zaber", "tmcl"])
def test_the_lens_moves_and_is_watched_while_it_turns(kind: str) -> None:
    made, iris = with_iris(kind)
    made.lens.set_output("iris", on=False)
    made.lens.move_to(4800, 6000.0)
    made.live(600)
    assert made.rotor == pytest.approx(4800.0)
    assert steps_of(iris, made) == 0.0
    estimate = made.lens.position_at(made.clock.now_ns())
    assert estimate.steps == pytest.approx(4800, abs=0.5)


def test_a_refused_turn_is_a_fault() -> None:
    made, _ = with_iris()
    made.lens.set_output("iris", on=False)
    made.live(600)
    made.board._iris_flags.add("WR")  # it lost its place: a brown-out of its driver
    made.lens.set_output("iris", on=True)
    with pytest.raises(LensError, match="BADDATA"):
        made.live(50)


def test_a_fault_of_its_axis_is_named() -> None:
    made, _ = with_iris()
    made.lens.set_output("iris", on=False)
    made.live(600)
    made.board._iris_flags.add("FM")
    made.lens.set_output("iris", on=True)
    with pytest.raises(LensError, match="iris's axis stopped itself: motor or driver too hot"):
        made.live(50)


@everywhere
def test_it_is_driven_no_further_than_its_stop_and_both_ways_from_wherever_it_was(kind: str) -> None:
    steps, speed_sps = FEW.get(kind, (STEPS, SPEED_SPS))
    wide = steps - steps // 12
    for begin in (0.0, 1.0):
        made, iris = rig(kind), StepperIris(steps, at_steps=begin * steps)
        made.board.add_iris(iris)
        made.open(iris_axis=AXES[kind], iris_open=wide, iris_speed_sps=speed_sps)
        for on, place in ((False, 0.0), (True, wide), (False, 0.0), (True, wide)):
            made.lens.set_output("iris", on=on)
            made.live(600)
            assert steps_of(iris, made) == pytest.approx(place, abs=0.5)


def test_a_motor_whose_driver_is_too_hot_is_named() -> None:
    made, _ = with_iris("tmcl")
    made.lens.set_output("iris", on=False)
    made.live(600)
    made.board.iris_flags = 2
    with pytest.raises(LensError, match="the iris's motor driver stopped: too hot"):
        made.lens.set_output("iris", on=True)


def test_a_module_without_that_motor_says_so() -> None:
    with pytest.raises(LensError, match=r"has no motor 1 \(lens.iris_axis; it answers with status 4, invalid value"):
        rig("tmcl").open(iris_axis=1, iris_open=STEPS, iris_speed_sps=SPEED_SPS)


def test_on_an_scf4_it_turns_at_rest_only_and_a_count_that_is_wrong_is_a_fault() -> None:
    made, iris = with_iris("scf4")
    made.lens.set_output("iris", on=False)
    with pytest.raises(LensError, match="the iris still turns"):
        made.lens.set_output("iris", on=True)
    made.live(600)
    made.lens.move_to(4800, 6000.0)
    with pytest.raises(LensError, match="while the lens rests only"):
        made.lens.set_output("iris", on=True)
    made.live(600)
    assert made.rotor == pytest.approx(4800.0)
    stands = steps_of(iris, made)
    made.lens.set_output("iris", on=False)
    made.live(20)
    assert steps_of(iris, made) == stands, "it is there already"
    made.board.iris_motor.set_count(made.clock.now_ns(), 7)
    with pytest.raises(LensError, match="the iris's motor C stands at 7 instead of 32000"):
        made.live(20)


def test_on_a_theia_board_lens_and_iris_wait_for_each_other() -> None:
    made, iris = with_iris("theia", max_speed_um_s=4000.0)
    made.lens.set_output("iris", on=False)
    with pytest.raises(UsageError, match="cannot turn the iris now: it moves for another"):
        made.lens.set_output("iris", on=True)
    with pytest.raises(UsageError, match="cannot home now"):
        made.lens.home(made.soon(10_000))
    made.live(600)
    assert made.reports, "it is asked again"
    made.lens.home(made.soon(10_000))
    made.lens.move_to(4000, SPEED_SPS)
    with pytest.raises(UsageError, match="cannot turn the iris now"):
        made.lens.set_output("iris", on=True)
    made.live(600)
    assert made.rotor == pytest.approx(4000.0)
    stands = steps_of(iris, made)
    made.lens.set_output("iris", on=False)
    made.live(100)
    assert steps_of(iris, made) == stands == 0.0, "it is there already"


def test_a_turn_that_a_theia_board_refuses_is_a_fault() -> None:
    made, _ = with_iris("theia")
    made.board._setups.clear()  # it browned out, and has not been told of its motors since
    made.lens.set_output("iris", on=False)
    with pytest.raises(LensError, match="iris's turn failed"):
        made.live(50)


def test_on_an_scf4_nothing_turns_before_homing_has_found_out_how_it_counts() -> None:
    made, iris = with_iris("scf4", trust_position=False, relative="", speed_scale=None)
    with pytest.raises(LensError, match="home it first"):
        made.lens.set_output("iris", on=False)
    made.lens.home(made.soon(30_000))
    made.lens.set_output("iris", on=False)
    made.live(600)
    assert steps_of(iris, made) == 0.0


@pytest.mark.parametrize(
    ("kind", "axis", "words"),
    [
        ("zaber", "2", "iris_axis is '2'; it is one of 2, 3"),
        ("zaber", 0, "it is one of 2, 3"),
        ("tmcl", 0, "the lens's own axis"),
        ("tmcl", 7, "it is one of 1, 2, 3, 4, 5"),
        ("scf4", "A", "the lens's own axis"),
        ("scf4", "AB", "it is one of 'B', 'C'"),
        ("scf4", 2, "it is one of 'B', 'C'"),
        ("theia", 2, "it is one of 3"),
    ],
)
def test_axes_that_a_controller_does_not_have_are_refused(kind: str, axis: object, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        with_iris(kind, iris_axis=axis)


def test_a_speed_that_a_motion_controller_cannot_make_is_refused() -> None:
    made = rig("tmcl", module=1140)
    made.board.add_iris(StepperIris(STEPS))
    with pytest.raises(ConfigError, match="the divisors of motor 1 allow"):
        made.open(iris_axis=1, iris_open=STEPS, iris_speed_sps=1e6)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"iris_axis": None}, "need lens.iris_axis"),
        ({"iris_axis": 1}, "the lens's own axis"),
        ({"iris_open": 0}, "both 0 steps"),
        ({"iris_speed_sps": 0.0}, r"iris_speed_sps is 0; give steps/s"),
        ({"iris_open": 9000}, "axis 2 of the device goes from 0 to 4800"),
        ({"iris_speed_sps": 1e6}, "at the most"),
    ],
)
def test_tables_that_cannot_be_are_refused(table: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        with_iris(**table)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"iris_speed_sps": 400.0}, "turns its iris at 10 to 200"),
        ({"iris_open": -75}, "open is above closed on a Theia"),
    ],
)
def test_what_a_theia_board_cannot_do_is_refused(table: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        with_iris("theia", **table)


def test_a_device_with_one_axis_says_so() -> None:
    with pytest.raises(LensError, match="BADAXIS"):
        rig("zaber").open(iris_axis=2, iris_open=STEPS, iris_speed_sps=SPEED_SPS)


def test_what_it_passes_grows_from_dead_band_to_dead_band() -> None:
    iris = StepperIris(100)
    iris.turn(0, 100, 100.0)
    light = iris.transmittance_at(np.array([0, 40_000_000, 500_000_000, 960_000_000, 10**9], np.int64))
    assert light.tolist() == pytest.approx([0.0, 0.0, 0.25, 1.0, 1.0], abs=1e-6)
    assert iris.began_ns == pytest.approx(50_000_000)
    iris.halt(500_000_000)
    assert float(iris.steps_at(10**9)) == pytest.approx(50.0)
    with pytest.raises(ConfigError, match="more than 0"):
        StepperIris(0)


@everywhere
def test_the_simulated_rig_has_one_on_its_board(kind: str) -> None:
    steps, speed_sps = FEW.get(kind, (STEPS, SPEED_SPS))
    small = ["sim.width=32", "sim.height=32", "state.profiles=false", f"sim.iris_steps={steps}"]
    parts = build(load(overrides=[*small, f"sim.iris_speed_sps={speed_sps}", f"sim.board={kind}"]))
    assert parts.aperture is not None
    assert parts.aperture.opening_ms == pytest.approx(520.0)
    assert parts.aperture.close().command == "iris off"
    with pytest.raises(ConfigError, match="board 'tic' has no second axis"):
        build(load(overrides=small))


def test_a_profile_belongs_to_the_speed_that_it_was_measured_at() -> None:
    table = ["rig=hardware", "camera.driver=file", "lens.driver=zaber", "aperture.driver=lens-output"]
    slow, fast = (
        measured_on(load(overrides=[*table, "lens.iris_axis=2", f"lens.iris_speed_sps={speed}"]))
        for speed in (100, 200)
    )
    assert "lens.iris_speed_sps" in str(slow.difference(fast))
