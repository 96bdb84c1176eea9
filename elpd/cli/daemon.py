"""What commands share that talk to the daemon: finding it, its options, waiting for its answer with Ctrl-C at hand.

Nothing heavy is imported here: a command that goes to the daemon is a line out and a line in, and should feel like it.
"""

from __future__ import annotations

import signal
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from elpd.cli.common import config_options, json_option
from elpd.client import Client, socket_path
from elpd.errors import BusyError, UnreachableError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from elpd.client import Pending

F = TypeVar("F", bound="Callable[..., Any]")

LONGEST_S = 3600.0
"""A command waits for its answer as long as the daemon's own deadlines let that take; this is only an end to it."""


def socket_option(function: F) -> F:
    """Add ``--socket PATH`` (as ``socket``)."""
    return click.option(
        "--socket",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="PATH",
        help="The daemon's socket, if it is not where it usually is; or set ELPD_SOCKET.",
    )(function)


def daemon_options(function: F) -> F:
    """Add the options of a command that only a daemon can answer; of a configuration, ``api.socket`` counts."""
    return socket_option(config_options(json_option(function)))


def reach(*, socket: Path | None, config_path: Path | None = None, overrides: tuple[str, ...] = ()) -> Client:
    """Return a client of a daemon that answers, closed with the command. Raises ``UnreachableError`` if none does."""
    if socket is None and (config_path or overrides):
        from elpd.config import load  # noqa: PLC0415  (pydantic, only for those who name a configuration)

        socket = load(config_path, overrides).api.socket
    client = Client(socket)
    click.get_current_context().call_on_close(client.close)
    client.hello()
    return client


def daemon_unless(
    *, foreground: bool, config_path: Path | None, overrides: tuple[str, ...], socket: Path | None
) -> Client | None:
    """Return the daemon's client, or ``None`` where a rig was named that is to be worked from this process.

    Raises ``BusyError`` when no daemon answers, ``UsageError`` for both at once.
    """
    if foreground or config_path or overrides:
        if socket is not None:
            raise UsageError(
                "--socket goes to a daemon, and --foreground, --config and --set work from here; choose one"
            )
        return None
    try:
        return reach(socket=socket)
    except UnreachableError as error:
        raise BusyError(
            f"{error}; or work from this process with --foreground (the simulated rig), --config FILE "
            "or --set KEY=VALUE"
        ) from None


@contextmanager
def naming_the_holder() -> Iterator[None]:
    """Where another program holds the lens and a daemon runs, say which process that is."""
    try:
        yield
    except BusyError as error:
        from elpd.service.listening import holder_pid  # noqa: PLC0415  (only for the message)

        pid = holder_pid(socket_path())
        if pid is None:
            raise
        raise BusyError(f"{error}; a daemon runs (process {pid}): leave out --foreground, or stop it") from None


def ask(client: Client, method: str, params: dict[str, Any]) -> Any:
    """Ask and wait; Ctrl-C cancels what was asked for and still tells how it ended, a second one gives up."""
    pending: Pending | None = None
    pressed = False

    def cancel(*_: object) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, previous)
        if pending is not None:
            pending.cancel()

    previous = signal.signal(signal.SIGINT, cancel)  # before anything is asked: no press is lost
    try:
        pending = client.begin(method, params)
        if pressed:
            pending.cancel()
        return pending.result(LONGEST_S)
    finally:
        signal.signal(signal.SIGINT, previous)
