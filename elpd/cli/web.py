"""`elpd web`: the page, in a process of its own that talks to the daemon's socket and to nothing else."""

from __future__ import annotations

import asyncio
import signal
import sys
from contextlib import suppress
from pathlib import Path
from socket import AddressFamily, create_server
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.client import socket_path
from elpd.config import load
from elpd.errors import BusyError, ConfigError, UsageError
from elpd.web.security import Gate, is_loopback, own_hosts
from elpd.web.token import read_or_make_token, read_token, token_path

if TYPE_CHECKING:
    from elpd.config import WebSection


@click.command("web")
@click.option("--socket", type=click.Path(path_type=Path), help="The daemon's socket.")
@click.option("--link", is_flag=True, help="Print the address of a running gateway, with the token, and end.")
@config_options
@json_option
def command(
    *, socket: Path | None, link: bool, config_path: Path | None, overrides: tuple[str, ...], as_json: bool
) -> int:
    """Serve the page until interrupted, and print its address.

    The address carries a token in its fragment: whoever has it may move the lens. Where stdout is not a terminal (a
    journal, a file) the address is printed without it; `elpd web --link` prints it for the user who may read the file.
    """
    config = load(config_path, overrides)
    _check_hosts(config.web)
    if link:
        token, path = read_token(config.web.token_file)
        address = f"{_address(config.web, config.web.port)}#token={token}"
        if as_json:
            print_json({"address": address, "token_file": path})
        else:
            print(address)
        return 0
    path = token_path(config.web.token_file)
    token = read_or_make_token(path)

    _serve(config.web, socket_path(socket or config.api.socket), token, path, as_json=as_json)
    return 0


def _serve(settings: WebSection, socket: Path, token: str, token_file: Path, *, as_json: bool) -> None:
    try:
        from elpd.web.gateway import build_app, serve  # noqa: PLC0415
    except ImportError as error:
        raise UsageError(f"the page needs {error.name}: pip install 'elpd[web]'") from None
    try:
        listening = create_server((settings.host, settings.port), family=_family(settings.host))
    except OSError as error:
        raise BusyError(
            f"{settings.host}:{settings.port}: {error.strerror or error}; set web.host and web.port to what is free"
        ) from None
    port = listening.getsockname()[1]
    gate = Gate(own_hosts(settings.host, port, settings.allowed_hosts), token)
    _tell(_address(settings, port), token, token_file, as_json=as_json)

    async def run() -> None:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        for ending in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(ending, task.cancel)
        with suppress(asyncio.CancelledError):
            await serve(build_app(socket, gate), listening)

    asyncio.run(run())


def _tell(address: str, token: str, token_file: Path, *, as_json: bool) -> None:
    """Print where the page is. The token goes to a terminal only: what else stdout may be keeps what it is told."""
    if as_json:
        print_json({"address": address, "token_file": token_file})
    elif sys.stdout.isatty():
        print(f"{address}#token={token}")
    else:
        print(f"{address}  (the token: elpd web --link, or {token_file})")
    sys.stdout.flush()


def _address(settings: WebSection, port: int) -> str:
    """Return what to open: the first of the allowed hosts where the loopback is not served."""
    if is_loopback(settings.host):
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        return f"http://{host}:{port}/"
    return f"http://{settings.allowed_hosts[0]}/"


def _check_hosts(settings: WebSection) -> None:
    if not is_loopback(settings.host) and not settings.allowed_hosts:
        raise ConfigError(
            f"web.host is {settings.host}, which other machines reach, but web.allowed_hosts is empty: every browser "
            "would be refused; list what they call this machine, with the port"
        )


def _family(host: str) -> AddressFamily:
    return AddressFamily.AF_INET6 if ":" in host else AddressFamily.AF_INET
