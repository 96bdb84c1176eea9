"""``elpd sim-board``: a simulated lens controller on a pty, for any program that speaks its protocol.

The board is found through the entry-point group ``elpd.boards``, so that a stranger's board is served the same way.
Only the path goes to stdout. The signals that end it are waited for, not handled: nothing runs in a handler.
"""

from __future__ import annotations

import os
import signal
import sys
import tomllib
from contextlib import suppress
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, cast

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.config import Config, load
from elpd.errors import UsageError
from elpd.undisturbed import undisturbed

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.ports import Board

_ENDING = (signal.SIGINT, signal.SIGTERM)


@click.command()
@click.argument("board")
@config_options
@json_option
@undisturbed()  # to look through the hundred thousand objects of a lens's history holds replies up by 50 ms and more
def command(board: str, config_path: Path | None, overrides: tuple[str, ...], *, as_json: bool) -> None:
    """Serve a simulated BOARD (grbl, tic, tmcl, zaber, ...) on a pty until interrupted.

    Its settings are given as --set board.KEY=VALUE: what the lens is like (travel_um, backlash_um, start_um, ...) and
    how the board is set up (referenced, baud, ...). From the configuration it takes sim.seed and lens.um_per_step.
    """
    settings = board_settings(config_path, overrides)
    served = find_board(board)
    # a shell's background jobs ignore SIGINT; this one must not
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with suppress(PermissionError):  # what it plays does not wait for whoever is busy on this machine
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    # blocked before the serving thread exists, so that it inherits the mask and this thread gets the signal
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        running = served.serve(settings)
        try:
            if as_json:
                print_json({"port": running.port})
            else:
                print(running.port)
                print(f"a simulated {board} board, until interrupted", file=sys.stderr)
            sys.stdout.flush()
            signal.sigwait(_ENDING)
        finally:
            running.close()
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)


def find_board(name: str) -> Board:
    """Load the board that is registered as *name*. Raises ``UsageError`` with those that are."""
    found = {point.name: point for point in entry_points(group="elpd.boards")}
    if name not in found:
        raise UsageError(f"there is no simulated board {name!r}; known are {', '.join(sorted(found)) or 'none'}")
    return cast("Board", found[name].load())


def board_settings(config_path: Path | None, overrides: tuple[str, ...]) -> dict[str, Any]:
    """Return the board's settings: the config's seed and ruler, then the overrides that are not the config's.

    Raises ``ConfigError`` for what is neither; the board itself refuses keys that it does not know.
    """
    own = tuple(item for item in overrides if _is_boards(item))
    config = load(config_path, [item for item in overrides if item not in own])
    settings: dict[str, Any] = {"seed": config.sim.seed, "um_per_step": config.lens.um_per_step}
    for override in own:
        key, _, text = override.partition("=")
        settings[key.strip().removeprefix("board.")] = _value(text.strip())
    return settings


def _is_boards(override: str) -> bool:
    """Say whether an override is for the board: ``board.KEY=VALUE``, or a key of one word that is no config table."""
    key, equals, _ = override.partition("=")
    name = key.strip()
    return bool(equals) and (name.startswith("board.") or ("." not in name and name not in Config.model_fields))


def _value(text: str) -> Any:
    """Read a TOML value; what is none is a plain string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
