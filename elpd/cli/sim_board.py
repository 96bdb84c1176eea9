"""``elpd sim-board``: a simulated lens controller on a pty, for any program that speaks its protocol.

The board is found through the entry-point group ``elpd.boards``, so that a stranger's board is served the same way.
Only the path goes to stdout. The signals that end it are waited for, not handled: nothing runs in a handler.
"""

from __future__ import annotations

import signal
import sys
import tomllib
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, cast

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.ports import Board

_ENDING = (signal.SIGINT, signal.SIGTERM)


@click.command()
@click.argument("board")
@config_options
@json_option
def command(board: str, config_path: Path | None, overrides: tuple[str, ...], *, as_json: bool) -> None:
    """Serve a simulated BOARD (grbl, tic, ...) on a pty until interrupted.

    Settings stand in the table [board] of the configuration, and on the command line as --set KEY=VALUE: what the lens
    is like (travel_um, backlash_um, start_um, ...), how the board is set up (referenced, baud, ...), and seed.
    """
    settings = board_settings(config_path, overrides)
    served = find_board(board)
    # a shell's background jobs ignore SIGINT; this one must not
    signal.signal(signal.SIGINT, signal.default_int_handler)
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
    """Read the table ``[board]`` and the overrides upon it. Raises ``ConfigError``."""
    settings: dict[str, Any] = {}
    if config_path is not None:
        try:
            table = tomllib.loads(config_path.read_text())
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise ConfigError(f"{config_path}: {error}") from None
        settings.update(table.get("board", {}))
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals:
            raise ConfigError(f"--set is KEY=VALUE, such as board.start_um=800; got {override!r}")
        settings[key.strip().removeprefix("board.").removeprefix("sim.")] = _value(text.strip())
    return settings


def _value(text: str) -> Any:
    """Read a TOML value; what is none is a plain string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
