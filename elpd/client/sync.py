"""The client that waits."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Literal, Self

from elpd.client.link import Link, NotSentError, Pending, TimeUpError
from elpd.client.methods import Methods
from elpd.client.stream import EventStream
from elpd.client.wire import READS, given, patience_s, socket_path
from elpd.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from elpd.client.shapes import Event, FocusAnswer, RoiBox

CANCEL_S = 2.0
"""A cycle that is cancelled stops its lens and answers well within this."""


class Client(Methods):
    """A daemon to talk to; may be shared by threads.

    Parameters
    ----------
    path
        The daemon's socket; found (``socket_path``) if not given.
    timeout_s
        How long an answer may take that the daemon gives at once.

    Raises from every method what the daemon answers, as the errors of `elpd.errors`, and ``UnreachableError`` where no
    answer comes.

    """

    def __init__(self, path: str | Path | None = None, *, timeout_s: float = 5.0) -> None:
        self.path = socket_path(path)
        self.timeout_s = timeout_s
        self._link: Link | None = None
        self._linking = threading.Lock()

    def close(self) -> None:
        """End the connection; the next call makes a new one."""
        with self._linking:
            if self._link is not None:
                self._link.close()
            self._link = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- any method -----------------------------------------------------------------------------------------------

    def call(self, method: str, params: dict[str, Any] | None = None, timeout_s: float | None = None) -> Any:
        """Ask for *method* and return its result.

        One that only reads is asked once more if the connection ends before its answer has come.
        """
        timeout_s = patience_s(method, params, self.timeout_s) if timeout_s is None else timeout_s
        try:
            return self.begin(method, params).result(timeout_s)
        except TimeUpError:
            raise
        except UnreachableError:
            if method not in READS or self._alive():
                raise
        return self.begin(method, params).result(timeout_s)

    def begin(
        self,
        method: str,
        params: dict[str, Any] | None = None,
        on_event: Callable[[Any], None] | None = None,
    ) -> Pending:
        """Send a request and return at once; connect first where there is no connection any more.

        With *on_event*, events that were subscribed to on this connection go there while anybody waits.
        """
        link = self._linked()
        link.on_event = on_event or link.on_event
        try:
            return link.begin(method, params or {})
        except NotSentError:
            self.close()
        link = self._linked()
        link.on_event = on_event
        return link.begin(method, params or {})

    # --- with a patience of their own -------------------------------------------------------------------------------

    def focus(
        self,
        roi: RoiBox | None = None,
        reference: str | None = None,
        preset: str | None = None,
        on_disconnect: Literal["finish", "cancel"] = "finish",
        *,
        dry_run: bool = False,
        timeout_s: float = 60.0,
        on_event: Callable[[Event], None] | None = None,
    ) -> FocusAnswer:
        """Run one cycle and return how it ended.

        After *timeout_s*, and on Ctrl-C, it is cancelled, and its lens stopped, before this returns: then with the
        outcome ``CANCELLED``, or raising ``KeyboardInterrupt``. *on_event* is called with each event on the way.
        """
        params = given(roi=roi, reference=reference, preset=preset, dry_run=dry_run, on_disconnect=on_disconnect)
        if on_event is not None:
            self.begin("subscribe", {}, on_event).result(self.timeout_s)
        pending: Pending | None = None
        try:
            pending = self.begin("focus", params)
            answer: FocusAnswer = pending.result(timeout_s)
        except TimeUpError:
            assert pending is not None
            self.cancel()
            answer = pending.result(CANCEL_S)
        except KeyboardInterrupt:
            if self._link is not None:  # also where it came while the request was on its way out
                self._link.post("cancel")
            if pending is not None:
                pending.result(CANCEL_S)
            raise
        finally:
            if on_event is not None and self._alive():
                self.begin("subscribe", {"events": []}).result(self.timeout_s)
        return answer

    def events(
        self, kinds: Sequence[str] | None = None, rate_hz: float | None = None, *, reconnect_s: float = 0.0
    ) -> EventStream:
        """Subscribe, over a connection of its own, and return what yields the events: an iterator to be closed.

        Parameters
        ----------
        kinds
            Of ``sample``, ``phase``, ``result``, ``fault``, ``state``, ``position``; all if not given. ``dropped``
            comes with any: so many were missed because they were not taken in time.
        rate_hz
            Samples a second.
        reconnect_s
            How long to look for a daemon that has gone, before ``UnreachableError`` is raised.

        """
        params: dict[str, Any] = {} if kinds is None else {"events": list(kinds)}
        if rate_hz is not None:
            params["rate_hz"] = rate_hz
        return EventStream(self.path, params, self.timeout_s, reconnect_s)

    def _linked(self) -> Link:
        with self._linking:
            if self._link is not None and self._link.broken:
                self._link.close()
                self._link = None
            if self._link is None:
                self._link = Link(self.path, self.timeout_s)
            return self._link

    def _alive(self) -> bool:
        return self._link is not None and not self._link.broken
