"""The simulated Zaber device against the manual's messages and against ``zaber-motion``, which knows nothing of us."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from elpd_drivers.lenses import zaber_wire as wire
from hypothesis import given
from hypothesis import strategies as st
from lens_rigs import SPEED_SPS, Rig, rig, served
from virtual import MonotonicClock
from zaber_motion.ascii import Connection, DigitalOutputAction
from zaber_motion.exceptions import CommandFailedException, IoChannelOutOfRangeException

from elpd.errors import ConfigError, LensError
from elpd.records import LensFlag, StopMode
from elpd.units import Steps

if TYPE_CHECKING:
    from collections.abc import Iterator

    from zaber_motion.ascii import Axis


def say(made: Rig, line: str, ms: float = 8.0) -> str:
    made.port.write(line.encode("ascii") + b"\r\n")
    made.clock.pass_ms(ms)
    return made.port.read_available().decode("ascii")


# --- golden bytes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ours", "vendors"),
    [
        # written by zaber-motion 10.3, byte for byte
        (wire.command(1, 1, "get pos", 0), b"/1 1 00 get pos:2C"),
        (wire.command(1, 1, "stop", 3), b"/1 1 03 stop:15"),
        (wire.command(1, 1, "home", 8), b"/1 1 08 home:2D"),
        (wire.command(1, 1, "move abs 1000 20000 1000", 10), b"/1 1 10 move abs 1000 20000 1000:FC"),
        (wire.command(1, 1, "driver disable", 15), b"/1 1 15 driver disable:58"),
    ],
)
def test_commands_are_the_vendors(ours: bytes, vendors: bytes) -> None:
    assert ours == vendors + b"\n"


def test_replies_are_read_as_the_manual_has_them() -> None:
    assert wire.parse_reply("@01 0 OK BUSY WR 0") == wire.Reply(1, 0, None, True, True, "WR", "0", False)
    assert wire.parse_reply("@01 1 05 RJ IDLE -- BADDATA") == wire.Reply(
        1, 1, 5, accepted=False, busy=False, flag="--", data="BADDATA", checked=False
    )
    assert wire.parse_reply("@01 1 05 OK IDLE -- 3200:72") is not None
    assert wire.parse_reply("@01 1 05 OK IDLE -- 3201:72") is None
    assert wire.parse_reply("@01 1 05 OK IDLE -- 3200", checked_only=True) is None
    assert wire.parse_reply("!01 1 IDLE FS") is not None
    assert wire.parse_reply("#01 1 a note for people") is None


@given(text=st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=40))
def test_a_checksum_makes_the_sum_zero(text: str) -> None:
    message = f"/{text}"
    digits = wire.checksum(message)
    assert (sum(message[1:].encode("ascii")) + int(digits, 16)) % 256 == 0


@given(data=st.binary(max_size=80))
def test_no_bytes_upset_the_board(data: bytes) -> None:
    made = rig("zaber")
    made.port.write(data)
    made.clock.pass_ms(50)
    assert -64.0 <= made.rotor <= made.motor.travel_steps + 64.0


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("/", "@01 0 OK IDLE -- 0"),
        ("/1", "@01 0 OK IDLE -- 0"),
        ("/1 1 get pos", "@01 1 OK IDLE -- 3200"),
        ("/get pos", "@01 0 OK IDLE -- 3200"),
        ("/1 1 42 get pos", "@01 1 42 OK IDLE -- 3200"),
        ("/1 2 get pos", "@01 2 RJ IDLE -- BADAXIS"),
        ("/1 1 get nonsense", "@01 1 RJ IDLE -- BADCOMMAND"),
        ("/1 1 move abs", "@01 1 RJ IDLE -- BADDATA"),
        ("/1 1 move abs 9000", "@01 1 RJ IDLE -- BADDATA"),
        ("/1 1 move abs 3200", "@01 1 OK IDLE -- 0"),
        ("/1 1 warnings", "@01 1 OK IDLE -- 00"),
        ("/2 1 get pos", ""),
        ("/1 1 42 get pos:00", ""),
        ("/1 1 42 get pos:26", "@01 1 42 OK IDLE -- 3200"),
        ("noise/1 1 get pos", "@01 1 OK IDLE -- 3200"),
    ],
)
def test_lines_are_answered_as_by_the_firmware(line: str, answer: str) -> None:
    made = rig("zaber", checksum=False)
    assert say(made, line).strip() == answer


def test_without_a_reference_it_does_not_go_anywhere_but_home() -> None:
    made = rig("zaber", referenced=False, checksum=False)
    assert say(made, "/1 1 get pos") == "@01 1 OK IDLE WR 0\r\n"
    assert say(made, "/1 1 move abs 100") == "@01 1 RJ IDLE WR BADDATA\r\n"
    assert say(made, "/1 1 home") == "@01 1 OK BUSY WR 0\r\n"
    made.clock.pass_ms(4000)
    assert say(made, "/1 1 get pos") == "@01 1 OK IDLE -- 0\r\n"
    assert abs(made.rotor) < 1.0


def test_alerts_come_by_themselves_where_they_are_switched_on() -> None:
    made = rig("zaber", referenced=False, checksum=False, alerts=True)
    say(made, "/1 1 home")
    made.clock.pass_ms(4000)
    assert made.port.read_available() == b"!01 1 IDLE --\r\n"


# --- zaber-motion drives it as if it were real -------------------------------------------------------------------


@pytest.fixture
def axis() -> Iterator[Axis]:
    """Give the vendor's axis on a pty: what needs its device database (units, names) is left out, it is on line."""
    server, _ = served("zaber", MonotonicClock())
    with Connection.open_serial_port(server.port) as line:
        line.default_request_timeout = 20_000
        yield line.get_device(1).get_axis(1)
    server.close()


