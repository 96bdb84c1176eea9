"""The simulated Tic against the vendor's document and against ``ticlib``, which knows nothing of us."""

from __future__ import annotations

import pytest
import ticlib
from elpd_drivers.lenses.tic_wire import crc7, encode, long_word
from elpd_drivers.sim.boards import tic_words as board_module
from hypothesis import given
from hypothesis import strategies as st
from lens_rigs import Rig, rig

from elpd.errors import LensError
from elpd.records import LensFlag


class Wire:
    """The read/write object that ``ticlib`` wants, in virtual time."""

    def __init__(self, made: Rig) -> None:
        self.made = made

    def write(self, data: bytes) -> None:
        self.made.port.write(data)

    def read(self, length: int) -> bytes | None:
        received = b""
        for _ in range(200):
            received += self.made.port.read_available()
            if len(received) >= length:
                return received
            self.made.clock.pass_ms(0.1)
        return None


@pytest.fixture
def made() -> Rig:
    return rig("tic")


@pytest.fixture
def tic(made: Rig) -> ticlib.TicSerial:
    return ticlib.TicSerial(Wire(made))


def awake(tic: ticlib.TicSerial) -> None:
    tic.energize()
    tic.exit_safe_start()


def errors(tic: ticlib.TicSerial) -> int:
    return int.from_bytes(tic.get_error_status(), "little")


# --- golden bytes ------------------------------------------------------------------------------------------------


def test_bytes_are_those_of_the_documents() -> None:
    assert encode(0xE3, long_word(-2_000_000)) == bytes.fromhex("e30d007b617f")
    assert encode(0x83, crc=True) == bytes((0x83, 0x01, 0x17))[:1] + bytes((crc7(b"\x83"),))
    assert crc7(bytes((0x83, 0x01))) == 0x17
    assert encode(0x89) == b"\x89"
    assert encode(0x89, device_number=14) == bytes((0xAA, 14, 0x09))
    assert encode(0xA1, bytes((0x22, 4))) == bytes((0xA1, 0x22, 0x04))


@given(value=st.integers(-(2**31), 2**31 - 1))
def test_long_words_are_ticlibs_and_come_back(value: int) -> None:
    sent: list[bytes] = []
    ticlib.TicSerial(type("Port", (), {"write": lambda _, data: sent.append(data)})()).set_target_position(value)
    assert sent == [encode(0xE0, long_word(value))]
    assert board_module.decode_long(long_word(value)) == value


@given(data=st.binary(max_size=12))
def test_both_ends_and_ticlib_agree_on_the_crc(data: bytes) -> None:
    assert bytes((crc7(data),)) == bytes((board_module.crc7(data),)) == ticlib.ticlib._get_crc_7(data)


@given(data=st.binary(max_size=64))
def test_no_bytes_upset_the_board(data: bytes) -> None:
    made = rig("tic")
    made.port.write(data)
    made.clock.pass_ms(50)
    assert -64.0 <= made.rotor <= made.motor.travel_steps + 64.0


# --- ticlib drives it as if it were real -------------------------------------------------------------------------


def test_every_variable_and_setting_can_be_read(tic: ticlib.TicSerial) -> None:
    variables = tic.get_variables()
    assert variables["current_position"] == 3200
    assert variables["vin_voltage"] == 12_000
    assert variables["step_mode"] == 7
    assert variables["encoder_position"] == 0
    everything = tic.settings.get_all()
    assert everything["serial_command_timeout"] == 1000
    assert everything["serial_device_number"] == 14
    assert everything["control_mode"] == 0


def test_it_wakes_up_in_safe_start_and_does_not_move(tic: ticlib.TicSerial, made: Rig) -> None:
    tic.set_target_velocity(10_000_000)
    made.clock.pass_ms(50)
    assert made.rotor == 3200
    assert errors(tic) & 0x80
    awake(tic)
    assert errors(tic) == 0
    assert tic.get_operation_state() == 10


