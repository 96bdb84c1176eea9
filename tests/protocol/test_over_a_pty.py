"""Ports by their names: one owner each, gone and back again; and programs of their own on the other side of a pty.

Drivers and boards in one process share a virtual time, which waits for the kernel. What runs in another process lives
in real time; nothing is asserted about how long it took.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
from typing import TYPE_CHECKING, Any

import pytest
import serial
import ticlib
from elpd_drivers.lenses.serial_port import SerialPort
from elpd_drivers.sim.boards.line import TIOCGEXCL, PtyServer
from elpd_drivers.sim.controllers import CONTROLLERS
from lens_rigs import KINDS, SPEED_SPS, Rig, rig, rigs_over, served
from pty_port import PtyPort
from virtual import MonotonicClock

from elpd.errors import BusyError, ConfigError, LensError
from elpd.records import LensFlag
from elpd.units import Steps, after_ms

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CLOCK = MonotonicClock()


@pytest.fixture(params=KINDS)
def on_a_pty(request: pytest.FixtureRequest) -> Rig:
    """Put a board on a pty, in virtual time, that nobody has opened yet."""
    with rigs_over("pty"):
        made = rig(str(request.param))
    made.port.close()
    return made


def marked_as_exclusive(path: str) -> bool:
    """Say whether who does not ask for the lock is kept out too; root is not, and sees the mark."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
    except OSError as error:
        return error.errno == errno.EBUSY
    try:
        return fcntl.ioctl(descriptor, TIOCGEXCL, bytes(4)) != bytes(4)
    finally:
        os.close(descriptor)


def opened(made: Rig) -> Any:
    assert isinstance(made.port, PtyPort)
    table = {"port": made.port.path, **made.dialect.homed}
    made.lens = CONTROLLERS[made.kind].open_lens(table, made.clock, None)
    made.reports.clear()
    return made.lens


def test_a_lens_that_is_opened_by_its_ports_name_homes_and_moves(on_a_pty: Rig) -> None:
    lens = opened(on_a_pty)
    assert LensFlag.REFERENCED in lens.home(on_a_pty.soon(30_000)).flags
    lens.move_to(Steps(3400), SPEED_SPS)
    on_a_pty.live(600)
    assert on_a_pty.rotor == pytest.approx(3400, abs=2.1)
    assert not on_a_pty.reports[-1].moving
    lens.close()


def test_a_port_in_use_is_refused_with_clear_words_and_nothing_moves(on_a_pty: Rig) -> None:
    first = opened(on_a_pty)
    with pytest.raises(BusyError, match="in use by another program"):
        opened(on_a_pty)
    assert on_a_pty.rotor == 3200.0
    assert isinstance(on_a_pty.port, PtyPort)
    assert marked_as_exclusive(on_a_pty.port.path)
    first.close()
    opened(on_a_pty).close()


def test_what_comes_back_on_another_pty_can_be_opened_and_is_where_it_was(on_a_pty: Rig) -> None:
    made = on_a_pty
    if not made.dialect.remembers:
        pytest.skip("the controller does not remember where it is")
    opened(made).move_to(Steps(3300), SPEED_SPS)
    made.live(300)
    made.port.faults.disconnect_at_ns = made.clock.now_ns()
    with pytest.raises(LensError, match="gone"):
        made.live(5)
    made.lens.close()
    with rigs_over("pty"):
        made.plug_in()
    made.port.close()
    opened(made)
    made.live(20)
    assert made.rotor == pytest.approx(3300)
    assert made.reports[-1].steps == pytest.approx(3300, abs=2)
    made.lens.close()


@pytest.fixture
def tic_board() -> Iterator[tuple[PtyServer, Any]]:
    server, motor = served("tic", CLOCK)
    yield server, motor
    server.close()


