"""What every lens driver promises, told as stories in virtual time: simulated lens, simulated board, real bytes.

In memory, and through a real serial port's driver and the kernel's terminal, which time waits for.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import pytest
from elpd_drivers.sim.controllers import CONTROLLERS
from lens_rigs import KINDS, LINES, SPEED_SPS, needs, open_rig, rig, rigs_over

from elpd.errors import ConfigError, LensError, UsageError
from elpd.records import LensFlag, StopMode
from elpd.units import Steps

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(params=LINES, scope="module", autouse=True)
def _line(request: pytest.FixtureRequest) -> Iterator[None]:
    with rigs_over(request.param):
        yield


def test_it_identifies_itself_and_knows_where_it_is(kind: str) -> None:
    made = open_rig(kind)
    made.live(20)
    assert made.reports
    assert LensFlag.REFERENCED in made.reports[-1].flags
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(3200, abs=1.7)
    assert not made.moving


def test_it_opens_at_once_after_the_board_was_powered_up(kind: str) -> None:
    made = open_rig(kind, referenced=False)
    with pytest.raises(LensError, match="home it first"):
        made.lens.move_to(Steps(100), SPEED_SPS)


def test_a_move_ends_at_rest_on_its_target(kind: str) -> None:
    made = open_rig(kind)
    made.lens.move_to(Steps(4567), SPEED_SPS)
    made.live(200)
    assert made.rotor == pytest.approx(4567, abs=0.01)
    assert not made.reports[-1].moving
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(4567, abs=0.5)


@pytest.mark.parametrize("way", [-1, 1])
def test_a_run_ends_at_the_limit(kind: str, way: int) -> None:
    made = open_rig(kind)
    made.lens.run(way * SPEED_SPS, made.soon(5000))
    lowest = highest = made.rotor
    for _ in range(800):
        made.live(1)
        lowest, highest = min(lowest, made.rotor), max(highest, made.rotor)
    assert not made.moving
    assert made.rotor == pytest.approx(made.lens.limits.max_steps if way > 0 else made.lens.limits.min_steps, abs=0.01)
    assert lowest >= -0.01
    assert highest <= 8000.01


def test_a_run_is_over_by_its_end_in_time_even_if_nobody_polls(kind: str) -> None:
    made = open_rig(kind)
    end = made.soon(120)
    made.lens.run(SPEED_SPS, end)
    made.clock.pass_ms(60)
    assert made.moving
    made.clock.pass_ms(60)
    assert made.motor.velocity_at(end) == 0.0
    assert made.rotor > 3200 + 700


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_run_while_moving_the_other_way_reverses(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(2000))
    made.live(60)
    before = made.rotor
    made.lens.run(-SPEED_SPS, made.soon(2000))
    made.live_until(lambda: made.motor.velocity_at(made.clock.now_ns()) < -SPEED_SPS * 0.99, 200)
    assert made.rotor > before - 400
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_run_can_change_its_speed(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(3000))
    made.live(60)
    made.lens.run(SPEED_SPS / 4, made.soon(3000))
    made.live(200)
    assert made.motor.velocity_at(made.clock.now_ns()) == pytest.approx(SPEED_SPS / 4, rel=1e-3)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_ramped_stop_keeps_the_reference(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(2000))
    made.live(60)
    made.lens.stop(StopMode.RAMPED)
    made.lens.stop(StopMode.RAMPED)
    made.live(200)
    assert not made.moving
    assert LensFlag.REFERENCED in made.reports[-1].flags
    made.lens.move_to(Steps(3000), SPEED_SPS)
    made.live(300)
    assert made.rotor == pytest.approx(3000, abs=0.01)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_an_abrupt_stop_bites_at_once(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(2000))
    made.live(60)
    before_sps = made.motor.velocity_at(made.clock.now_ns())
    made.lens.stop(StopMode.ABRUPT)
    made.clock.pass_ms(2)
    assert made.motor.velocity_at(made.clock.now_ns()) < before_sps
    made.live(made.dialect.hardest_stop_ms - 2)
    assert not made.moving
    made.live(800)  # GRBL sleeps for half a second over its alarm
    referenced = LensFlag.REFERENCED in made.reports[-1].flags
    assert referenced == made.dialect.abrupt_keeps_reference


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_stop_overtakes_a_reversal_that_waits(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(2000))
    made.live(60)
    made.lens.run(-SPEED_SPS, made.soon(2000))
    made.live(2)
    made.lens.stop(StopMode.RAMPED)
    made.live(300)
    assert not made.moving
    rest = made.rotor
    made.live(300)
    assert made.rotor == rest


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_stop_right_after_the_command_that_moves_is_not_lost(kind: str) -> None:
    for gap_ms in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 8.0):
        made = open_rig(kind)
        made.lens.run(SPEED_SPS, made.soon(3000))
        made.clock.pass_ms(gap_ms)
        made.lens.stop(StopMode.RAMPED)
        made.live(250)
        assert not made.moving, gap_ms


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_stop_from_another_thread_wins_over_a_command_that_is_just_being_written(kind: str) -> None:
    made = open_rig(kind)
    made.live(20)
    write, stops = made.port.write, []

    def write_late(data: bytes) -> None:
        if made.dialect.moves(data):
            made.port.write = write  # type: ignore[method-assign]
            stops.append(made.lens.stop(StopMode.RAMPED))
        write(data)

    made.port.write = write_late  # type: ignore[method-assign]
    made.lens.run(SPEED_SPS, made.soon(3000))
    assert stops
    made.live(250)
    assert not made.moving
    assert made.rotor < 3200 + 1500


@needs("end_switches", "the controller has no limit switches")
def test_the_end_stop_behind_a_false_reference_is_not_ground_against(kind: str) -> None:
    made = open_rig(kind)
    made.motor.slip(made.clock.now_ns(), 600.0)
    made.lens.run(-SPEED_SPS, made.soon(3000))
    try:
        made.live(600)
    except LensError:
        made.clock.pass_ms(5)
    else:
        assert LensFlag.LIMIT in made.reports[-1].flags
        assert LensFlag.REFERENCED not in made.reports[-1].flags
        with pytest.raises(LensError, match="home it first"):
            made.lens.move_to(Steps(4000), SPEED_SPS)
        made.lens.run(SPEED_SPS, made.soon(200))
        made.live(300)
        assert made.rotor > 500.0, "away from the switch it runs"
        assert LensFlag.LIMIT not in made.reports[-1].flags
    assert not made.moving
    assert made.rotor >= -3.0


def test_requests_that_make_no_sense_are_refused_and_nothing_moves(kind: str) -> None:
    made = open_rig(kind)
    with pytest.raises(UsageError, match="outside the travel"):
        made.lens.move_to(Steps(8001), SPEED_SPS)
    with pytest.raises(UsageError, match="limit is"):
        made.lens.run(1e9, made.soon(100))
    with pytest.raises(UsageError):
        made.lens.run(0.0, made.soon(100))
    with pytest.raises(UsageError):
        made.lens.run(float("nan"), made.soon(100))
    made.live(50)
    assert made.rotor == 3200.0


def test_homing_finds_the_reference(kind: str) -> None:
    made = open_rig(kind, referenced=False)
    report = made.lens.home(made.soon(10_000))
    assert LensFlag.REFERENCED in report.flags
    assert not made.moving
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=2.1)
    made.lens.move_to(Steps(4000), SPEED_SPS)
    made.live(500)
    assert made.rotor == pytest.approx(4000, abs=2.1)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_homing_past_its_deadline_stops_and_says_so(kind: str) -> None:
    made = open_rig(kind, referenced=False)
    with pytest.raises(LensError, match="deadline"):
        made.lens.home(made.soon(100))
    made.clock.pass_ms(made.dialect.hardest_stop_ms)
    assert not made.moving


def test_an_alarm_in_motion_is_a_fault_from_which_homing_recovers(kind: str) -> None:
    made = open_rig(kind)
    if not hasattr(made.board, "alarm_at"):
        pytest.skip("the controller has no alarm but its limit switches")
    made.lens.run(SPEED_SPS, made.soon(3000))
    made.live(40)
    made.board.alarm_at(made.clock.now_ns())
    with pytest.raises(LensError):
        made.live(200)
    made.live(made.dialect.hardest_stop_ms, lambda: None)
    assert not made.moving
    with pytest.raises(LensError):
        made.lens.run(SPEED_SPS, made.soon(100))
    made.lens.close()
    made.port.faults.disconnect_at_ns = None
    made.board.reset_at(made.clock.now_ns())
    made.plug_in()
    lens = made.open()
    with pytest.raises(LensError, match="home it first"):
        lens.move_to(Steps(1000), SPEED_SPS)
    lens.home(made.soon(10_000))
    lens.move_to(Steps(1000), SPEED_SPS)
    made.live(500)
    assert made.rotor == pytest.approx(1000, abs=2.1)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_stop_leaves_at_once_while_a_reply_is_due(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(3000))
    made.live(40)
    write, written = made.port.write, []
    made.port.write = lambda data: (written.append((made.clock.now_ns(), data)), write(data))  # type: ignore[method-assign]
    made.live_until(lambda: bool(written), 20)  # a question has just left
    asked, now = len(written), made.clock.now_ns()
    stopper = threading.Thread(target=made.lens.stop, args=(StopMode.RAMPED,))
    stopper.start()
    stopper.join()
    assert [at for at, _ in written[asked:]] == [now], "one write, at once"
    made.live(250)
    assert not made.moving
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=2.1)


def test_a_board_that_restarts_in_motion_is_a_fault_and_comes_back_unreferenced(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(3000))
    made.live(40)
    made.board.reset_at(made.clock.now_ns())
    with pytest.raises(LensError):
        made.live(700)
    made.clock.pass_ms(700)
    lens = made.open()
    with pytest.raises(LensError, match="home it first"):
        lens.move_to(Steps(100), SPEED_SPS)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_motor_that_ignores_stops_is_a_runaway(kind: str) -> None:
    made = open_rig(kind, ignore_stop=True)
    made.lens.run(SPEED_SPS / 4, made.soon(3000))
    made.live(40)
    made.lens.stop(StopMode.RAMPED if kind == "grbl" else StopMode.ABRUPT)
    with pytest.raises(LensError, match="still runs"):
        made.live(600)
    # its driver is switched off; GRBL's cannot be, and the motion ends at the target that it was given
    places = []
    for wait_ms in (3000 if kind == "grbl" else 100, 100):
        made.clock.pass_ms(wait_ms)
        made.port.advance_to(made.clock.now_ns())
        places.append(made.rotor)
    assert places[0] == places[1]


@needs("lie", "the controller reports no positions")
def test_an_implausible_position_is_never_believed_and_stops_the_motor_when_confirmed(kind: str) -> None:
    made = open_rig(kind)
    made.live(40)
    made.port.faults.garble = made.dialect.lie
    with pytest.raises(LensError, match="home it again"):
        made.live(100)
    assert made.rotor == 3200.0


def test_another_board_on_the_port_is_refused(kind: str) -> None:
    for other in KINDS:
        if other == kind:
            continue
        made = rig(other)
        with pytest.raises(LensError, match=r"answered|no answer|no GRBL"):
            CONTROLLERS[kind].open_lens({}, made.clock, made.port)
        with pytest.raises(LensError, match="closed"):
            made.port.write(b"x")
        assert made.rotor == 3200.0


def test_nobody_there_is_a_clear_error(kind: str) -> None:
    made = rig(kind)
    made.port.faults.drop_to_host = True
    with pytest.raises(LensError, match="check"):
        made.open()


def test_unknown_and_wrong_settings_are_refused(kind: str) -> None:
    made = rig(kind)
    with pytest.raises(ConfigError, match=r"lens\.sped: unknown key"):
        made.open(sped=3)
    with pytest.raises(ConfigError, match=r"lens\.um_per_step"):
        made.open(um_per_step="small")
    with pytest.raises(ConfigError):
        made.open(min_um=100.0, max_um=50.0)


@needs("remembers", "the controller does not remember where it is")
def test_closing_after_a_move_leaves_the_reference_to_the_next(kind: str) -> None:
    made = open_rig(kind)
    made.lens.move_to(Steps(3400), SPEED_SPS)
    made.live_until(lambda: bool(made.reports) and made.reports[-1].steps == pytest.approx(3400, abs=2), 500)
    made.reports.clear()
    made.live_until(lambda: bool(made.reports) and not made.reports[-1].moving, 200)
    made.lens.close()
    made.plug_in()
    made.open()
    made.live(20)
    assert LensFlag.REFERENCED in made.reports[-1].flags
    made.lens.move_to(Steps(3300), SPEED_SPS)
    made.live(300)
    assert made.rotor == pytest.approx(3300, abs=0.01)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_closing_stops_the_motor(kind: str) -> None:
    made = open_rig(kind)
    made.lens.run(SPEED_SPS, made.soon(3000))
    made.live(40)
    made.lens.close()
    made.lens.close()
    made.clock.pass_ms(100)
    assert not made.moving
