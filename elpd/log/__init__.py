"""Structured logging, set up once by the command line; libraries just bind loggers.

One canonical event per focus cycle with every number, one debug line per window. Event names are stable words
(tools/docs/events.md); whatever varies is a field. Logs go to stderr, or, under systemd, to the journal with a field of
its own for every value, and where a file is named, to that as JSON lines; stdout belongs to answers. Each line holds
the wall clock, for people, and the monotonic clock, which nobody sets: a clock that is put back an hour does not
reorder a log.
"""

from __future__ import annotations

import logging
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

import structlog

from elpd.log import journald
from elpd.log.files import JsonLines
from elpd.log.limits import Limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from structlog.typing import EventDict, WrappedLogger

LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40, "critical": 50}


@dataclass(frozen=True, slots=True)
class Sink:
    """Where lines of at least *level* go."""

    level: int
    write: Callable[[EventDict], None]
    close: Callable[[], None] = lambda: None


def configure(
    *,
    verbose: bool = False,
    file: Path | None = None,
    environment: Mapping[str, str] | None = None,
    wall_ns: Callable[[], int] = time.time_ns,
    monotonic_ns: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Send log events where they are read.

    Parameters
    ----------
    verbose
        Debug lines too. Else the journal and the file get what is of interest later (info), a person only warnings.
    file
        Gets JSON lines; it is rotated, see ``files``. Raises ``OSError`` where it cannot be written.
    environment
        The process's own unless given; its ``JOURNAL_STREAM`` says whether stderr is the journal.
    wall_ns, monotonic_ns
        The clocks of the lines.

    """
    quiet = logging.DEBUG if verbose else logging.WARNING
    telling = logging.DEBUG if verbose else logging.INFO
    journal = journald.Journal.if_stderr_is_it(environment)
    sinks = [Sink(quiet, Console()) if journal is None else Sink(telling, journal, journal.close)]
    if file is not None:
        lines = JsonLines(file)
        sinks.append(Sink(telling, lines, lines.close))
    _close_previous()
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            BothClocks(wall_ns, monotonic_ns),
            Limits(),
            Fan(sinks),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(min(sink.level for sink in sinks)),
        cache_logger_on_first_use=False,
    )


class BothClocks:
    """Stamps each line with ``timestamp`` (ISO 8601, UTC, to the us) and ``monotonic_ns``."""

    def __init__(self, wall_ns: Callable[[], int], monotonic_ns: Callable[[], int]) -> None:
        self._wall_ns = wall_ns
        self._monotonic_ns = monotonic_ns

    def __call__(self, _: WrappedLogger, __: str, event: EventDict) -> EventDict:
        """Stamp a line."""
        seconds, nanoseconds = divmod(self._wall_ns(), 10**9)
        date = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))
        event["timestamp"] = f"{date}.{nanoseconds // 1000:06d}Z"
        event["monotonic_ns"] = self._monotonic_ns()
        return event


class Fan:
    """Hands each line to every sink that wants it; the last of the processors."""

    def __init__(self, sinks: list[Sink]) -> None:
        self._sinks = sinks

    def __call__(self, _: WrappedLogger, __: str, event: EventDict) -> NoReturn:
        """Hand out a line; nothing comes after."""
        level = LEVELS[event["level"]]
        for sink in self._sinks:
            if level >= sink.level:
                sink.write(dict(event))
        raise structlog.DropEvent

    def close(self) -> None:
        """Close what is open."""
        for sink in self._sinks:
            sink.close()


class Console:
    """Lines for people, on stderr; asked for each time, because a test or a daemon may put another in its place."""

    def __init__(self) -> None:
        self._render = structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())

    def __call__(self, event: EventDict) -> None:
        """Write a line."""
        event.pop("monotonic_ns", None)
        sys.stderr.write(f"{self._render(None, '', event)}\n")


def _close_previous() -> None:
    for processor in structlog.get_config()["processors"]:
        if isinstance(processor, Fan):
            processor.close()
