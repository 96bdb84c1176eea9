"""The simulated SCF4 against the maker's page and examples, and what its driver finds out."""

from __future__ import annotations

from typing import Any

import pytest
from elpd_drivers.lenses import scf4_wire as wire
from hypothesis import given
from hypothesis import strategies as st
from lens_rigs import SPEED_SPS, Rig, open_rig, rig
from structlog.testing import capture_logs

from elpd.errors import ConfigError, LensError
from elpd.records import LensFlag, StopMode
from elpd.units import Steps

UNKNOWN: dict[str, Any] = {"trust_position": False, "relative": "", "speed_scale": None}


def say(made: Rig, line: str, ms: float = 8.0) -> str:
    made.port.write(line.encode("ascii") + b"\n")
    made.clock.pass_ms(ms)
    return made.port.read_available().decode("ascii").strip()


def homed(seed: int = 1, settings: dict[str, Any] | None = None, **config: Any) -> Rig:
    """Home a lens of whose board nothing is known beforehand."""
    made = rig("scf4", seed=seed, **config)
    made.open(**(UNKNOWN | (settings or {})))
    made.lens.home(made.soon(20_000))
    return made


# --- the lines ---------------------------------------------------------------------------------------------------


def test_replies_are_read_as_the_maker_has_them() -> None:
    version = "EVB.1.0.2, SCF4-M RevB, Kurokesu, 5DDFF39-3739584E-xxxxxxxx"
    assert wire.parse_version(version) == ("EVB.1.0.2", "SCF4-M RevB")
    assert wire.parse_status("32000, 0, 65535, 1, 0, 0, 1, 0, 0") == wire.Status(32_000, interrupter=True, moving=True)
    for line in (
        "OK",
        "1, 2, 3",
        "65536, 0, 0, 0, 0, 0, 0, 0, 0",
        "1, 0, 0, 2, 0, 0, 0, 0, 0",
        "-1, 0, 0, 0, 0, 0, 0, 0, 0",
    ):
        assert wire.parse_status(line) is None


@given(true=st.integers(-200_000, 200_000), gone=st.integers(-32_768, 32_767))
def test_a_count_is_unwrapped_to_the_nearest(true: int, gone: int) -> None:
    assert wire.unwrapped((true + gone) % 65_536, true) == true + gone


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("$S", "EVB.1.0.2, SCF4-M RevB, Kurokesu, 5DDFF39-3739584E-43204208"),
        ("!1", "35200, 0, 0, 0, 0, 0, 0, 0, 0"),
        ("M240 A600 B600 C600", "OK"),
        ("M232 A400 B400 C400 E700 F700 G700", "OK"),
        ("G92 A7", "OK"),
        ("G1 A100", "ERROR COMMAND"),
        ("G0 A70000", "ERROR RANGE"),
        ("G0 A!", "ERROR PARAMETER"),
    ],
)
def test_each_line_has_one_reply(line: str, answer: str) -> None:
    assert say(rig("scf4"), line) == answer


@given(data=st.binary(max_size=80))
def test_no_bytes_upset_the_board(data: bytes) -> None:
    made = rig("scf4")
    made.port.write(data)
    made.clock.pass_ms(50)
    assert -64.0 <= made.rotor <= made.motor.travel_steps + 64.0


def test_a_delay_blocks_even_a_stop() -> None:
    made = rig("scf4")
    say(made, "G0 A4000")
    assert say(made, "G4 P100") == ""
    assert say(made, "M0 A") == ""
    assert made.moving
    made.clock.pass_ms(100)
    assert made.port.read_available() == b"OK\r\nOK\r\n"
    assert not made.moving


def test_the_counter_wraps_and_the_motor_does_not_care() -> None:
    made = rig("scf4")
    say(made, "G92 A65500")
    say(made, "G0 A100", 50)
    assert say(made, "!1").startswith("64, ")
    assert made.rotor == pytest.approx(3300)


