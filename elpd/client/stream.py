"""What the daemon tells unasked, as an iterator over a connection of its own."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Self

from elpd.client.link import Link
from elpd.errors import UnreachableError

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.client.shapes import Event, Reconnected

LONG_S = 3600.0
"""An iterator of events waits as long as there are none; in pieces, because every wait has an end."""

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0

RECONNECTED: Final[Reconnected] = {"event": "reconnected", "seq": 0}


class EventStream:
    """Events, from the moment of its making until it is closed. See `Client.events` for the arguments.

    Raises ``UnreachableError`` when the daemon goes and does not come back within *reconnect_s*.
    """

    def __init__(self, path: Path, params: dict[str, Any], timeout_s: float, reconnect_s: float) -> None:
        self._path = path
        self._params = params
        self._timeout_s = timeout_s
        self._reconnect_s = reconnect_s
        self._waiting: deque[Event] = deque()
        self._link: Link | None = self._subscribed(0.0)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Event:
        while not self._waiting:
            if self._link is None:
                raise StopIteration
            try:
                self._link.next_event(LONG_S)
            except UnreachableError:
                if self._waiting or self._link is None:
                    continue
                self._link.close()
                if not self._reconnect_s:
                    raise
                self._link = self._subscribed(self._reconnect_s)
                self._waiting.appendleft(RECONNECTED)
        return self._waiting.popleft()

    def close(self) -> None:
        """End the subscription; an iteration that waits in another thread ends. Idempotent."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _subscribed(self, for_s: float) -> Link:
        """Connect and subscribe, trying again for so long."""
        deadline, pause_s = time.monotonic() + for_s, FIRST_PAUSE_S
        while True:
            try:
                link = Link(self._path, self._timeout_s, self._waiting.append)
                try:
                    link.begin("subscribe", self._params).result(self._timeout_s)
                except BaseException:
                    link.close()
                    raise
            except UnreachableError:
                if time.monotonic() + pause_s > deadline:
                    raise
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                return link
