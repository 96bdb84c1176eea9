"""How long a stop takes to leave: ``python tools/latency.py [--board tic] [--json]``. Prints; asserts nothing.

Two tables, each privileged (SCHED_FIFO, memory locked) where this user may, and not.

*Stops*: from the call of ``lens.stop`` to the return of the write that hands its bytes to the port, a pty with a
simulated board of another process behind it. While nothing else happens but polling, while a flood of replies waits
unread in the port, and while another thread of this process computes in Python, which is scheduled as the daemon's
other threads are: as ordinary, whatever the one that stops the lens may have. The call comes at any moment of the
caller's turn with the interpreter.

*Reactions*: another process writes EVT3 words of a real recording, or made ones, into a socket, packet by packet, each
with the instant of writing. This one waits for it, sums the packet's windows, feeds the detector and writes stop bytes
to a pty. ``sent`` is counted from the writing, so it holds the sender's and the kernel's moods; ``own`` from the return
of the wait, which is what this program is answerable for. The machine's own noise is measured beside it: the gaps in a
loop that only looks at the clock.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import pty
import select
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.lenses.serial_port import SerialPort
from speed import stream
from speed.machine import noise_floor, realtime

from elpd import rig
from elpd.config import load
from elpd.events.evt3_encode import Evt3Encoder
from elpd.records import CameraPacket, ElpSample, Encoding, Geometry, StopMode
from elpd.timebase import MonotonicClock
from elpd.units import HostNs
from elpd.vision.detector import Detector
from elpd.vision.elp import ElpWindows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

SWITCH_S = 5e-5
WINDOW_US = 1000
SENSOR = Geometry(1280, 720)
RANDOM_EVENTS = 1_000_000
WARM_UP = 50
"""Packets that are not counted."""
QUESTIONS = {"tic": b"\xa1\x22\x08", "grbl": b"?", "tmcl": bytes((1, 6, 1, 0, 0, 0, 0, 0, 8)), "zaber": b"/get pos\n"}
"""What makes each board talk, for the flood."""
FLOOD = 500
LONGEST_TURN_US = 300.0
"""How long the caller has computed before it stops the lens, at most: several turns with the interpreter."""

PERCENTILES = (50.0, 99.0, 99.9, 100.0)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="an EVT3 recording for the reactions")
    parser.add_argument("--board", choices=sorted(QUESTIONS), default="tic")
    parser.add_argument("--stops", type=int, default=1000, help="per row")
    parser.add_argument("--packets", type=int, default=3000, help="per row")
    parser.add_argument("--words", type=int, default=2000, help="per packet")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    sys.setswitchinterval(SWITCH_S)
    sensor, words = stream_words(arguments.file, arguments.words * (arguments.packets + WARM_UP))
    answer: dict[str, Any] = {
        "board": arguments.board,
        "words_per_packet": arguments.words,
        "stops": [],
        "reactions": [],
    }
    for privileged in (True, False):
        with ExitStack() as privileges:
            refused = privileges.enter_context(realtime()) if privileged else None
            if refused is not None:
                answer["unprivileged_only"] = refused
                continue
            common = {"privileged": privileged}
            floor = noise_floor()
            for condition in CONDITIONS:
                spent = stops(arguments.board, condition, arguments.stops)
                answer["stops"].append({**common, "condition": condition, **_summary("call_to_written", spent)})
            sent, own = reactions(sensor, words, arguments.words, arguments.packets)
            figures = {**_summary("sent", sent), **_summary("own", own), **_summary("machine_gap", floor)}
            answer["reactions"].append({**common, **figures})
    print(json.dumps(answer) if arguments.json else _table(answer))
    return 0


# --- stops ---------------------------------------------------------------------------------------------------------


class StampedPort:
    """A serial port that notes when its last write was done."""

    def __init__(self, path: str) -> None:
        self._port = SerialPort(path, 115_200)
        self.written_ns = 0

    def write(self, data: bytes) -> None:
        """Write and note."""
        self._port.write(data)
        self.written_ns = time.monotonic_ns()

    def read_available(self) -> bytes:
        """Read."""
        return self._port.read_available()

    def close(self) -> None:
        """Close."""
        self._port.close()


def stops(board: str, condition: str, count: int) -> NDArray[np.float64]:
    """Return the microseconds from the call of ``stop`` to its bytes' handing over, *count* times."""
    with simulated_board(board) as path:
        port = StampedPort(path)
        config = load(None, [f"lens.driver={board}"])
        settings = {"um_per_step": config.lens.um_per_step, "reply_ms": 5000.0}
        if board == "grbl":
            settings |= {"connect_ms": 20_000.0, "trust_position": True}
        lens = rig.find("elpd.lenses", board)(settings, MonotonicClock(), port)
        spent = np.zeros(count)
        rng = np.random.default_rng(1)
        try:
            with CONDITIONS[condition]():
                for turn in range(count):
                    if condition == "replies flood in":
                        if turn % FLOOD == 0:
                            port.read_available()
                            port.write(QUESTIONS[board] * FLOOD)
                    else:
                        lens.poll()
                        time.sleep(0.001)
                    compute_for(rng.uniform(0.0, LONGEST_TURN_US))
                    begun = time.monotonic_ns()
                    lens.stop(StopMode.RAMPED)
                    spent[turn] = (port.written_ns - begun) / 1e3
        finally:
            lens.close()
    return spent


