"""The simulated TMCL module against the manuals' bytes and against ``pytrinamic``, which knows nothing of us."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from typing import Any

import pytest
from elpd_drivers.lenses import tmcl_wire as wire
from elpd_drivers.sim.boards import tmcl_words as words
from hypothesis import given
from hypothesis import strategies as st
from lens_rigs import SPEED_SPS, Rig, rig
from pytrinamic.connections.connection_manager import ConnectionManager
from pytrinamic.connections.tmcl_interface import TmclInterface
from pytrinamic.modules.TMCM1110 import TMCM1110
from pytrinamic.tmcl import TMCLReplyStatusError, TMCLRequest

from elpd.errors import ConfigError, LensError
from elpd.records import LensFlag, StopMode
from elpd.units import Steps


class Interface(TmclInterface):
    """pytrinamic's own seam, in virtual time."""

    def __init__(self, made: Rig) -> None:
        super().__init__()
        self.made = made

    def _send(self, host_id: int, module_id: int, data: bytes) -> None:
        self.made.port.write(data)

    def _recv(self, host_id: int, module_id: int) -> bytes:
        received = b""
        for _ in range(200):
            received += self.made.port.read_available()
            if len(received) == 9:
                return received
            self.made.clock.pass_ms(0.1)
        raise RuntimeError("no reply")


@pytest.fixture
def made() -> Rig:
    return rig("tmcl")


@pytest.fixture
def vendor(made: Rig) -> Interface:
    return Interface(made)


# --- golden bytes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ours", "documented"),
    [
        (wire.request(1, 0x13, 2, 0, -5000), "01 13 02 00 ff ff ec 78 78"),  # TMCM-1276 and TMCM-6212 manuals, CALC MUL
        (wire.request(1, 0x29, 1, 0x1B, 0), "01 29 01 1b 00 00 00 00 46"),  # TMCM-6212 manual, CALCVA SUB
        (wire.request(1, wire.RFS, wire.START)[:8], "01 0d 00 00 00 00 00 00"),  # PD-1021 manual, RFS START
        (wire.request(1, wire.ROR, 0, 0, 5000), "01 01 00 00 00 00 13 88 9d"),  # seen from the vendor's client
        (wire.request(1, wire.MST), "01 03 00 00 00 00 00 00 04"),
    ],
)
def test_requests_are_those_of_the_manuals(ours: bytes, documented: str) -> None:
    assert ours == bytes.fromhex(documented)


@pytest.mark.parametrize(
    ("raw", "reply"),
    [
        ("02 01 64 13 ff ff ec 78 dc", wire.Reply(100, 0x13, -5000)),  # TMCM-6212 manual
        ("02 01 64 29 00 00 00 00 90", wire.Reply(100, 0x29, 0)),
    ],
)
def test_replies_are_those_of_the_manuals(raw: str, reply: wire.Reply) -> None:
    data = bytes.fromhex(raw)
    assert wire.Replies(1, 2).feed(b"\x02\x01" + data + data[:4]) == [(reply, 4)]
    assert words.reply_bytes(2, 1, words.Status.OK, reply.command, reply.value) == data


@given(
    command=st.integers(0, 255),
    kind=st.integers(0, 255),
    motor=st.integers(0, 255),
    value=st.integers(-(2**31), 2**31 - 1),
)
def test_both_ends_and_pytrinamic_agree_on_every_datagram(command: int, kind: int, motor: int, value: int) -> None:
    ours = wire.request(1, command, kind, motor, value)
    assert ours == TMCLRequest(1, command, kind, motor, value).to_buffer()
    assert words.Datagram.read(ours) == words.Datagram(command, kind, motor, value)
    assert words.Datagram.read(ours[:8] + bytes((ours[8] ^ 1,))) is None


def test_versions_are_read_with_and_without_a_dot() -> None:
    assert wire.parse_version(b"\x02" + b"1110V109", 2) == wire.Firmware(1110, "1.09")
    assert wire.parse_version(b"\xff\x02" + b"140V2.50", 2) == wire.Firmware(140, "2.50")
    assert wire.parse_version(b"\x03" + b"1110V109", 2) is None


@given(data=st.binary(max_size=64))
def test_no_bytes_upset_the_board(data: bytes) -> None:
    made = rig("tmcl")
    made.port.write(data)
    made.clock.pass_ms(50)
    assert -64.0 <= made.rotor <= made.motor.travel_steps + 64.0