def test_a_program_that_was_killed_keeps_nobody_from_the_port(tic_board: Any) -> None:
    server, _ = tic_board

    def marked(descriptor: int) -> bool:
        return fcntl.ioctl(descriptor, TIOCGEXCL, bytes(4)) != bytes(4)

    watching = os.open(server.port, os.O_RDWR | os.O_NOCTTY)
    killed = os.open(server.port, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.flock(killed, fcntl.LOCK_EX)
        fcntl.ioctl(killed, termios.TIOCEXCL)
        CLOCK.sleep_until(after_ms(CLOCK.now_ns(), 300))
        assert marked(watching)  # as long as it lives the mark is respected
        os.close(killed)  # as the kernel does it: nobody takes the mark back
        end = after_ms(CLOCK.now_ns(), 20_000)
        while marked(watching) and CLOCK.now_ns() < end:
            CLOCK.sleep_until(after_ms(CLOCK.now_ns(), 10))
        assert not marked(watching)
    finally:
        os.close(watching)


def test_a_missing_port_is_named(tmp_path: Path) -> None:
    with pytest.raises(LensError, match="no such port"):
        SerialPort(str(tmp_path / "ttyACM9"), 115_200)
    with pytest.raises(ConfigError, match=r"lens\.port is empty"):
        SerialPort("", 115_200)


def test_a_file_is_not_a_port(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("hello")
    with pytest.raises(LensError, match="cannot be opened as a serial port"):
        SerialPort(str(tmp_path / "plain"), 115_200)


def test_a_far_end_that_takes_no_bytes_is_an_error_and_the_way_is_cleared() -> None:
    master, slave = os.openpty()
    port = SerialPort(os.ttyname(slave), 115_200)
    with pytest.raises(LensError, match="takes no bytes"):
        fill(port)
    port.close()
    with pytest.raises(LensError, match="closed"):
        port.write(b"x")
    port.close()
    os.close(master)
    os.close(slave)


def fill(port: SerialPort) -> None:
    for _ in range(64):
        port.write(b"x" * 4096)


def test_what_was_written_arrives_and_what_arrived_is_read() -> None:
    master, slave = os.openpty()
    port = SerialPort(os.ttyname(slave), 115_200)
    assert port.read_available() == b""
    port.write(b"\x89\x00\xff\r\n")
    assert os.read(master, 100) == b"\x89\x00\xff\r\n"
    os.write(master, b"<Idle|\x00\xff\r\n")
    assert port.read_available() == b"<Idle|\x00\xff\r\n"
    os.close(master)
    with pytest.raises(LensError, match="gone"):
        port.read_available()
    port.close()
    os.close(slave)


def errand(*arguments: str) -> dict[str, Any]:
    program = [sys.executable, "-c", "from elpd.cli import main; main()", *arguments, "--json"]
    done = subprocess.run(program, capture_output=True, text=True, timeout=60, check=False)
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def test_errands_over_a_pty_live_in_real_time_and_know_what_the_one_before_homed() -> None:
    server, motor = served("grbl", CLOCK)
    table = ("--set", "lens.driver=grbl", "--set", f"lens.port={server.port}", "--set", "lens.reply_ms=2000.0")
    assert errand("move", *table, "2000")["error"]["kind"] == "LensError"
    assert errand("home", *table)["referenced"]
    moved = errand("move", *table, "2000")
    assert moved["position_um"] == pytest.approx(2000, abs=0.2)
    assert motor.rotor_at(CLOCK.now_ns()) == pytest.approx(6400, abs=2.1)
    server.close()


# --- elpd sim-board ----------------------------------------------------------------------------------------------


def sim_board(*arguments: str) -> subprocess.Popen[str]:
    program = [sys.executable, "-c", "from elpd.cli import main; main()", "sim-board", *arguments]
    return subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_ticlib_drives_elpd_sim_board(ending: signal.Signals) -> None:
    with sim_board(
        "tic", "--json", "--set", "start_um=500", "--set", "board.referenced=true", "--set", "sim.seed=4"
    ) as process:
        assert process.stdout is not None
        port = json.loads(process.stdout.readline())["port"]
        with serial.Serial(port, 115_200, timeout=20, write_timeout=20) as line:
            tic = ticlib.TicSerial(line)
            assert tic.get_current_position() == 1600
            tic.energize()
            tic.exit_safe_start()
            tic.set_max_speed(64_000_000)
            tic.set_target_position(1700)
            for _ in range(2000):
                tic.reset_command_timeout()
                if tic.get_current_position() == 1700:
                    break
            assert tic.get_current_position() == 1700
            assert tic.get_variables()["planning_mode"] in {0, 1}
        process.send_signal(ending)
        out, err = process.communicate(timeout=30)
        assert (process.returncode, out, err) == (0, "", "")


def test_elpd_sim_board_serves_grbl_with_a_plain_line() -> None:
    with sim_board("grbl") as process:
        assert process.stdout is not None
        port = process.stdout.readline().strip()
        with serial.Serial(port, 115_200, timeout=20) as line:
            line.write(b"$I\n")
            assert line.read_until(b"ok\r\n").endswith(b"[VER:1.1h.20190830:]\r\n[OPT:V,15,128]\r\nok\r\n")
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30)
        assert process.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["marlin"], "known are avr, grbl, scf4, theia, tic, tmcl, zaber"),
        (["tic", "--set", "nope=1"], "board.nope: unknown key"),
        (["tic", "--set", "start_um"], "KEY=VALUE"),
        (["tic", "--set", "start_um=9999"], "outside the travel"),
        (["tic", "--set", "sim.seed=x"], "sim.seed"),
        (["tic", "--set", "lens.um_per_step=-1"], "lens.um_per_step"),
    ],
)
def test_elpd_sim_board_refuses_what_it_does_not_know(arguments: list[str], words: str) -> None:
    with sim_board(*arguments, "--json") as process:
        out, err = process.communicate(timeout=30)
        assert process.returncode == 2
        assert words in err
        assert json.loads(out)["error"]["kind"] in {"UsageError", "ConfigError"}
        assert "Traceback" not in err
