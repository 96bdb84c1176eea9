"""Structured logging, set up once by the command line; libraries just bind loggers.

One canonical event per focus cycle with every number, one debug line per window. Logs go to stderr: stdout belongs to
answers.
"""

from __future__ import annotations

import logging
import sys

import structlog


def configure(*, verbose: bool = False, as_json: bool = False) -> None:
    """Send log events to stderr, for people or (*as_json*) one JSON object a line."""
    renderer: structlog.typing.Processor = (
        structlog.processors.JSONRenderer() if as_json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.DEBUG if verbose else logging.WARNING),
        # Asked for each time: whoever redirects stderr (a test, a daemon's re-exec) gets the log too.
        logger_factory=lambda *_: structlog.WriteLogger(sys.stderr),
        cache_logger_on_first_use=False,
    )
