"""What a daemon costs that does nothing: ``python tools/idle_cost.py [--seconds 20] [--cold] [--json]``.

Printed, not asserted. Each row is an `elpd serve` of its own. *Start*: from its call to READY, in seconds of the wall
clock and of processor time, with kernels from the cache or (cold) compiled anew, by two processes beside it whose time
counts with it. *Idle*: processor time in per cent of one core, for so many seconds in which nobody asks, and with one
client that listens to all events and asks for the status twice a second. *Memory*, MB, once READY: resident, of which
private to this process (the rest is the files of libraries, shared and given back when memory is short).

The simulated rig computes its world in the same process. `recording` is a rig without one: a resting sensor's noise as
the camera, at its own pace in packets of a millisecond, and a simulated Tic behind a pty, in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from soaks.hour import processor_s
from soaks.ledger import memory_mb

from elpd.client import Client

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

WIDTH, HEIGHT, NOISE_HZ, RECORDED_S = 1280, 720, 0.05, 120.0
SETTLED_S = 2.0
ASKED_EVERY_S = 0.5


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--cold", action="store_true", help="compile the kernels anew, once; takes a minute")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [cost("sim", folder, asked.seconds, {"NUMBA_CACHE_DIR": str(folder / "cache")})] if asked.cold else []
        rows.append(cost("sim", folder, asked.seconds))
        with board(folder) as port:
            noise(folder / "noise.npy")
            hardware = (
                'rig="hardware"', "camera.driver=file", f"camera.path={folder / 'noise.npy'}", "lens.driver=tic",
                f"camera.width={WIDTH}", f"camera.height={HEIGHT}", f"lens.port={port}", "lens.reply_ms=2000",
                "aperture.driver=none",
            )  # fmt: skip
            rows.append(cost("recording", folder, asked.seconds, None, *hardware))
            rows.append(cost("recording, continuous", folder, asked.seconds, None, *hardware, "modes.start=continuous"))
    if asked.cold:
        rows[0]["name"] = "sim, cold"
    if asked.json:
        print(json.dumps({"rows": rows}))
        return 0
    print("                         start s        idle, % of a core    MB at READY")
    print("                         wall   cpu     alone  watched       rss  private   rss after idling")
    for row in rows:
        print(
            f"{row['name']:22s} {row['start_s']:6.2f} {row['start_cpu_s']:5.2f}    {row['idle_percent']:6.1f} "
            f"{row['watched_percent']:8.1f}    {row['ready']['rss']:6.0f} {row['ready']['uss']:8.0f} "
            f"{row['idled']['rss']:12.0f}"
        )
    return 0


def cost(
    name: str, folder: Path, seconds: float, environment: dict[str, str] | None = None, *settings: str
) -> dict[str, Any]:
    """Run a daemon and return what it costs."""
    with daemon(folder, environment or {}, settings) as (process, path, start_s):
        start_cpu_s = processor_s(process, with_children=True)
        row: dict[str, Any] = {"name": name, "start_s": start_s, "start_cpu_s": start_cpu_s}
        row["ready"] = memory_mb(process)
        time.sleep(SETTLED_S)
        row["idle_percent"] = _percent(process, seconds, time.sleep)
        with Client(path) as client, closing(client.events()) as events:
            iter(events)

            def watch(left_s: float) -> None:
                client.status()
                time.sleep(min(left_s, ASKED_EVERY_S))

            row["watched_percent"] = _percent(process, seconds, watch)
        row["idled"] = memory_mb(process)
    return row


def _percent(process: int, seconds: float, do: Callable[[float], None]) -> float:
    """Return a process's share of a core while *do* is done again and again."""
    begun_s, used_s = time.monotonic(), processor_s(process)
    while (left_s := begun_s + seconds - time.monotonic()) > 0:
        do(left_s)
    return round(100 * (processor_s(process) - used_s) / (time.monotonic() - begun_s), 2)


@contextmanager
def daemon(folder: Path, environment: dict[str, str], settings: tuple[str, ...]) -> Iterator[tuple[int, Path, float]]:
    """Run one; yields its process, its socket and how long it took to be ready."""
    path = folder / "elpd.sock"
    where = (f"api.socket={path}", f"journal.directory={folder / 'runs'}", f"state.directory={folder / 'state'}")
    words = [word for setting in (*where, *settings) for word in ("--set", setting)]
    begun_s = time.monotonic()
    command = [sys.executable, "-m", "elpd", "serve", "--json", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, **environment})  # noqa: S603  (our own)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid, path, round(time.monotonic() - begun_s, 2)
    finally:
        process.terminate()
        process.wait(10.0)


@contextmanager
def board(folder: Path) -> Iterator[str]:
    """Run a simulated controller; yields its port."""
    del folder
    process = subprocess.Popen(
        [sys.executable, "-m", "elpd", "sim-board", "tic", "--json"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["port"]
    finally:
        process.terminate()
        process.wait(10.0)


def noise(path: Path) -> None:
    """Write a recording of a sensor at rest before a scene at rest."""
    chance = np.random.default_rng(1)
    count = round(NOISE_HZ * WIDTH * HEIGHT * RECORDED_S)
    events = np.empty(count, [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
    events["t"] = np.sort(chance.integers(0, round(1e6 * RECORDED_S), count))
    events["x"], events["y"] = chance.integers(WIDTH, size=count), chance.integers(HEIGHT, size=count)
    events["p"] = chance.integers(2, size=count)
    np.save(path, events)


if __name__ == "__main__":
    sys.exit(main())
