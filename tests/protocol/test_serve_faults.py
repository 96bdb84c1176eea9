"""The daemon as a process on a bad day: the wall clock jumps, the disk is full. Nothing here is timed."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest
from served import Served, serving_in

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

WALL_CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

/* The wall clock, put forward by the seconds that a file holds; every other clock as it is. */
int clock_gettime(clockid_t clock, struct timespec *now)
{
    static int (*real)(clockid_t, struct timespec *);
    static int file = -1;
    char text[32] = "";
    if (!real) real = (int (*)(clockid_t, struct timespec *)) dlsym(RTLD_NEXT, "clock_gettime");
    int done = real(clock, now);
    if (file < 0) file = open(getenv("WALL_CLOCK"), O_RDONLY | O_CLOEXEC);
    if (clock == CLOCK_REALTIME && file >= 0 && pread(file, text, sizeof text - 1, 0) > 0) now->tv_sec += atol(text);
    return done;
}
"""
TWO_YEARS_S, AN_HOUR_S = 2 * 365 * 86400, 3600


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Served]]:
    with serving_in(tmp_path) as begin:
        yield begin


@pytest.fixture
def wall_clock(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """A file that sets the wall clock of whatever runs in this environment."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed; tools/packages installs it")
    source, library, offset = tmp_path / "clock.c", tmp_path / "clock.so", tmp_path / "offset"
    source.write_text(WALL_CLOCK)
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"], check=True)
    offset.write_text("0" + 31 * " ")
    return offset, {"LD_PRELOAD": str(library), "WALL_CLOCK": str(offset)}


def set_clock(offset: Path, seconds: int) -> None:
    with offset.open("r+") as file:
        file.write(f"{seconds:<31d}")


def test_a_wall_clock_that_jumps_changes_nothing(
    serve: Callable[..., Served], wall_clock: tuple[Path, dict[str, str]]
) -> None:
    offset, environment = wall_clock
    daemon = serve("sim.pace=0.2", **environment)
    watcher, asker = daemon.connect(), daemon.connect()
    held = asker.call("lease", action="acquire", seconds=600)["result"]["until_s"]
    watcher.call("subscribe", events=["phase"])
    asker.send("focus")
    watcher.until("phase", phase="probe")
    set_clock(offset, TWO_YEARS_S)
    watcher.until("phase", phase="sweep")
    set_clock(offset, -AN_HOUR_S)
    result = asker.receive()["result"]
    assert result["outcome"] == "FOCUSED", result["reason"]
    assert abs(result["truth"]["final_error_um"]) < 6.0
    status = daemon.connect().call("status")["result"]
    assert (status["state"], status["fault"]) == ("READY", None)
    assert 0 < status["lease"]["until_s"] <= held
    assert status["uptime_s"] < AN_HOUR_S
    assert daemon.end() == 0
    lines = [json.loads(line) for line in (daemon.folder / "log.jsonl").read_text().splitlines()]
    assert lines[-1]["timestamp"] < lines[0]["timestamp"], "it was put back, and the log says so"
    steady = [line["monotonic_ns"] for line in lines]
    assert steady == sorted(steady)


@pytest.mark.parametrize(
    ("room", "told"),
    [("size=200m,nr_inodes=3", "No space left on device"), ("size=2m", "needed with the reserve")],
    ids=["full", "reserve"],
)
def test_a_disk_that_is_full_costs_the_record_and_the_daemon_goes_on(
    serve: Callable[..., Served], tmp_path: Path, room: str, told: str
) -> None:
    if subprocess.run(["unshare", "-m", "true"], capture_output=True, check=False).returncode:
        pytest.skip("no mounts of our own here")
    full = tmp_path / "full"
    full.mkdir()
    mounting = f'mount -t tmpfs -o {room} tmpfs "{full}" && exec "$@"'
    daemon = serve(
        f"journal.directory={full}/runs",
        f"state.directory={full}/state",
        before=("unshare", "-m", "sh", "-c", mounting, "sh"),
    )
    connection = daemon.connect()
    for _ in range(2):
        result = connection.call("focus")["result"]
        assert result["outcome"] == "FOCUSED", result["reason"]
    if "inodes" in room:
        connection.call("roi", set={"x": 0, "y": 0, "width": 64, "height": 64})
        codes = {warned["code"] for warned in connection.call("status")["result"]["warnings"]}
        assert "state-not-saved" in codes
    assert connection.call("status")["result"]["state"] == "READY"
    assert daemon.end() == 0
    log = (daemon.folder / "log.jsonl").read_text()
    assert "journal truncated; focus goes on" in log
    assert told in log