# --- what homing finds out ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("relative", ["G90", "G91"])
@pytest.mark.parametrize("stops_at_edge", [False, True])
@pytest.mark.parametrize("speed_scale", [7_680_000.0, 5_100_000.0])
def test_whatever_the_firmware_means_homing_finds_out(relative: str, stops_at_edge: bool, speed_scale: float) -> None:  # noqa: FBT001
    slow = {"max_speed_um_s": 2000.0}
    made = homed(2, slow, relative=relative, stops_at_edge=stops_at_edge, speed_scale=speed_scale)
    for target in (4000, 100, 7990):
        made.lens.move_to(Steps(target), SPEED_SPS / 2)
        made.live(1500)
        assert made.rotor == pytest.approx(target, abs=2.1)
    made.lens.run(-SPEED_SPS / 2, made.soon(600))
    made.live(400)
    assert made.moving
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)


def test_a_host_that_looks_seldom_puts_several_moves_together() -> None:
    made = rig("scf4", referenced=False)
    look, seldom = made.port.read_available, iter(range(40, 10_000, 7))

    def busy() -> bytes:
        if abs(made.motor.velocity_at(made.clock.now_ns())) > SPEED_SPS / 4:
            made.clock.pass_ms(12 + next(seldom) % 23)
        return look()

    made.port.read_available = busy  # type: ignore[method-assign]
    made.open(**UNKNOWN)
    with capture_logs() as logs:
        made.lens.home(made.soon(60_000))
    told = next(log for log in logs if "speed_scale" in log)
    assert told["speed_scale"] == pytest.approx(7_680_000, rel=0.01)


def test_what_homing_found_out_is_told_and_lets_the_next_session_do_without() -> None:
    with capture_logs() as told:
        made = homed(speed_scale=5_100_000.0, settings={"max_speed_um_s": 2000.0})
    found = {key: told[0][key] for key in UNKNOWN}
    assert found["speed_scale"] == pytest.approx(5_100_000.0, rel=0.003)
    made.lens.close()
    made.plug_in()
    made.open(max_speed_um_s=2000.0, **found)
    made.lens.move_to(Steps(2000), SPEED_SPS / 2)
    made.live(600)
    assert made.rotor == pytest.approx(2000, abs=2.1)


@pytest.mark.parametrize("start_um", [0.0, 3.0, 1000.0, 2500.0])
def test_it_is_homed_from_everywhere(start_um: float) -> None:
    made = rig("scf4", start_um=start_um)
    made.open(**UNKNOWN)
    report = made.lens.home(made.soon(20_000))
    assert LensFlag.REFERENCED in report.flags
    assert report.steps == 0.0, "inside the limits, where a later session believes it"
    assert made.rotor == pytest.approx(0.0, abs=2.1)


def test_an_edge_in_the_middle_of_the_travel_is_zero() -> None:
    for start_um in (300.0, 2000.0):
        made = rig("scf4", edge_um=1000.0, start_um=start_um)
        made.open(**UNKNOWN, min_um=-900.0, max_um=1400.0)
        made.lens.home(made.soon(20_000))
        made.lens.move_to(Steps(-2000), SPEED_SPS)
        made.live(400)
        assert made.rotor == pytest.approx(3200 - 2000, abs=2.1)


def test_positions_stay_right_where_the_counter_wraps() -> None:
    made = rig("scf4", edge_um=2450.0, start_um=2400.0, um_per_step=0.05)
    made.open(**UNKNOWN, um_per_step=0.05, min_um=-2000.0, max_um=40.0, max_speed_um_s=640.0)
    made.lens.home(made.soon(60_000))
    made.lens.move_to(Steps(-36_000), SPEED_SPS)
    made.live(3500)
    assert int(say(made, "!1").split(",")[0]) > 60_000
    assert made.reports[-1].steps == -36_000
    assert made.rotor == pytest.approx(49_000 - 36_000, abs=2.1)


