"""Talk to the elpd daemon from Python; standard library only.

::

    from elpd.client import Client

    with Client() as rig:
        answer = rig.focus(timeout_s=10)
        print(answer["outcome"], answer["focus_um"])

    with Client().events(["result", "fault"]) as events:
        for event in events:
            print(event)

`Client` waits, `AsyncClient` awaits; both have a method for each of the socket's (``tools/docs/socket.md``). What a
client promises about a lost connection:

- It connects when first used, and again when it finds before a request that the daemon has gone and come back. A lease
  does not survive that.
- A request that only reads (`status`, `runs`, ...) is asked again, once, if its answer was lost.
- A request that does something is never sent twice: its lost answer is an `UnreachableError`, and `status` tells what
  became of it.
- `events` gives up with an `UnreachableError` unless ``reconnect_s`` says how long to try; after a gap its first event
  is ``{"event": "reconnected"}``.

Errors are those of `elpd.errors`, exit codes included, by what the daemon called them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from elpd.client.link import Pending
from elpd.client.stream import EventStream
from elpd.client.sync import Client
from elpd.client.wire import socket_path

if TYPE_CHECKING:
    from elpd.client.aio import AsyncClient

__all__ = ["AsyncClient", "Client", "EventStream", "Pending", "socket_path"]


def __getattr__(name: str) -> Any:
    """Import asyncio (three times the cost of all the rest) only for those who await."""
    if name == "AsyncClient":
        from elpd.client.aio import AsyncClient  # noqa: PLC0415

        return AsyncClient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
