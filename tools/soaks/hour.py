"""A service that runs, driven over its socket in real time, by one who works with it and by those who are a nuisance.

The one asks for focus, stops or cancels it in the midst, moves, looks. Beside it one subscribes to everything and never
reads, one asks as fast as it can write, one talks nonsense, one comes and goes. What the service must do with them:
answer each request of the first once, let no STOP wait, drop those who do not read, and not grow.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.client import Client
from elpd.errors import ElpdError
from soaks.ledger import Ledger, spread

if TYPE_CHECKING:
    from collections.abc import Callable

DEPTH_OF_FOCUS_UM = 6.0
PATIENCE_S = 120.0
CYCLE_S = 3.0
FAR_UM = 250.0
PAUSE_S = 1.0
WEIGHED_EVERY_S = 60.0
FLOOD_LINES = 4000
NONSENSE = (
    b"{\n", b"[" * 5000 + b"\n", b"\xff\xfe\x00\n", b'{"id": 1}\n', b'{"id": 2, "method": "rm"}\n', b"x" * (1 << 20),
    b'{"id": 3, "method": "move", "params": {"to_um": NaN}}\n',
)  # fmt: skip


class Hour:
    """An hour, or as long as it is run. What is asked follows from the seed; what comes back, from the machine."""

    def __init__(self, path: Path, seed: int) -> None:
        self.enough = False
        """Set to end ``run`` early."""
        self._path = path
        self._chance = np.random.default_rng(seed)
        self._ledger = Ledger(DEPTH_OF_FOCUS_UM)
        self._nuisances: Counter[str] = Counter()
        self._took_ms: dict[str, list[float]] = {}
        self._end = threading.Event()
        self._focus_um: float | None = None
        self._process = _server(path)
        self._used_s = processor_s(self._process)
        self._begun_s = time.monotonic()
        self._elapsed_s = 0.0
        self._last: dict[str, Any] = {}

    def run(self, hours: float) -> None:
        """Do it, in real time."""
        threads = [
            threading.Thread(target=self._repeat, args=(what, pause_s), daemon=True)
            for what, pause_s in (
                (self._never_read, 5.0),
                (self._flood, 20.0),
                (self._talk_nonsense, 10.0),
                (self._come_and_go, 2.0),
            )
        ]
        for thread in threads:
            thread.start()
        weighed_s = float("-inf")
        with Client(self._path, timeout_s=PATIENCE_S) as rig, Client(self._path, timeout_s=PATIENCE_S) as other:
            while not self.enough and self._elapsed_s < 3600.0 * hours:
                self._elapsed_s = time.monotonic() - self._begun_s
                if self._elapsed_s - weighed_s >= WEIGHED_EVERY_S:
                    weighed_s = self._elapsed_s
                    self._weigh()
                self._work(rig, other)
                self._end.wait(float(self._chance.exponential(PAUSE_S)))
            self._end.set()
            for thread in threads:
                thread.join(PATIENCE_S)
            self._weigh()
            self._last = dict(other.status())

    def figures(self) -> dict[str, Any]:
        """Return what came of it."""
        cpu_s = processor_s(self._process) - self._used_s
        return {
            "hours": round(self._elapsed_s / 3600, 2),
            **self._ledger.figures(),
            "answered_ms": {name: spread(took) for name, took in sorted(self._took_ms.items())},
            "nuisances": dict(sorted(self._nuisances.items())),
            "cpu_of_a_core": round(cpu_s / max(1e-9, time.monotonic() - self._begun_s), 3),
            "service": {key: self._last.get(key) for key in ("state", "fault", "warnings", "counters")},
        }

    # --- the one who works ---

    def _work(self, rig: Client, other: Client) -> None:
        """Ask for one thing and hear its answer."""
        chance = self._chance
        wishes: tuple[tuple[float, Callable[[], object]], ...] = (
            (0.45, lambda: self._cycle(rig)),
            (0.12, lambda: self._cycle(rig, lambda: self._timed("stop in mid-cycle", other.stop))),
            (0.08, lambda: self._cycle(rig, lambda: self._timed("cancel", other.cancel))),
            (0.10, lambda: self._timed("move", lambda: rig.move(self._somewhere_um()))),
            (0.05, lambda: self._timed("jog", lambda: rig.jog(float(chance.normal(0, 50))))),
            (0.05, lambda: self._timed("stop at rest", other.stop)),
            (0.05, lambda: self._timed("map", lambda: rig.map(max_width=160))),
            (0.05, lambda: self._timed("runs", rig.runs)),
            (0.05, lambda: self._timed("metrics", rig.metrics)),
        )
        weights = [weight for weight, _ in wishes]
        wishes[int(chance.choice(len(wishes), p=weights))][1]()
        state: Any = self._timed("status", other.status)
        if state is not None and state["fault"] is not None:
            self._ledger.counts[f"fault {state['fault']['kind']}"] += 1
            print(f"{self._elapsed_s:6.0f} s  {state['fault']}", file=sys.stderr, flush=True)
            self._timed("clear", other.clear)
        if state is not None and state["lens"]["referenced"] is not True:
            self._timed("home", rig.home)

    def _cycle(self, rig: Client, interfere: Callable[[], object] | None = None) -> None:
        """Focus from somewhere; let somebody interfere with it."""
        if self._focus_um is not None:
            self._timed("move", lambda: rig.move(self._somewhere_um()))
        pending = None
        self._ledger.counts["requests"] += 1
        begun_s = time.perf_counter()
        try:
            pending = rig.begin("focus", {})
            if interfere is not None:
                self._end.wait(float(self._chance.uniform(0, CYCLE_S)))
                interfere()
            answer = pending.result(PATIENCE_S)
        except ElpdError as error:
            self._refused(error)
            return
        self._ledger.counts["answers"] += 1
        self._took_ms.setdefault("focus", []).append(1e3 * (time.perf_counter() - begun_s))
        truth = answer["truth"] or {}
        self._focus_um = truth.get("focus_um") or self._focus_um
        self._ledger.ended(self._elapsed_s, answer["outcome"], truth.get("final_error_um"))

    def _timed(self, name: str, ask: Callable[[], Any]) -> Any:
        """Ask, and note how long the answer took; ``None`` where it was a refusal or a fault."""
        self._ledger.counts["requests"] += 1
        begun_s = time.perf_counter()
        try:
            answer = ask()
        except ElpdError as error:
            self._refused(error)
            return None
        self._ledger.counts["answers"] += 1
        self._took_ms.setdefault(name, []).append(1e3 * (time.perf_counter() - begun_s))
        return answer

    def _refused(self, error: ElpdError) -> None:
        self._ledger.counts["answers"] += error.kind != "Unreachable"
        self._ledger.counts[f"error {error.kind}"] += 1

    def _somewhere_um(self) -> float:
        where = 1250.0 if self._focus_um is None else self._focus_um
        return where + float(self._chance.uniform(-FAR_UM, FAR_UM))

    def _weigh(self) -> None:
        row = self._ledger.weigh(self._elapsed_s / 3600, self._process)
        row["cpu_s"] = round(processor_s(self._process) - self._used_s, 1)
        print(f"{row}  {dict(self._ledger.outcomes)}", file=sys.stderr, flush=True)

    # --- the nuisances, each in a thread of its own ---

    def _repeat(self, what: Callable[[socket.socket], None], pause_s: float) -> None:
        name = what.__name__.strip("_").replace("_", " ")
        while not self._end.wait(pause_s):
            self._nuisances[name] += 1
            with suppress(OSError), socket.socket(socket.AF_UNIX) as line:
                line.settimeout(PATIENCE_S)
                line.connect(str(self._path))
                what(line)

    def _never_read(self, line: socket.socket) -> None:
        """Subscribe to everything and read nothing until one is dropped."""
        line.sendall(b'{"id": 1, "method": "subscribe", "params": {"rate_hz": 1000}}\n')
        while not self._end.wait(1.0):
            line.sendall(b'{"id": 2, "method": "map"}\n')

    def _flood(self, line: socket.socket) -> None:
        """Ask without waiting for answers."""
        line.sendall(b"".join(b'{"id": %d, "method": "status"}\n' % number for number in range(FLOOD_LINES)))

    def _talk_nonsense(self, line: socket.socket) -> None:
        """Send what is no request, and look whether one that is gets its answer after it."""
        for words in NONSENSE:
            line.sendall(words)
        line.sendall(b'\n{"id": 77, "method": "hello"}\n')
        heard = b""
        while b'"id":77' not in heard and (more := line.recv(1 << 16)):
            heard += more
        self._nuisances["talk nonsense, then answered"] += b'"id":77' in heard

    def _come_and_go(self, line: socket.socket) -> None:
        """Ask for the status once, on a connection of its own."""
        begun_s = time.perf_counter()
        line.sendall(b'{"id": 1, "method": "status"}\n')
        if line.recv(1 << 16):
            self._took_ms.setdefault("status, newly connected", []).append(1e3 * (time.perf_counter() - begun_s))


def _server(path: Path) -> int:
    """Return the process at the other end of a socket."""
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(str(path))
        process: int = struct.unpack("3i", line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
    return process


def processor_s(process: int, *, with_children: bool = False) -> float:
    """Return how much processor time a process has used, and, if asked, the children that it has waited for."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return sum(map(int, fields[11 : 15 if with_children else 13])) / os.sysconf("SC_CLK_TCK")