# --- pytrinamic drives it as if it were real ---------------------------------------------------------------------


def test_it_says_what_it_is(vendor: Interface) -> None:
    assert vendor.get_version_string() == "1260V119"
    assert vendor.send(136, 1, 0, 0).value == 1260 << 16 | 1 << 8 | 19


def test_pytrinamic_moves_it(vendor: Interface, made: Rig) -> None:
    motor = TMCM1110(vendor).motors[0]
    motor.linear_ramp.max_velocity = 12_800
    motor.linear_ramp.max_acceleration = 640_000
    assert motor.actual_position == 3200
    motor.move_to(4000)
    made.clock.pass_ms(40)
    assert motor.actual_velocity == 12_800
    assert not motor.get_position_reached()
    made.clock.pass_ms(100)
    assert motor.actual_position == 4000
    assert motor.get_position_reached()
    motor.rotate(-12_800)
    made.clock.pass_ms(50)
    assert motor.actual_velocity == -12_800
    motor.stop()
    made.clock.pass_ms(10)
    assert -12_800 < motor.actual_velocity < 0, "a stop is ramped"
    made.clock.pass_ms(20)
    assert motor.actual_velocity == 0
    assert made.rotor == motor.actual_position


def test_pytrinamic_switches_the_output_that_ours_does(vendor: Interface, made: Rig) -> None:
    vendor.set_digital_output(3)
    assert made.board.outputs == {"out3": True}
    vendor.clear_digital_output(3)
    assert made.board.outputs == {"out3": False}
    made.open().set_output("out3", on=True)
    assert made.board.outputs == {"out3": True}


def test_pytrinamic_lets_it_search_its_reference(vendor: Interface, made: Rig) -> None:
    for kind, value in ((5, 640_000), (193, 1), (194, 6400), (195, 400)):
        vendor.set_axis_parameter(kind, 0, value)
    vendor.reference_search(0, 0)
    made.clock.pass_ms(100)
    assert vendor.reference_search(2, 0) != 0
    made.clock.pass_ms(1500)
    assert vendor.reference_search(2, 0) == 0
    assert vendor.get_axis_parameter(1, 0, signed=True) == 0
    assert abs(made.rotor) < 1.0


def test_ports_and_parameters_keep_what_they_are_given(vendor: Interface) -> None:
    vendor.set_digital_output(1)
    assert vendor.send(15, 1, 2, 0).value == 1
    vendor.set_global_parameter(7, 2, -3)
    assert vendor.get_global_parameter(7, 2, signed=True) == -3
    vendor.set_axis_parameter(1, 0, -12)
    assert vendor.get_axis_parameter(1, 0, signed=True) == -12


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ((99, 0, 0, 0), 2),
        ((6, 250, 0, 0), 3),
        ((6, 1, 5, 0), 4),
        ((5, 3, 0, 7), 3),
        ((5, 4, 0, -1), 4),
        ((4, 9, 0, 1), 3),
    ],
)
def test_what_it_does_not_understand_is_refused(vendor: Interface, command: Any, status: int) -> None:
    with pytest.raises(TMCLReplyStatusError) as refused:
        vendor.send(*command)
    assert refused.value.status_code == status


def test_a_wrong_checksum_is_answered_and_nothing_moves(made: Rig) -> None:
    made.port.write(bytes.fromhex("01 01 00 00 00 00 13 88 9c"))
    made.clock.pass_ms(5)
    assert made.port.read_available()[2] == 1
    assert not made.moving


def test_another_address_is_not_answered_and_half_a_datagram_is_forgotten(made: Rig) -> None:
    made.port.write(bytes.fromhex("02 01 00 00 00 00 13 88 9e"))
    made.clock.pass_ms(5)
    made.port.write(bytes.fromhex("01 01 00 00"))
    made.clock.pass_ms(20)
    made.port.write(wire.request(1, wire.GAP, wire.POSITION))
    made.clock.pass_ms(5)
    assert wire.Replies(1, 2).feed(made.port.read_available()) == [(wire.Reply(100, wire.GAP, 3200), 0)]
    assert not made.moving