def test_zaber_motion_speaks_of_outputs_as_ours_does(axis: Axis) -> None:
    axis.device.io.set_digital_output(2, DigitalOutputAction.ON)
    with pytest.raises(IoChannelOutOfRangeException):
        axis.device.io.set_digital_output(7, DigitalOutputAction.ON)


def test_zaber_motion_moves_it(axis: Axis) -> None:
    assert axis.get_position() == 3200
    axis.move_absolute(4000, velocity=40_000, acceleration=100)
    assert axis.get_position() == 4000
    axis.move_relative(-100)
    assert axis.get_position() == 3900
    axis.move_velocity(-10_000)
    assert axis.is_busy()
    axis.stop()
    assert not axis.is_busy()
    assert axis.get_position() < 3900


def test_zaber_motion_homes_it_and_reads_its_warnings(axis: Axis) -> None:
    assert axis.warnings.get_flags() == set()
    assert axis.is_homed()
    axis.driver_disable()
    assert "FO" in axis.warnings.get_flags()
    axis.driver_enable()
    assert not axis.is_homed()
    axis.home()
    assert axis.is_homed()
    assert axis.get_position() == 0


def test_zaber_motion_understands_what_is_refused(axis: Axis) -> None:
    with pytest.raises(CommandFailedException) as refused:
        axis.generic_command("move sideways")
    assert refused.value.details.response_data == "BADCOMMAND"
    assert axis.settings.get("limit.max") == 8000


def test_zaber_motion_drives_elpd_sim_board() -> None:
    program = [sys.executable, "-c", "from elpd.cli import main; main()", "sim-board", "zaber", "--json"]
    program += ["--set", "start_um=500", "--set", "board.referenced=true"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = json.loads(process.stdout.readline())["port"]
        with Connection.open_serial_port(port) as line:
            line.default_request_timeout = 20_000
            assert line.generic_command("get pos", 1, 1).data == "1600"
            line.get_device(1).get_axis(1).move_absolute(1700)
            assert line.generic_command("get pos", 1, 1).data == "1700"
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=30)
        assert (process.returncode, out, err) == (0, "", "")


# --- what is special about the driver ----------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["6.32", "7.24"])
def test_older_firmware_is_refused_with_what_was_seen(version: str) -> None:
    made = rig("zaber", version=version)
    with pytest.raises(LensError, match=rf"firmware {version} answered.*7\.25 or newer"):
        made.open()


def test_a_device_that_contradicts_the_config_is_refused() -> None:
    made = rig("zaber")
    for key, value in (("max_um", 3000.0), ("max_speed_um_s", 20_000.0), ("acceleration_um_s2", 1000.0)):
        with pytest.raises(ConfigError, match=key):
            made.open(**{key: value})
        made.plug_in()
    say(made, "/1 1 set motion.decelonly 50")
    with pytest.raises(ConfigError, match="set both to the same value"):
        made.open()


def test_it_does_not_move_before_it_was_homed() -> None:
    made = rig("zaber", referenced=False)
    made.open()
    with pytest.raises(LensError, match="home it first"):
        made.lens.run(SPEED_SPS, made.soon(100))
    made.live(50)
    assert made.rotor == 3200.0


def test_the_devices_own_deceleration_is_what_a_stop_is_modelled_with() -> None:
    made = rig("zaber", acceleration_um_s2=50_000.0)
    made.open()
    made.lens.run(SPEED_SPS, made.soon(3000))
    made.live(150)
    made.lens.stop(StopMode.RAMPED)
    made.live(30)
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)
    made.live(200)
    assert not made.moving
    assert LensFlag.REFERENCED in made.reports[-1].flags


def test_replies_without_a_checksum_are_taken_until_the_first_that_has_one() -> None:
    made = rig("zaber", checksum=False)
    made.open()
    made.lens.move_to(Steps(3300), SPEED_SPS)
    made.live(100)
    assert made.rotor == pytest.approx(3300)


def test_a_neighbour_in_the_chain_is_not_listened_to() -> None:
    made = rig("zaber")
    made.open()
    made.port.faults.garble = lambda data: b"@02 1 07 OK BUSY FS 17\r\n" + data
    made.live(100)
    assert {report.steps for report in made.reports} == {3200.0}
