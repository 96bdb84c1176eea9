"""How long a STOP takes through the socket of a real daemon on the simulated rig, at rest and in mid-sweep.

    python tools/api_latency.py [--trials 30] [--json]

Printed is the time from the client's write to its reading of the answer, which the daemon sends after the STOP's bytes
have left for the lens; so the way out is shorter than that. Under `load`, two clients listen to every sample, one asks
for the status as fast as it is answered, and one never reads. The simulated world is computed in the daemon's process,
which a real camera does not do.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elpd.client import Client
from elpd.errors import ElpdError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from elpd.client import Pending

RIG = ("sim.width=320", "sim.height=240", "sim.scene=camera", "sim.seed=3", "sim.pace=1", "journal.enabled=false")
ANSWER_S = 60.0
ATTEMPTS = 3
"""Times as many as trials are asked for."""


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, daemon(Path(folder)) as path:
        rows = [measured("at rest", path, asked.trials, moving=False)]
        rows.append(measured("in mid-sweep", path, asked.trials, moving=True))
        with load(path):
            rows.append(measured("at rest, load", path, asked.trials, moving=False))
            rows.append(measured("in mid-sweep, load", path, asked.trials, moving=True))
        with Client(path) as client:
            counters = client.status()["counters"]
    if asked.json:
        print(json.dumps({"rows": rows, "counters": counters}))
        return 0
    for row in rows:
        p50, p90, most = (row[f"{name}_us"] for name in ("p50", "p90", "max"))
        print(
            f"{row['name']:20s} {row['trials']:3d} times   p50 {p50:6.0f} us   p90 {p90:6.0f} us   max {most:6.0f} us"
        )
    print(f"events that were dropped: {counters['dropped_events']}")
    return 0


def measured(name: str, path: Path, trials: int, *, moving: bool) -> dict[str, Any]:
    """Stop the rig so often; return the distribution of the answers' times."""
    took_us: list[float] = []
    why = ""
    with Client(path, timeout_s=ANSWER_S) as rig, Client(path, timeout_s=ANSWER_S) as stopper:
        stopper.hello()
        for _ in range(ATTEMPTS * trials):
            if len(took_us) == trials:
                break
            try:
                cycle = swept(rig) if moving else None
                begun_ns = time.perf_counter_ns()
                stopper.stop()
                took_us.append((time.perf_counter_ns() - begun_ns) / 1e3)
                if cycle is not None:
                    cycle.result(ANSWER_S)
            except ElpdError as error:  # a machine too busy to compute the world in time; the daemon latches that
                why = str(error)
                rig.clear()
                rig.home()
    if not took_us:
        raise SystemExit(f"{name}: not one trial in {ATTEMPTS * trials} came through; the last: {why}")
    took_us.sort()
    return {
        "name": name,
        "trials": len(took_us),
        "p50_us": took_us[len(took_us) // 2],
        "p90_us": took_us[int(0.9 * (len(took_us) - 1))],
        "max_us": took_us[-1],
    }


def swept(rig: Client) -> Pending:
    """Begin a cycle, and return once it sweeps."""
    rig.move(fraction=0.3)
    with rig.events(["phase", "result", "fault"]) as told:
        cycle = rig.begin("focus")
        while (event := next(told))["event"] == "phase" and event["phase"] != "sweep":
            pass
    return cycle


@contextmanager
def daemon(folder: Path) -> Iterator[Path]:
    """Run `elpd serve` until this is left."""
    path = folder / "elpd.sock"
    keys = (*RIG, f"api.socket={path}", f"state.directory={folder}", f"journal.directory={folder}")
    options = [part for key in keys for part in ("--set", key)]
    command = [sys.executable, "-c", "from elpd.cli import main; main()", "serve", "--json", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603  (our own command)
        try:
            assert process.stdout is not None
            if not process.stdout.readline():
                raise SystemExit("the daemon did not begin; see its messages above")
            yield path
        finally:
            process.terminate()


@contextmanager
def load(path: Path) -> Iterator[None]:
    """Let other clients keep the socket busy."""
    ended = threading.Event()

    def listen() -> None:
        with suppress(ElpdError), Client(path).events(rate_hz=1000) as events:
            for _ in events:
                if ended.is_set():
                    return

    def ask() -> None:
        with Client(path, timeout_s=ANSWER_S) as client:
            while not ended.is_set():
                client.status()

    def begin_and_never_read() -> None:
        with Client(path) as client:
            client.call("subscribe", {"rate_hz": 1000})
            ended.wait()

    threads = [threading.Thread(target=work, daemon=True) for work in (listen, listen, ask, begin_and_never_read)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()


if __name__ == "__main__":
    sys.exit(main())