def test_a_target_position_is_reached(tic: ticlib.TicSerial, made: Rig) -> None:
    awake(tic)
    tic.set_max_speed(128_000_000)
    tic.set_target_position(4000)
    made.clock.pass_ms(50)
    assert tic.get_planning_mode() == 1
    assert tic.get_current_velocity() == 128_000_000
    made.clock.pass_ms(100)
    assert tic.get_current_position() == 4000
    assert tic.get_current_velocity() == 0
    assert tic.get_time_since_last_step() > 0


def test_a_velocity_ramps_through_zero_and_halts_at_once(tic: ticlib.TicSerial, made: Rig) -> None:
    awake(tic)
    tic.set_target_velocity(128_000_000)
    made.clock.pass_ms(60)
    assert tic.get_current_velocity() == 128_000_000
    tic.set_target_velocity(-128_000_000)
    made.clock.pass_ms(20)
    assert 0 < tic.get_current_velocity() < 128_000_000
    made.clock.pass_ms(40)
    assert tic.get_current_velocity() == -128_000_000
    tic.halt_and_hold()
    made.clock.pass_ms(0.5)
    assert made.motor.velocity_at(made.clock.now_ns()) == 0.0
    assert tic.get_misc_flags()[0] & 2, "an abrupt halt may have cost steps"
    assert made.rotor == tic.get_current_position(), "at rest on a whole step"


def test_the_position_can_be_set(tic: ticlib.TicSerial) -> None:
    awake(tic)
    tic.halt_and_hold()
    tic.halt_and_set_position(-77)
    assert tic.get_current_position() == -77
    assert not tic.get_misc_flags()[0] & 2


def test_the_command_timeout_decelerates_to_hold(tic: ticlib.TicSerial, made: Rig) -> None:
    awake(tic)
    tic.set_target_velocity(2_000_000)
    made.clock.pass_ms(900)
    tic.reset_command_timeout()
    made.clock.pass_ms(900)
    assert tic.get_current_velocity() == 2_000_000
    made.clock.pass_ms(200)
    assert tic.get_current_velocity() == 0
    assert errors(tic) & 0x40
    tic.set_target_velocity(2_000_000)
    made.clock.pass_ms(50)
    assert tic.get_current_velocity() == 0, "safe start holds until it is left"
    tic.exit_safe_start()
    tic.set_target_velocity(2_000_000)
    made.clock.pass_ms(50)
    assert tic.get_current_velocity() == 2_000_000


def test_deenergizing_stops_and_forgets_the_position(tic: ticlib.TicSerial, made: Rig) -> None:
    awake(tic)
    tic.set_target_velocity(20_000_000)
    made.clock.pass_ms(50)
    tic.deenergize()
    assert errors(tic) & 1
    assert tic.get_current_velocity() == 0
    assert tic.get_misc_flags()[0] & 3 == 2


def test_a_limit_switch_stops_motion_towards_it_only(tic: ticlib.TicSerial, made: Rig) -> None:
    awake(tic)
    tic.set_max_speed(128_000_000)
    tic.set_target_position(-500)
    made.clock.pass_ms(400)
    assert tic.get_misc_flags()[0] & 8
    assert -3 <= made.rotor <= -1
    tic.set_target_position(100)
    made.clock.pass_ms(100)
    assert tic.get_current_position() == 100


def test_homing_finds_the_switch(tic: ticlib.TicSerial, made: Rig) -> None:
    awake(tic)
    tic.go_home(0)
    made.clock.pass_ms(100)
    assert tic.get_misc_flags()[0] & 16
    for _ in range(4):
        made.clock.pass_ms(400)
        tic.reset_command_timeout()
    assert not tic.get_misc_flags()[0] & (16 | 2)
    assert tic.get_current_position() == 0
    assert abs(made.rotor) < 1.0


def test_reset_and_unknown_commands_are_safe(tic: ticlib.TicSerial, made: Rig) -> None:
    awake(tic)
    tic.set_max_speed(7)
    tic.reset()
    assert tic.get_max_speed() == 200_000_000
    awake(tic)
    made.port.write(b"\xd1")
    made.clock.pass_ms(2)
    assert errors(tic) & 0x20, "an unknown command is a serial error"