@contextmanager
def simulated_board(board: str) -> Iterator[str]:
    """Serve a board from another process."""
    command = [sys.executable, "-m", "elpd", "sim-board", board, "--json"]
    more = ["--set", "board.referenced=true"]
    with subprocess.Popen([*command, *more], stdout=subprocess.PIPE, text=True) as process:  # noqa: S603  (our own)
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["port"]
        finally:
            process.terminate()


@contextmanager
def busy_thread() -> Iterator[None]:
    """Let another thread of this process compute."""
    ended = threading.Event()

    def compute() -> None:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        while not ended.is_set():
            sum(range(1000))

    thread = threading.Thread(target=compute, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def compute_for(us: float) -> None:
    """Keep the interpreter busy."""
    end_ns = time.monotonic_ns() + us * 1e3
    while time.monotonic_ns() < end_ns:
        pass


CONDITIONS: dict[str, Callable[[], Any]] = {
    "reader idle": ExitStack,
    "replies flood in": ExitStack,
    "a thread computes": busy_thread,
}


# --- reactions -----------------------------------------------------------------------------------------------------


def reactions(
    sensor: Geometry, words: NDArray[np.uint16], per_packet: int, packets: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the microseconds from writing, and from waking, to the stop bytes' writing, for each packet."""
    weights = np.random.default_rng(1).integers(-1020, 1021, (sensor.height, sensor.width))
    windows = ElpWindows(weights, window_us=WINDOW_US)
    detector = Detector()
    ours, theirs = socket.socketpair()
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    stop_bytes = bytes((0x89,))
    buffer = bytearray(8 + 2 * per_packet)
    view = memoryview(buffer)
    sent, own = np.zeros(packets), np.zeros(packets)
    sender = multiprocessing.get_context("fork").Process(target=send, args=(theirs, words, per_packet))
    sender.start()
    waiting = select.poll()
    waiting.register(ours, select.POLLIN)
    try:
        for turn in range(-WARM_UP, packets):
            waiting.poll()
            woken = time.monotonic_ns()
            filled = 0
            while filled < len(buffer):
                filled += ours.recv_into(view[filled:])
            stamp = struct.unpack_from("<q", buffer)[0]
            payload = np.frombuffer(buffer, np.uint16, offset=8)
            packet = CameraPacket(encoding=Encoding.EVT3, data=payload, received_ns=HostNs(woken))
            for row in windows.feed(packet).tolist():
                detector.feed(ElpSample(*row))
            os.write(slave, stop_bytes)
            done = time.monotonic_ns()
            if turn >= 0:
                sent[turn], own[turn] = (done - stamp) / 1e3, (done - woken) / 1e3
            with suppress(BlockingIOError):
                os.read(master, 64)
    finally:
        sender.terminate()
        sender.join()
        for end in (ours, theirs):
            end.close()
        os.close(master)
        os.close(slave)
    return sent, own


def send(socket_end: socket.socket, words: NDArray[np.uint16], per_packet: int) -> None:
    """Write packets, one each half millisecond, each behind the instant of its writing."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    for begin in range(0, len(words), per_packet):
        piece = words[begin : begin + per_packet].tobytes()
        time.sleep(0.0005)
        socket_end.sendall(struct.pack("<q", time.monotonic_ns()) + piece)


def stream_words(path: Path | None, n_words: int) -> tuple[Geometry, NDArray[np.uint16]]:
    """Return so many words of a recording, or of events made at random, whose time goes on: a step back costs more."""
    if path is not None:
        sensor, words = stream.payload(path)
        return sensor, stream.tiled(words, sensor, n_words)[:n_words]
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(0, 200_000, RANDOM_EVENTS))
    x, y = rng.integers(0, SENSOR.width, RANDOM_EVENTS), rng.integers(0, SENSOR.height, RANDOM_EVENTS)
    p = rng.integers(0, 2, RANDOM_EVENTS)
    words = Evt3Encoder(SENSOR.width).encode(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))
    return SENSOR, stream.tiled(words, SENSOR, n_words)[:n_words]


# --- telling -------------------------------------------------------------------------------------------------------


def _summary(name: str, spent_us: NDArray[np.float64]) -> dict[str, float]:
    values = np.percentile(spent_us, PERCENTILES)
    keys = ("p50", "p99", "p99_9", "max")
    return {f"{name}_{key}_us": round(float(value), 1) for key, value in zip(keys, values, strict=True)}


def _table(answer: dict[str, Any]) -> str:
    lines = [f"stops on a {answer['board']} board: call to bytes handed over, us", f"{'':34s}{_HEAD}"]
    for row in answer["stops"]:
        who = "privileged" if row["privileged"] else "ordinary"
        lines.append(f"{who:12s}{row['condition']:22s}{_figures(row, 'call_to_written')}")
    lines += ["", f"packets of {answer['words_per_packet']} words: to the stop byte written, us", f"{'':34s}{_HEAD}"]
    for row in answer["reactions"]:
        who = "privileged" if row["privileged"] else "ordinary"
        for name, words in (("own", "from waking"), ("sent", "from the sender"), ("machine_gap", "the machine's gaps")):
            lines.append(f"{who:12s}{words:22s}{_figures(row, name)}")
    if "unprivileged_only" in answer:
        lines.append(answer["unprivileged_only"])
    return "\n".join(lines)


_HEAD = "".join(f"{name:>9s}" for name in ("p50", "p99", "p99.9", "max"))


def _figures(row: dict[str, Any], name: str) -> str:
    return "".join(f"{row[f'{name}_{key}_us']:9.1f}" for key in ("p50", "p99", "p99_9", "max"))


if __name__ == "__main__":
    sys.exit(main())