def test_on_a_half_duplex_line_it_does_not_hear_while_it_talks() -> None:
    for half_duplex, replies in ((False, 2), (True, 1)):
        made = rig("tmcl", half_duplex=half_duplex)
        made.port.write(wire.request(1, wire.GAP, wire.POSITION) + wire.request(1, wire.GAP, wire.SPEED))
        made.clock.pass_ms(10)
        assert len(wire.Replies(1, 2).feed(made.port.read_available())) == replies


# --- what is special about the driver ----------------------------------------------------------------------------


def test_a_stop_that_collides_with_a_reply_is_repeated_until_it_is_acknowledged() -> None:
    for wait_ms in (0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8):
        made = rig("tmcl", half_duplex=True)
        made.open()
        made.lens.run(SPEED_SPS, made.soon(3000))
        made.live(40)
        write, written = made.port.write, []
        made.port.write = lambda data, w=write, log=written: (log.append(data), w(data))  # type: ignore[method-assign]
        made.live_until(lambda log=written: bool(log), 20)
        made.clock.pass_ms(wait_ms, step_ms=0.1)
        made.lens.stop(StopMode.RAMPED)
        made.live(40)
        assert not made.moving, wait_ms
        made.live(60)
        assert LensFlag.REFERENCED in made.reports[-1].flags
        assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=0.5)


@pytest.mark.parametrize("module", [1110, 6110])
def test_a_module_with_units_of_its_own_is_driven_at_the_speed_that_it_can(module: int) -> None:
    made = rig("tmcl", module=module)
    lens = made.open()
    made.lens.run(12_800.0, made.soon(3000))
    made.live(60)
    unit = 16e6 / 2**3 / 2048 / 32
    assert made.motor.velocity_at(made.clock.now_ns()) == pytest.approx(12_800 // unit * unit)
    assert lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=4)
    assert lens.limits.acceleration_sps2 == pytest.approx(640_000, rel=2e-3)
    lens.move_to(Steps(5000), 8000.0)
    made.live(300)
    assert made.rotor == pytest.approx(5000)


def test_divisors_that_are_too_slow_are_refused_with_what_they_allow() -> None:
    made = rig("tmcl", module=1110, pulse_divisor=7)
    with pytest.raises(ConfigError, match="divisors allow 3904 steps/s"):
        made.open()


def test_an_unknown_module_is_refused_with_what_was_seen_unless_it_is_named() -> None:
    made = rig("tmcl", module=1670)
    with pytest.raises(LensError, match=r"module 1670 with firmware 1\.19 answered.*lens\.module = 1670"):
        made.open()
    again = rig("tmcl", module=1670)
    again.open(module=1670)
    again.live(20)
    assert again.reports


def test_a_restart_at_rest_is_found_out_even_where_the_count_begins_anyway() -> None:
    made = rig("tmcl", start_um=0.0)
    made.open()
    made.live(50)
    made.board.reset_at(made.clock.now_ns())
    with pytest.raises(LensError, match="restarted by itself"):
        made.live(100)


def test_the_reference_outlives_the_host_but_not_a_fault() -> None:
    made = rig("tmcl", referenced=False)
    made.open()
    made.lens.home(made.soon(10_000))
    made.lens.close()
    made.plug_in()
    made.open()
    made.lens.move_to(Steps(500), SPEED_SPS)
    made.live(20)
    made.board.alarm_at(made.clock.now_ns())
    with pytest.raises(LensError, match="too hot"):
        made.live(100)
    made.clock.pass_ms(20)
    made.plug_in()
    lens = made.open()
    with pytest.raises(LensError, match="home it first"):
        lens.move_to(Steps(100), SPEED_SPS)


# --- over a pty --------------------------------------------------------------------------------------------------


def test_pytrinamic_drives_elpd_sim_board() -> None:
    program = [sys.executable, "-c", "from elpd.cli import main; main()", "sim-board", "tmcl", "--json"]
    program += ["--set", "start_um=500", "--set", "board.referenced=true"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = json.loads(process.stdout.readline())["port"]
        manager = ConnectionManager(f"--interface serial_tmcl --port {port} --timeout 20")
        with manager.connect() as line:
            assert line.get_version_string() == "1260V119"
            motor = TMCM1110(line).motors[0]
            assert motor.actual_position == 1600
            motor.linear_ramp.max_acceleration = 640_000
            motor.move_to(1700, 6400)
            for _ in range(2000):
                if motor.get_position_reached():
                    break
            assert motor.actual_position == 1700
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=30)
        assert (process.returncode, out, err) == (0, "", "")
