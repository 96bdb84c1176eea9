"""What every command shares: its options, its JSON, its way of failing."""

from __future__ import annotations

import json
import signal
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from elpd.errors import UsageError
from elpd.records import Geometry, Roi

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from elpd.config import Config

MAX_SIDE = 2048
"""The most pixels of any sensor's side: addresses have 11 bits."""

F = TypeVar("F", bound="Callable[..., Any]")


def config_options(function: F) -> F:
    """Add ``--config FILE`` and ``--set KEY=VALUE`` (as ``config_path`` and ``overrides``)."""
    function = click.option(
        "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Any config key, such as sim.seed=3; repeatable."
    )(function)
    return click.option(
        "--config", "config_path", type=click.Path(path_type=Path, dir_okay=False), help="A TOML configuration file."
    )(function)


def json_option(function: F) -> F:
    """Add ``--json`` (as ``as_json``)."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else on stdout.")(
        function
    )


def print_json(answer: dict[str, Any]) -> None:
    """Print one object; NaN never leaves (``null`` does)."""
    print(json.dumps(_plain(answer), allow_nan=False), flush=True)


def report_error(kind: str, message: str, *, as_json: bool) -> None:
    """Tell a person on stderr and, where asked for, a program on stdout."""
    if as_json:
        print_json({"outcome": None, "error": {"kind": kind, "message": message}})
    print(f"elpd: {message}", file=sys.stderr)


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C into an answer: a cycle asks whether it was cancelled, stops the lens, and ends with a result."""
    cancelled = threading.Event()
    previous = signal.signal(signal.SIGINT, lambda *_: cancelled.set())
    try:
        yield cancelled.is_set
    finally:
        signal.signal(signal.SIGINT, previous)


def run_folder(run: Path, config: Config) -> Path:
    """Return the folder of a run that was named as a person does: by its path, or as `elpd runs` lists it."""
    kept = config.journal.directory / run
    return kept if not run.exists() and kept.exists() else run


def parse_roi(text: str | None) -> Roi | None:
    """Read ``X,Y,W,H``. Whether it fits the sensor is for those to say who know the sensor."""
    if text is None:
        return None
    try:
        x, y, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"a region is X,Y,W,H in whole pixels, such as 100,80,200,200; got {text!r}") from None
    return Roi(x, y, width, height)


def parse_size(text: str | None) -> Geometry | None:
    """Read ``W,H``, a sensor's size."""
    if text is None:
        return None
    try:
        width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--size is W,H in whole pixels, such as 346,260; got {text!r}") from None
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise UsageError(f"--size {width},{height}: a sensor has 1 to {MAX_SIDE} pixels each way")
    return Geometry(width, height)


def parse_interval_us(text: str | None, option: str) -> tuple[int, int] | None:
    """Read ``A,B`` in microseconds, A before B."""
    if text is None:
        return None
    try:
        begin, end = (int(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"{option} is A,B in whole microseconds; got {text!r}") from None
    if end <= begin:
        raise UsageError(f"{option} must end after it begins; got {begin},{end}")
    return begin, end


def _plain(value: Any) -> Any:
    """Turn numpy scalars, paths and non-finite numbers into what JSON has."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item") and not isinstance(value, (str, bytes)):
        value = value.item()
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):  # noqa: PLR0124
        return None
    return value
