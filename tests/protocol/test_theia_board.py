"""The simulated Theia board against the manual's messages and against ``TheiaMCR``, which knows nothing of us."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from elpd_drivers.lenses import theia_wire as wire
from elpd_drivers.sim.aperture import StepperIris
from hypothesis import given
from hypothesis import strategies as st
from lens_rigs import SPEED_SPS, Rig, open_rig, rig, served
from TheiaMCR import MCRControl
from virtual import MonotonicClock

from elpd.errors import ConfigError, LensError, UsageError
from elpd.records import LensFlag, StopMode
from elpd.units import Steps

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from elpd.records import PositionEstimate
    from elpd.units import HostNs

FAST = {"max_speed_um_s": 4000.0}


def say(made: Rig, message: bytes, ms: float = 8.0) -> bytes:
    made.port.write(message)
    made.clock.pass_ms(ms)
    return made.port.read_available()


def ready(**config: Any) -> Rig:
    made = rig("theia", **config)
    assert say(made, wire.set_up(1, wire.Setup(False, True, 8000, 100, 12_800))) == b"\x63\x00\x0d"
    return made


# --- golden bytes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ours", "vendors"),
    [
        # written by TheiaMCR 3.5.1, byte for byte
        (wire.version(), "760d"),
        (wire.set_up(1, wire.Setup(False, True, 8000, 100, 1500)), "6301000001 1f40 0064 05dc 0d"),
        (wire.move(1, 50, 1000), "6601 0032 01 03e8 0d"),
        (wire.move(1, -13, 1200), "6201 000d 01 04b0 0d"),
        (wire.home(1, 0, 1200), "7301 0000 01 04b0 0d"),
        (wire.set_up(3, wire.Setup(False, False, 75, 10, 200)), "6303000000 004b 000a 00c8 0d"),
        (wire.move(3, 75, 100), "6603 004b 01 0064 0d"),
    ],
)
def test_commands_are_the_vendors(ours: bytes, vendors: str) -> None:
    assert ours == bytes.fromhex(vendors)


def test_replies_are_cut_by_their_lengths_and_found_behind_noise() -> None:
    reader = wire.ReplyReader()
    assert reader.feed(b"\x00\xffx\x74\x00\x0d\x76\x05\x0d") == [b"x\x74\x00\x0d"[1:]]
    assert reader.feed(b"\x01\x00\x00\x0d") == [b"\x76\x05\x0d\x01\x00\x00\x0d"]


@given(data=st.binary(max_size=80))
def test_no_bytes_upset_the_board(data: bytes) -> None:
    made = ready()
    made.port.write(data)
    made.clock.pass_ms(50)
    assert -64.0 <= made.rotor <= made.motor.travel_steps + 64.0


def test_a_move_is_answered_when_it_is_over_and_nothing_is_read_before() -> None:
    made = ready()
    assert say(made, wire.move(1, 1280, 12_800), 50) == b""
    assert say(made, wire.version(), 40) == b""
    assert made.moving
    made.clock.pass_ms(30)
    assert made.port.read_available() == b"\x74\x00\x0d"
    assert made.rotor == pytest.approx(4480)


@pytest.mark.parametrize(
    "message", [wire.move(2, 10, 500), wire.move(1, 10, 50), wire.move(1, 10, 20_000)], ids=["motor", "slow", "fast"]
)
def test_what_the_board_was_not_told_of_fails(message: bytes) -> None:
    made = ready()
    assert say(made, message) == b"\x74\x01\x0d"
    assert made.rotor == pytest.approx(3200)


# --- TheiaMCR drives it as if it were real -----------------------------------------------------------------------


@pytest.fixture
def vendor() -> Iterator[tuple[Any, Any, Any]]:
    server, motor = served("theia", MonotonicClock())
    control = MCRControl(server.port, logFiles=False)
    yield control, motor, server.wire.board
    control.close()
    server.close()


def test_theia_mcr_homes_it_and_moves_it(vendor: tuple[Any, Any, Any]) -> None:
    control, motor, _ = vendor
    clock = MonotonicClock()
    assert control.boardInitialized
    assert control.MCRBoard.readFWRevision() == "5.3.1.0.0"
    assert control.focusInit(steps=8000, pi=0, move=False)
    assert control.focus.readMotorSetup()[:7] == (True, 0, False, True, 8000, 100, 1500)
    control.focus.currentStep = 3200  # it cannot ask where the lens is
    assert control.focus.moveRel(-100, correctForBL=False) == 0
    assert motor.rotor_at(clock.now_ns()) == pytest.approx(3100)
    assert control.focus.writeMotorSetup(
        useWideFarStop=False, useTeleNearStop=True, maxSteps=8000, minSpeed=100, maxSpeed=20000
    )
    control.focus.homingSpeed = 16_000
    assert control.focus.home() == 0
    assert motor.rotor_at(clock.now_ns()) == pytest.approx(0, abs=1e-3)
    assert control.focus.moveRel(50) == 0
    assert motor.rotor_at(clock.now_ns()) == pytest.approx(50)


def test_theia_mcr_turns_its_iris(vendor: tuple[Any, Any, Any]) -> None:
    control, _, board = vendor
    iris = StepperIris(75, at_steps=30)
    board.add_iris(iris)
    assert control.irisInit(steps=75, move=True)  # closes by all of its way
    clock = MonotonicClock()
    assert float(iris.steps_at(clock.now_ns())) == 0.0
    assert control.iris.setMotorSpeed(200) == 0
    assert control.iris.moveRel(40, correctForBL=False) == 0
    assert float(iris.steps_at(clock.now_ns())) == 40.0
    assert control.iris.moveRel(-15, correctForBL=False) == 0
    assert float(iris.steps_at(clock.now_ns())) == 25.0


# --- our driver --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start_um", [0.0, 10.0, 2500.0])
def test_it_is_homed_from_everywhere(start_um: float) -> None:
    made = rig("theia", start_um=start_um)
    made.open(**FAST)
    report = made.lens.home(made.soon(20_000))
    assert LensFlag.REFERENCED in report.flags
    assert report.steps == 0.0
    assert made.rotor == pytest.approx(0.0, abs=1e-6)


def test_it_can_be_homed_again_from_wherever_it_is() -> None:
    made = open_rig("theia")
    report = made.lens.home(made.soon(20_000))
    assert report.steps == 0.0
    made.lens.move_to(Steps(500), SPEED_SPS)
    made.live(200)
    assert made.reports[-1].steps == 500
    assert made.rotor == pytest.approx(500)


def test_a_switch_at_the_upper_end_is_zero_and_the_travel_lies_below() -> None:
    made = rig("theia", switch_high=True)
    made.open(**FAST, switch="high", min_um=-2500.0, max_um=0.0)
    made.lens.home(made.soon(20_000))
    made.lens.move_to(Steps(-3000), SPEED_SPS)
    made.live(500)
    assert made.rotor == pytest.approx(5000)


def test_while_it_moves_it_takes_no_other_command_and_says_how_long() -> None:
    made = open_rig("theia")
    made.lens.move_to(Steps(6400), SPEED_SPS)
    made.live(50)
    for again in (
        lambda: made.lens.move_to(Steps(0), SPEED_SPS),
        lambda: made.lens.run(-SPEED_SPS, made.soon(100)),
        lambda: made.lens.home(made.soon(9000)),
    ):
        with pytest.raises(UsageError, match=r"moves for another 20\d ms"):
            again()
    made.live(300)
    assert made.rotor == pytest.approx(6400)


def test_a_stop_does_nothing_and_the_capabilities_say_so() -> None:
    made = open_rig("theia")
    assert not made.lens.capabilities.stop_on_command
    said: list[bytes] = []
    write = made.port.write
    made.port.write = lambda data: (said.append(data), write(data))[1]  # type: ignore[method-assign]
    made.lens.move_to(Steps(6400), SPEED_SPS)
    made.live(50)
    made.lens.stop(StopMode.ABRUPT)
    made.live(100)
    assert b"".join(said) == wire.move(1, 3200, 12_800), "not a byte while it moves"
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)
    made.live(200)
    assert made.rotor == pytest.approx(6400)
    assert made.reports[-1].steps == 6400


def test_where_it_is_on_its_way_is_known_as_well_as_it_says() -> None:
    covered: list[bool] = []
    for seed in range(5):
        choose = random.Random(seed)
        made = open_rig("theia", seed=seed)
        asked: list[HostNs] = []
        given: list[PositionEstimate] = []

        def ask(made: Rig = made, asked: list[HostNs] = asked, given: list[PositionEstimate] = given) -> None:
            made.poll()
            asked.append(made.clock.now_ns())
            given.append(made.lens.position_at(asked[-1]))

        for _ in range(6):
            made.lens.move_to(Steps(choose.randint(0, 8000)), choose.uniform(4000, SPEED_SPS))
            made.live(2100, ask)
        truth = made.truth(asked)
        assert -1e-6 <= truth.min() <= truth.max() <= 8000 + 1e-6
        on_its_way = np.abs(made.truth([when + 1000 for when in asked]) - truth) > 1e-4
        assert on_its_way.sum() > 500
        for estimates in (given, [made.lens.position_at(when) for when in asked]):
            gap = np.array([one.steps for one in estimates]) - truth
            sigma = np.array([one.sigma_steps for one in estimates])
            covered.extend((np.abs(gap) < 2 * sigma)[on_its_way])
    assert np.mean(covered) >= 0.95


def test_a_reply_that_never_comes_is_a_fault_and_the_move_is_not_sent_again() -> None:
    made = open_rig("theia")
    made.port.faults.drop_to_host = True
    made.lens.move_to(Steps(4480), SPEED_SPS)
    with pytest.raises(LensError, match=r"no reply to a move 20\d ms after it should have ended \(limit 200\)"):
        made.live(1000)
    assert made.rotor == pytest.approx(4480)
    with pytest.raises(LensError, match="no reply to a move"):
        made.lens.move_to(Steps(3200), SPEED_SPS)


def test_a_board_that_fell_silent_at_rest_is_a_fault() -> None:
    made = open_rig("theia")
    made.live(50)
    made.port.faults.drop_to_host = True
    with pytest.raises(LensError, match="no valid reply"):
        made.live(300)


def test_what_moves_when_it_is_opened_is_waited_for() -> None:
    made = ready()
    say(made, wire.move(1, 4000, 12_800))
    made.open(**FAST)
    assert made.rotor == pytest.approx(7200)
    with pytest.raises(LensError, match="home it first"):
        made.lens.move_to(Steps(10), SPEED_SPS)


def test_a_switch_that_is_not_there_is_said_after_a_bounded_search() -> None:
    made = rig("theia", switch_high=True)
    made.open(**FAST)
    with pytest.raises(LensError, match=r"did not find the switch; check lens\.switch"):
        made.lens.home(made.soon(60_000))
    assert not made.moving


def test_where_it_was_left_is_remembered_by_the_next_session(tmp_path: Path) -> None:
    settings = {**FAST, "position_file": str(tmp_path / "focus.json")}
    made = rig("theia")
    made.open(**settings)
    made.lens.home(made.soon(20_000))
    made.lens.move_to(Steps(2500), SPEED_SPS)
    made.live(300)
    made.lens.close()
    made.plug_in()
    made.open(**settings)
    made.live(50)
    assert made.reports[-1].steps == 2500
    assert LensFlag.REFERENCED in made.reports[-1].flags
    made.lens.move_to(Steps(100), SPEED_SPS)
    made.live(300)
    assert made.rotor == pytest.approx(100)


@pytest.mark.parametrize("ending", ["crash", "another lens", "another size", "garbage", "list"])
def test_what_may_be_wrong_is_not_remembered(tmp_path: Path, ending: str) -> None:
    file = tmp_path / "focus.json"
    settings: dict[str, Any] = {**FAST, "position_file": str(file)}
    made = rig("theia")
    made.open(**settings)
    made.lens.home(made.soon(20_000))
    if ending == "crash":
        made.lens.move_to(Steps(2500), SPEED_SPS)
        made.live(20)
        assert not file.exists(), "gone before the motor moves"
        made.clock.pass_ms(500)
    elif ending == "another lens":
        settings["motor"] = 2
    elif ending == "another size":
        settings["um_per_step"] = 0.5
    else:
        file.write_text("{" if ending == "garbage" else "[1]")
    made.lens.close()
    made.plug_in()
    made.open(**settings)
    with pytest.raises(LensError, match="home it first"):
        made.lens.move_to(Steps(100), 1000.0)


def test_a_move_that_ended_at_the_switch_is_not_remembered(tmp_path: Path) -> None:
    file = tmp_path / "focus.json"
    made = rig("theia")
    made.open(**FAST, position_file=str(file))
    made.lens.home(made.soon(20_000))
    made.lens.move_to(Steps(3000), SPEED_SPS)
    made.live(400)
    assert file.exists()
    made.motor.slip(made.clock.now_ns(), 1000.0)
    made.lens.move_to(Steps(0), SPEED_SPS)
    made.live(400)
    assert LensFlag.LIMIT in made.reports[-1].flags
    assert LensFlag.REFERENCED not in made.reports[-1].flags
    assert not file.exists()


def test_a_position_that_could_not_be_forgotten_keeps_the_motor_where_it_is(tmp_path: Path) -> None:
    file = tmp_path / "focus.json"
    made = rig("theia")
    made.open(**FAST, position_file=str(file))
    made.lens.home(made.soon(20_000))
    file.unlink()
    file.mkdir()
    with pytest.raises(LensError, match="cannot remove"):
        made.lens.move_to(Steps(3000), SPEED_SPS)
    made.clock.pass_ms(100)
    assert made.rotor == pytest.approx(0.0, abs=1e-6)


def test_a_place_where_nothing_can_be_remembered_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"lens\.position_file: cannot write into"):
        rig("theia").open(position_file=str(tmp_path / "nowhere" / "focus.json"))


def test_older_firmware_is_refused_with_what_was_seen() -> None:
    made = rig("theia", version=(4, 9, 0, 0, 0))
    with pytest.raises(LensError, match=r"firmware 4\.9\.0\.0\.0 answered.*5 or newer"):
        made.open()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"motor": 3}, "motor is 1"),
        ({"switch": "left"}, "switch is"),
        ({"switch": "high"}, "must begin"),
        ({"min_um": 10.0}, "must begin"),
        ({"max_um": 30_000.0}, "must not exceed 65535"),
        ({"max_speed_um_s": 10.0}, "at least 100"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        rig("theia").open(**settings)