@pytest.mark.parametrize("commands", [False, True])
def test_crc_and_device_numbers(commands: bool) -> None:  # noqa: FBT001
    made = rig("tic", crc_commands=commands, crc_responses=True)
    tic = ticlib.TicSerial(Wire(made), device_number=14, crc_for_commands=commands, crc_for_responses=True)
    awake(tic)
    tic.set_target_position(3300)
    made.clock.pass_ms(200)
    assert tic.get_current_position() == 3300
    stranger = ticlib.TicSerial(Wire(made), device_number=15, crc_for_commands=commands)
    stranger.set_target_position(100)
    made.clock.pass_ms(200)
    assert tic.get_current_position() == 3300


def test_a_wrong_crc_is_refused() -> None:
    made = rig("tic", crc_commands=True)
    tic = ticlib.TicSerial(Wire(made), crc_for_commands=True)
    awake(tic)
    made.port.write(encode(0xE3, long_word(50_000_000)) + b"\x01")
    made.clock.pass_ms(50)
    assert not made.moving
    assert int.from_bytes(tic.get_error_occured(), "little") & 1 << 19


@pytest.mark.parametrize("crc", [False, True])
def test_our_driver_speaks_every_framing(crc: bool) -> None:  # noqa: FBT001
    made = rig("tic", crc_commands=crc, crc_responses=crc)
    lens = made.open(device_number=14, crc_commands=crc, crc_responses=crc)
    lens.move_to(3500, 12_800.0)
    made.live(100)
    assert made.rotor == 3500


def test_a_flipped_bit_in_a_reply_with_crc_is_never_believed() -> None:
    made = rig("tic", crc_responses=True)
    lens = made.open(crc_responses=True)
    made.live(20)
    flips = iter(range(8))

    def flip(data: bytes) -> bytes:
        bit = next(flips, None)
        return data if bit is None else bytes((data[0] ^ 1 << bit, *data[1:]))

    made.port.faults.garble = flip
    made.live(100)
    assert {report.steps for report in made.reports} == {3200.0}
    assert lens.position_at(made.clock.now_ns()).steps == pytest.approx(3200.0)


def test_a_host_that_falls_silent_is_outlived_by_a_second_at_most() -> None:
    made = rig("tic")
    made.open()
    made.lens.run(1000.0, made.soon(5000))
    made.live(100)
    made.clock.pass_ms(1100)
    assert not made.moving
    assert made.rotor < 3200 + 1300


@pytest.mark.parametrize("gap_ms", [0.0, 1.0, 3.0, 20.0])
def test_after_a_long_silence_it_moves_though_a_reply_still_tells_of_the_timeout(gap_ms: float) -> None:
    """As where a camera took five seconds to open: what was asked before the errors were cleared arrives after."""
    made = rig("tic")
    lens = made.open()
    made.live(100)
    made.clock.pass_ms(1500)
    made.poll()
    made.clock.pass_ms(gap_ms)
    lens.move_to(3500, 3000.0)
    made.live(600)
    assert made.rotor == 3500


def test_it_homes_faster_than_the_lens_may_sweep() -> None:
    made = rig("tic")
    made.open(max_speed_um_s=100.0)  # the board homes at its own settings' speed, which is higher
    report = made.lens.home(made.soon(60_000))
    assert LensFlag.REFERENCED in report.flags


@pytest.mark.parametrize("start_um", [0.0, 0.3125, 1.25])
def test_homing_may_end_between_two_looks(start_um: float) -> None:
    made = rig("tic", start_um=start_um)
    lens = made.open(query_ms=50.0, reply_ms=200.0)
    report = lens.home(made.soon(5000))
    assert LensFlag.REFERENCED in report.flags
    assert report.steps == 0.0
    assert made.rotor == pytest.approx(0.0, abs=1.0)


def test_a_tic_that_takes_no_notice_of_homing_is_not_believed_to_have_homed() -> None:
    made = rig("tic", start_um=0.0, limit_switches=False)
    lens = made.open(query_ms=50.0, reply_ms=200.0)
    with pytest.raises(LensError, match="did not start to home"):
        lens.home(made.soon(5000))
