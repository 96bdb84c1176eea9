"""The simulated GRBL against what real firmware was seen to do."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from elpd_drivers.lenses.grbl_lines import jog_line, parse_status
from elpd_drivers.lenses.lines import LineReader
from elpd_drivers.sim.boards import grbl_text
from hypothesis import given
from hypothesis import strategies as st
from lens_rigs import Rig, open_rig, rig

from elpd.errors import LensError
from elpd.records import LensFlag, StopMode
from elpd.units import Steps


def say(made: Rig, data: bytes, ms: float = 20.0) -> str:
    """Send, let time pass, and return what was printed."""
    made.port.write(data)
    made.clock.pass_ms(ms)
    return made.port.read_available().decode("ascii")


@pytest.fixture
def made() -> Rig:
    return rig("grbl")


def test_it_boots_locked_with_its_banner() -> None:
    fresh = rig("grbl", referenced=False)
    assert say(fresh, b"") == "\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
    assert say(fresh, b"G1X1F100\n") == "error:9\r\n"
    assert say(fresh, b"$X\n") == "[MSG:Caution: Unlocked]\r\nok\r\n"


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"$J=X-1\n", "error:22"),
        (b"$J=X-1F-3\n", "error:4"),
        (b"$J=X9F100\n", "error:15"),
        (b"$J=G2X1F3\n", "error:16"),
        (b"$J=F100\n", "error:16"),
        (b"$J=G91X0.1F100.5.5\n", "error:1"),
        (b"$J=G91X-F100\n", "error:2"),
        (b"G999\n", "error:20"),
        (b"+1\n", "error:1"),
        (b"$Q\n", "error:3"),
        (b"$999=1\n", "error:3"),
        (b"$110=-1\n", "error:4"),
        (b"G4" + b" " * 10 + b"\n", "error:20"),
        (b"\n", "ok"),
        (b"$\n", grbl_text.HELP + "\r\nok"),
        (b"$I\n", "[VER:1.1h.20190830:]\r\n[OPT:V,15,128]\r\nok"),
        (b"$G\n", "[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]\r\nok"),
    ],
)
def test_lines_are_answered_as_by_the_firmware(made: Rig, line: bytes, answer: str) -> None:
    assert say(made, line) == answer + "\r\n"
    assert not made.moving


def test_homing_must_be_on_for_what_needs_it(made: Rig) -> None:
    assert say(made, b"$22=0\n$H\n$20=1\n") == "ok\r\nerror:5\r\nerror:10\r\n"


def test_a_line_too_long_overflows_the_receive_buffer(made: Rig) -> None:
    assert say(made, b"X" * 200 + b"\n", 40) == "error:11\r\n"


def test_status_reports_look_like_grbls(made: Rig) -> None:
    assert say(made, b"?") == "<Idle|MPos:-1.500,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>\r\n"
    assert say(made, b"?") == "<Idle|MPos:-1.500,0.000,0.000|FS:0,0|Ov:100,100,100>\r\n"
    assert say(made, b"?") == "<Idle|MPos:-1.500,0.000,0.000|FS:0,0>\r\n"
    assert say(made, b"?" * 9, 30).count("<") < 9, "a flag that is up is up"


def test_a_status_round_trip_takes_about_as_long_as_measured(made: Rig) -> None:
    say(made, b"?")
    begun = made.clock.now_ns()
    made.port.write(b"?")
    got = b""
    while b"\n" not in got:
        made.clock.pass_ms(0.1)
        got += made.port.read_available()
    assert 3.5e6 < made.clock.now_ns() - begun < 6.5e6


def test_ok_says_planned_and_a_second_jog_is_queued(made: Rig) -> None:
    assert say(made, b"$J=G91X0.1F240\n$J=G91X-0.1F240\n", 12) == "ok\r\nok\r\n"
    assert made.moving
    assert "<Jog|" in say(made, b"?", 8)
    assert say(made, b"G1X-1F100\n") == "error:9\r\n"
    made.clock.pass_ms(300)
    assert made.rotor == 3200.0


def onset_ms(made: Rig, stop: bytes) -> float:
    """Return the time from the byte (complete at the board) to the first slower step."""
    sent = made.clock.now_ns() + made.board.byte_ns
    made.port.write(stop)
    made.clock.pass_ms(120)
    times = np.arange(sent, sent + 100_000_000, 50_000, dtype=np.int64)
    speed = np.abs(np.diff(made.motor.motor_steps(times))) / 50e-6
    return float(times[np.argmax(speed < 12_800 * 0.999)] - sent) / 1e6


@pytest.mark.parametrize("stop", [b"\x85", b"!"])
def test_a_stop_bites_after_what_is_prepared_has_run(stop: bytes) -> None:
    onsets = []
    for phase in range(20):
        made = rig("grbl", seed=phase)
        say(made, b"$J=G91X1F240\n", 60 + 0.5 * phase)
        onsets.append(onset_ms(made, stop))
        assert "<Idle|" in say(made, b"?"), "a jog that is stopped is over"
    print(f"\nonset of {stop!r}: {min(onsets):.1f} to {max(onsets):.1f} ms")  # noqa: T201  (worth seeing)
    assert min(onsets) >= 39.9
    assert max(onsets) <= 50.5
    assert max(onsets) - min(onsets) > 5.0, "it depends on the phase of the running segment"


def test_a_reset_bites_at_once_and_loses_the_position(made: Rig) -> None:
    say(made, b"$J=G91X1F240\n", 60)
    assert onset_ms(made, b"\x18") < 0.2
    assert say(made, b"?$I\n", 300) == "ALARM:3\r\n", "it sleeps over its alarm"
    made.clock.pass_ms(300)
    printed = made.port.read_available().decode()
    assert printed == "\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"


def test_a_reset_at_rest_keeps_the_position(made: Rig) -> None:
    assert say(made, b"\x18", 40) == "\r\nGrbl 1.1h ['$' for help]\r\n"
    assert say(made, b"?").startswith("<Idle|MPos:-1.500")


def test_feed_reads_zero_while_the_axis_still_steps(made: Rig) -> None:
    say(made, b"$J=G91X0.4F240\n", 60)
    made.port.write(b"\x85")
    made.clock.pass_ms(45)
    report = say(made, b"?", 7)
    assert "FS:0,0" in report
    assert "<Jog|" in report


def test_a_cancel_before_the_jog_is_planned_does_nothing(made: Rig) -> None:
    made.port.write(b"$J=G91X0.5F240\n")
    made.clock.pass_ms(1.0)
    made.port.write(b"\x85")
    made.clock.pass_ms(100)
    assert made.moving, "the race that real firmware has"


def cancelled_in_its_last_moment(when_ms: float) -> str:
    made = rig("grbl", real_time_us=(3000, 3000))
    say(made, b"$J=G91X0.1F240\n", when_ms)
    say(made, b"\x85", 100)
    assert made.board.stepper.state == "Idle"
    stuck = say(made, b"$J=G91X0.1F240\n", 100)
    freed = say(made, b"~", 100)
    return stuck + "/" + freed


def test_a_cancel_in_a_jogs_last_moment_holds_the_board_until_a_resume() -> None:
    answers = [cancelled_in_its_last_moment(when_ms) for when_ms in np.arange(5.0, 90.0, 1.0)]
    assert set(answers) == {"ok\r\n/", "/ok\r\n"}
    assert 1 <= answers.count("/ok\r\n") <= 4


@pytest.mark.parametrize("offset", range(20))
def test_our_driver_frees_a_board_that_a_late_stop_holds(offset: int) -> None:
    made = open_rig("grbl", real_time_us=(3000, 3000))
    made.lens.move_to(Steps(3520), 12_800.0)
    made.live(30.0 + 2 * offset)
    made.lens.stop(StopMode.RAMPED)
    made.live(300)
    made.lens.move_to(Steps(3000), 12_800.0)
    made.live(300)
    assert made.rotor == pytest.approx(3000, abs=1)
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(3000, abs=2)


def test_a_board_that_another_session_left_in_a_hold_is_reset_by_the_next() -> None:
    made = rig("grbl", real_time_us=(3000, 3000))
    stuck = next(ms for ms in np.arange(5.0, 90.0, 1.0) if cancelled_in_its_last_moment(ms) == "/ok\r\n")
    say(made, b"$J=G91X0.1F240\n", stuck)
    say(made, b"\x85", 100)
    before = made.rotor
    made.port.write(b"$J=G91X0.5F240\n")
    made.open()
    made.live(300)
    assert made.rotor == before, "what the other session still wanted is not done"
    assert LensFlag.POSITION_UNCERTAIN in made.reports[-1].flags


def test_cancel_and_a_new_jog_in_one_write_reverse(made: Rig) -> None:
    say(made, b"$J=G91X1F240\n", 60)
    printed = say(made, b"\x85$J=G91X-1F240\n", 120)
    assert printed == "ok\r\n"
    assert made.motor.velocity_at(made.clock.now_ns()) == pytest.approx(-12_800)


def test_a_feed_hold_of_a_g1_resumes(made: Rig) -> None:
    say(made, b"G91G1X0.5F240\n", 60)
    made.port.write(b"!")
    made.clock.pass_ms(10)
    assert "<Hold:1|" in say(made, b"?", 8)
    made.clock.pass_ms(100)
    assert "<Hold:0|" in say(made, b"?", 8)
    made.port.write(b"~")
    made.clock.pass_ms(300)
    assert made.rotor == 3200 + 1600


def test_after_a_hard_limit_there_is_silence_until_a_reset(made: Rig) -> None:
    say(made, b"$20=0\n")
    printed = say(made, b"$J=G91X-2F240\n", 600)
    assert printed == "ok\r\nALARM:1\r\n"
    assert say(made, b"\x18", 400) == "[MSG:Reset to continue]\r\n", "so soon a reset is lost"
    printed += "[MSG:Reset to continue]\r\n"
    assert printed == "ok\r\nALARM:1\r\n[MSG:Reset to continue]\r\n"
    assert say(made, b"?$X\n$I\n?", 200) == ""
    assert "Grbl 1.1h" in say(made, b"\x18", 40)
    assert say(made, b"$X\n") == "[MSG:Caution: Unlocked]\r\nok\r\n"


def test_homing_ends_beside_the_switch() -> None:
    made = rig("grbl", referenced=False)
    made.clock.pass_ms(10)
    made.port.read_available()
    say(made, b"$H\n", 10)
    assert say(made, b"?", 20) == "", "GRBL says nothing before homing is over"
    made.clock.pass_ms(3000)
    assert made.port.read_available().endswith(b">\r\nok\r\n")
    assert "<Idle|MPos:-2.450" in say(made, b"?")
    assert made.rotor == pytest.approx(160, abs=2)


def test_our_driver_recovers_from_a_hard_limit_by_reset_and_homing() -> None:
    made = open_rig("grbl")
    made.motor.slip(made.clock.now_ns(), 600.0)
    made.lens.run(-12_800.0, made.soon(3000))
    with pytest.raises(LensError, match="hard limit"):
        made.live(1000)
    lens = made.open()
    with pytest.raises(LensError, match="home it first"):
        lens.move_to(100, 12_800.0)
    assert LensFlag.REFERENCED in lens.home(made.soon(9000)).flags


def test_a_board_dead_after_an_alarm_is_woken_by_a_reset(made: Rig) -> None:
    say(made, b"$20=0\n$J=G91X-2F240\n", 700)
    lens = made.open(connect_ms=400.0)
    made.live(30)
    assert LensFlag.ALARM in made.reports[-1].flags
    assert LensFlag.REFERENCED in lens.home(made.soon(9000)).flags


def test_a_jog_in_flight_when_the_driver_opens_is_stopped(made: Rig) -> None:
    say(made, b"$J=G91X1F120\n", 60)
    made.open()
    assert not made.moving


def test_settings_that_contradict_the_config_are_refused(made: Rig) -> None:
    with pytest.raises(Exception, match=r"\$100"):
        made.open(um_per_step=0.625)


def test_an_abrupt_stop_needs_homing_afterwards() -> None:
    made = open_rig("grbl")
    made.lens.run(12_800.0, made.soon(1000))
    made.live(60)
    made.lens.stop(StopMode.ABRUPT)
    made.live(100)
    with pytest.raises(LensError, match="home it first"):
        made.lens.run(12_800.0, made.soon(1000))
    assert LensFlag.REFERENCED in made.lens.home(made.soon(9000)).flags


def test_who_opens_the_board_next_knows_that_it_was_homed_until_a_reset() -> None:
    made = open_rig("grbl", referenced=False)
    made.lens.home(made.soon(9000))
    made.lens.close()
    made.plug_in()
    made.open(trust_position=False)
    made.lens.move_to(Steps(1000), 12_800.0)
    made.live(500)
    assert made.rotor == pytest.approx(1000, abs=2.1)
    made.lens.close()
    made.board.reset_at(made.clock.now_ns())
    made.plug_in()
    made.open(trust_position=False)
    with pytest.raises(LensError, match="home it first"):
        made.lens.move_to(Steps(1000), 12_800.0)


def test_idle_alone_is_no_reference(made: Rig) -> None:
    made.open(trust_position=False)
    with pytest.raises(LensError, match="home it first"):
        made.lens.move_to(Steps(1000), 12_800.0)


@pytest.mark.parametrize(("firmware", "onset"), [("grbl", 45), ("grblhal", 16.5), ("fluidnc", 45), ("sce2", 90)])
def test_every_dialect_homes_moves_reverses_and_stops(firmware: str, onset: float) -> None:
    made = open_rig("grbl", referenced=False, firmware=firmware)
    assert made.lens.capabilities.stop_onset_ms == onset
    assert LensFlag.REFERENCED in made.lens.home(made.soon(9000)).flags
    made.lens.move_to(Steps(4000), 12_800.0)
    made.live(600)
    assert made.rotor == pytest.approx(4000, abs=2.1)
    made.lens.run(12_800.0, made.soon(2000))
    made.live(80)
    made.lens.run(-12_800.0, made.soon(2000))
    made.live(300)
    assert made.motor.velocity_at(made.clock.now_ns()) == pytest.approx(-12_800)
    sent = made.clock.now_ns()
    made.lens.stop(StopMode.RAMPED)
    made.live(300)
    assert not made.moving
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=2.1)
    still_ms = onset - 12 if onset > 20 else 8
    sped = made.motor.motor_steps(np.array([sent, sent + round(still_ms * 1e6)], dtype=np.int64))
    assert sped[0] - sped[1] == pytest.approx(12.8 * still_ms, rel=0.02), "nothing bites before what is prepared"


@pytest.mark.parametrize("version", ["[VER:0.9j.20160303:]", "[VER:2.0.Marlin:]"])
def test_unknown_firmware_is_refused_with_what_it_said(made: Rig, version: str) -> None:
    made.port.faults.garble = lambda data: data.replace(b"[VER:1.1h.20190830:]", version.encode())
    with pytest.raises(LensError, match=r"grblHAL, GRBL.*" + version[5:9]):
        made.open()


def test_a_board_with_an_unknown_firmware_is_refused() -> None:
    with pytest.raises(ValueError, match="known are grbl"):
        rig("grbl", firmware="marlin")


def test_the_travel_ends_before_a_homing_switch_that_is_a_hard_limit(made: Rig) -> None:
    assert made.open().limits.min_steps == 80
    made.lens.close()
    made.plug_in()
    say(made, b"$21=0\n")
    assert made.open().limits.min_steps == 0


def test_a_motion_that_the_board_holds_up_goes_on_from_where_it_is() -> None:
    made = open_rig("grbl")
    made.lens.run(3_200.0, made.soon(3000))
    made.live(60)
    made.board.stepper.offset -= 160  # 50 ms of its way are missing from now on
    made.live(200)
    estimate = made.lens.position_at(made.clock.now_ns()).steps
    assert estimate == pytest.approx(made.rotor - 160, abs=8)
    assert made.moving


# --- codecs ------------------------------------------------------------------------------------------------------


@given(
    state=st.sampled_from(["Idle", "Jog", "Run", "Hold:0", "Hold:1", "Alarm", "Home"]),
    micrometres=st.integers(-9_999_999, 9_999_999),
    feed=st.floats(0, 99_999),
    pins=st.sampled_from(["", "X", "XY"]),
    wco=st.booleans(),
)
def test_a_status_report_comes_back(state: str, micrometres: int, feed: float, pins: str, wco: bool) -> None:  # noqa: FBT001
    line = grbl_text.status_report(state, micrometres / 1000, feed, pins=pins, wco=wco)
    status = parse_status(line)
    assert status is not None
    assert (status.state, round(status.x_mm * 1000), status.pins) == (state, micrometres, pins)


@given(line=st.text(st.characters(max_codepoint=127), max_size=80), cut=st.integers(0, 60))
def test_only_whole_reports_are_read(line: str, cut: int) -> None:
    whole = "<Idle|MPos:-1.500,0.000,0.000|FS:0,0>"
    parse_status(line)
    if cut < len(whole):
        assert parse_status(whole[:cut]) is None


@given(steps=st.integers(-8000, 0))
def test_a_jog_names_its_step_exactly(steps: int) -> None:
    line = jog_line(steps / 3200, 240.0).decode()
    words = grbl_text.parse_motion(line[3:].strip(), jog=True)
    assert words.x_mm is not None
    assert round(words.x_mm * 3200) == steps
    assert words.relative is False
    assert words.machine


@given(data=st.binary(max_size=80), cuts=st.lists(st.integers(0, 80), max_size=4))
def test_lines_do_not_depend_on_how_they_arrive(data: bytes, cuts: list[int]) -> None:
    whole = [line for line, _ in LineReader().feed(data)]
    reader, edges = LineReader(), [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    parts = [line for a, b in pairwise(edges) for line, _ in reader.feed(data[a:b])]
    assert parts == whole


@given(data=st.binary(max_size=64))
def test_no_bytes_upset_the_board(data: bytes) -> None:
    made = rig("grbl")
    made.port.write(data)
    made.clock.pass_ms(60)
    assert -64.0 <= made.rotor <= made.motor.travel_steps + 64.0


# --- what the others of the family say ---------------------------------------------------------------------------


def boot(firmware: str) -> tuple[Rig, str]:
    fresh = rig("grbl", referenced=False, firmware=firmware)
    return fresh, say(fresh, b"", 60)


def test_grblhal_tells_its_story() -> None:
    made, greeting = boot("grblhal")
    assert greeting == "\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
    assert "[FIRMWARE:grblHAL]" in say(made, b"$I\n")
    assert say(made, b"$HX\n") == "error:5\r\n", "one axis alone takes a flag of $22"
    say(made, b"$22=3\n$HX\n", 60)
    assert "<Home|" in say(made, b"?"), "it tells of itself while homing"
    made.clock.pass_ms(3000)
    assert made.port.read_available().endswith(b"ok\r\n")
    assert "|H:1,1>" in say(made, b"\x87")
    say(made, b"$20=0\n$J=G91X-2F240\n", 400)
    assert "<Alarm:1|" in say(made, b"?"), "it answers after a hard limit"
    assert say(made, b"$H\n$X\n") == "error:79\r\nerror:79\r\n", "but does nothing before a reset"
    assert "GrblHAL 1.1f" in say(made, b"\x18", 60)
    assert "H:0,0" in say(made, b"\x87")


def test_our_driver_homes_grblhal_as_its_settings_allow_and_asks_it_whether_it_is_homed() -> None:
    made = rig("grbl", referenced=False, firmware="grblhal")
    lens = made.open(trust_position=False)
    assert (lens.limits.min_steps, lens.limits.max_steps) == (160, 7840), "a pull-off at either end"
    assert LensFlag.REFERENCED in lens.home(made.soon(9000)).flags
    lens.move_to(Steps(160), 12_800.0)
    made.live(400)
    assert made.rotor == pytest.approx(160, abs=2.1), "as far as it may"
    lens.close()
    made.plug_in()
    made.open(trust_position=False).move_to(Steps(1000), 12_800.0)
    made.live(400)
    assert made.rotor == pytest.approx(1000, abs=2.1)


def test_that_grblhal_calls_itself_homed_is_not_believed_after_a_reset_by_who_had_lost_trust() -> None:
    made = rig("grbl", referenced=False, firmware="grblhal")
    made.open(trust_position=False).home(made.soon(9000))
    made.port.write(b"\x18")  # what the driver sends with every fault
    made.live(100, lambda: None)
    made.plug_in()
    assert "H:1,1" in say(made, b"\x87"), "the board still says so"
    with pytest.raises(LensError, match="home it first"):
        made.open(trust_position=False).move_to(Steps(1000), 12_800.0)


def test_after_a_hard_limit_our_driver_resets_grblhal_before_it_homes() -> None:
    made = open_rig("grbl", firmware="grblhal")
    made.motor.slip(made.clock.now_ns(), 600.0)
    made.lens.run(-12_800.0, made.soon(3000))
    with pytest.raises(LensError, match="hard limit"):
        made.live(1000)
    made.plug_in()
    lens = made.open()
    assert LensFlag.REFERENCED in lens.home(made.soon(9000)).flags


def test_an_origin_at_the_place_of_homing_is_refused() -> None:
    made = rig("grbl", firmware="grblhal")
    say(made, b"$22=9\n")
    with pytest.raises(Exception, match=r"\$22 is 9.*set \$22=1"):
        made.open()


def test_fluidnc_tells_its_story() -> None:
    made, greeting = boot("fluidnc")
    assert greeting == "\r\nGrbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
    assert "[VER:3.7 FluidNC v3.7.8:]" in say(made, b"$I\n")
    say(made, b"$HX\n", 30)
    assert "<Home|" in say(made, b"?")
    made.clock.pass_ms(3000)
    assert made.port.read_available().endswith(b"ok\r\n")
    assert "<Idle|MPos:-2.450,0.000,0.000|" in say(made, b"?")
    assert say(made, b"$J=X9F100\n") == "error:15\r\n"


def test_sce2_tells_its_story() -> None:
    made, greeting = boot("sce2")
    assert greeting == "\r\nGrbl 1.1f-SCE2 ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
    assert "[VER:1.1f-SCE2.20211130:L086,6ZG-BEG19]" in say(made, b"$I\n")
    assert say(made, b"$HX\n", 40) == ""
    made.clock.pass_ms(3000)
    assert made.port.read_available().endswith(b"ok\r\n")
    assert "<Idle|MPos:-2.450,0.000,0.000,0.000|" in say(made, b"?"), "four axes"
    assert say(made, b"M114P1\nM114P0\n", 40) == "ok\r\nok\r\n", "its iris"


@pytest.mark.parametrize(
    ("line", "state"),
    [
        ("<Alarm:11|MPos:-1.500,0.000,0.000|FS:0,0>", "Alarm"),
        ("<Run:2|MPos:-1.500,0.000,0.000|FS:0,0>", "Run"),
        ("<Tool|MPos:-1.500,0.000,0.000|Bf:100,1023|FS:0,0>", "Tool"),
        ("<Hold:0|MPos:-1.500,0.000,0.000,0.000|FS:0,0|SD:3,x.nc>", "Hold:0"),
    ],
)
def test_status_words_of_the_family_are_understood(line: str, state: str) -> None:
    status = parse_status(line)
    assert status is not None
    assert (status.state, status.x_mm, status.homed) == (state, -1.5, False)