@pytest.mark.parametrize(
    ("settings", "config", "words"),
    [
        ({"relative": "G90"}, {}, "G91 is relative on this board"),
        ({"speed_scale": 7_000_000.0, "max_speed_um_s": 2000.0}, {}, "correct lens.speed_scale"),
        ({"pi_above": 1}, {}, "the photo-interrupter did not change"),
        ({"max_um": 300.0}, {}, "the photo-interrupter did not change"),
        ({}, {"relative": "G89"}, "one should go 8"),
    ],
)
def test_what_contradicts_the_board_is_refused_with_the_numbers(
    settings: dict[str, Any], config: dict[str, Any], words: str
) -> None:
    made = rig("scf4", **config)
    made.open(**(UNKNOWN | settings))
    with pytest.raises(LensError, match=words):
        made.lens.home(made.soon(20_000))
    made.clock.pass_ms(5)
    assert not made.moving


def test_codes_that_are_no_periods_are_refused() -> None:
    made = rig("scf4")
    made.open(**UNKNOWN)
    obey = made.board._obey
    codes = {"M240 A600": "M240 A600", "M240 A1200": "M240 A300"}
    made.board._obey = lambda line, at_ns: obey(codes.get(line, line), at_ns)
    with pytest.raises(LensError, match="the codes are no periods"):
        made.lens.home(made.soon(20_000))


def test_a_stop_while_homing_ends_it() -> None:
    made = rig("scf4")
    made.open(**UNKNOWN)
    write = made.port.write

    def write_and_stop(data: bytes) -> None:
        write(data)
        if data == b"M231 A\n":
            made.port.write = write  # type: ignore[method-assign]
            made.lens.stop(StopMode.ABRUPT)

    made.port.write = write_and_stop  # type: ignore[method-assign]
    with pytest.raises(LensError, match="homing was stopped"):
        made.lens.home(made.soon(20_000))
    made.clock.pass_ms(5)
    assert not made.moving


def test_the_light_burns_only_while_homing() -> None:
    made = rig("scf4")
    made.open(**UNKNOWN)
    said: list[bytes] = []
    write = made.port.write
    made.port.write = lambda data: (said.append(data), write(data))[1]  # type: ignore[method-assign]
    made.lens.home(made.soon(20_000))
    made.live(20)
    assert said.count(b"M238\n") == said.count(b"M239\n") == 1
    assert not made.board._led
    assert not any(data.startswith(b"G4") for data in said)


# --- what is refused, and what is known of stops -----------------------------------------------------------------


def test_other_firmware_is_refused_with_what_was_seen() -> None:
    made = rig("scf4", version="EVB.2.0.0, SCF4-M RevC, Kurokesu, 1-2-3")
    with pytest.raises(LensError, match=r"SCF4-M RevC with firmware EVB\.2\.0\.0 answered"):
        made.open()


def test_before_it_is_homed_nothing_moves() -> None:
    made = rig("scf4", referenced=False)
    made.open(**UNKNOWN)
    with pytest.raises(LensError, match="home it first"):
        made.lens.run(SPEED_SPS, made.soon(100))
    made.live(50)
    assert made.rotor == 3200.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"trust_position": True, "relative": "", "speed_scale": None}, "trust_position needs"),
        ({"relative": "G92"}, "relative is G90 or G91"),
        ({"pi_above": 2}, "pi_above is 0 or 1"),
        ({"max_um": 30_000.0}, "more than the 65535"),
        ({"min_um": 10.0}, "does not contain 0"),
        ({"max_speed_um_s": 12_000.0}, "the fastest is 9600"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        rig("scf4").open(**settings)


def test_a_stop_that_ramps_is_modelled_with_its_ramp() -> None:
    ramp = {"acceleration_um_s2": 50_000.0}
    made = rig("scf4", **ramp)
    made.open(**ramp)
    assert not made.lens.capabilities.abrupt_stop
    made.lens.run(SPEED_SPS, made.soon(3000))
    made.live(200)
    made.lens.stop(StopMode.RAMPED)
    made.live(40)
    assert made.moving
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)


def test_an_earlier_homing_is_trusted_only_where_the_counter_can_come_from_it() -> None:
    made = open_rig("scf4")
    made.live(20)
    assert LensFlag.REFERENCED in made.reports[-1].flags
    made.lens.close()
    made.board.reset_at(made.clock.now_ns())
    made.plug_in()
    made.open()
    made.live(20)
    assert LensFlag.REFERENCED not in made.reports[-1].flags
