"""A long run of the daemon with everything that breaks: a day in virtual time, or an hour of a service that runs.

    python tools/soak.py                                   a day on the simulated rig, the seed 1, 500 cycles
    python tools/soak.py --hours 2 --cycles 0 --seed 7     less of another one
    python tools/soak.py --service SOCKET --hours 1        a service that runs, over its socket, in real time
    python tools/soak.py --json                            the figures as one object

The day: continuous autofocus, focus knocked away, people who ask for things, cables that are pulled, boards that are
reset, a process that is stopped for a while, hangs or is killed, a configuration that is read again, a disk that is
full. The hour: requests for focus, STOPs in the midst of them, clients that flood, do not read, talk nonsense or go
away. Every request has exactly one answer, the lens stays inside its limits, and memory does not grow; the figures tell
how many cycles found focus and how far from the truth.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import structlog
from soaks.day import Day
from soaks.hour import Hour

from elpd import log


def main() -> int:
    """Run; exit 1 if something did not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, help="24, or 1 with --service")
    parser.add_argument("--cycles", type=int, default=500, help="go on until there were so many (the day)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--service", type=Path, help="the socket of a running `elpd serve` on the simulated rig")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    if chosen.service is not None and not chosen.service.is_socket():
        parser.error(
            f"{chosen.service} is no socket: start `elpd serve --config sim` first, which says where it listens"
        )
    log.configure()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(40))
    figures = _day(chosen) if chosen.service is None else _hour(chosen)
    if chosen.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            _print(name, value)
    return 0


def _day(chosen: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as directory:
        day = Day(chosen.seed, Path(directory))
        _end_early(day)
        day.run(24.0 if chosen.hours is None else chosen.hours, chosen.cycles)
        day.finish()
        return day.figures()


def _hour(chosen: argparse.Namespace) -> dict[str, Any]:
    hour = Hour(chosen.service, chosen.seed)
    _end_early(hour)
    hour.run(1.0 if chosen.hours is None else chosen.hours)
    return hour.figures()


def _end_early(run: Day | Hour) -> None:
    """Let Ctrl-C and SIGTERM end a run in order, with the figures so far."""

    def enough(*_: object) -> None:
        run.enough = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, enough)


def _print(name: str, value: Any) -> None:
    if isinstance(value, list):
        for row in value:
            print(f"{name:22s} {row}")
    else:
        print(f"{name:22s} {value}")


if __name__ == "__main__":
    sys.exit(main())
