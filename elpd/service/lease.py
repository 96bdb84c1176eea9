"""The lease: one connection keeps the others from operating for a while. It ends by itself.

A lease keeps back motions and changes of others, and everything that the daemon would do by itself. It never keeps
anybody from stopping the lens.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from elpd.errors import BusyError
from elpd.service.messages import Holder, LeaseAnswer

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.service.engine_port import Caller
    from elpd.service.messages import LeaseParams


class Lease:
    """Who holds the rig for himself, and until when. Thread-safe."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._holder: Caller | None = None
        self._until_s = 0.0

    def ask(self, params: LeaseParams, caller: Caller) -> LeaseAnswer:
        """Acquire, renew or release. Raises ``BusyError`` while another connection holds it."""
        with self._lock:
            self._refuse_others(caller)
            if params.action == "release":
                self._holder = None
            elif params.action == "renew" and self._current() is None:
                raise BusyError("the lease has ended and cannot be renewed; acquire it again")
            else:
                self._holder, self._until_s = caller, self._now_s() + params.seconds
            return self._answer()

    def refuse_others(self, caller: Caller) -> None:
        """Raise ``BusyError`` if another connection than the caller's holds it."""
        with self._lock:
            self._refuse_others(caller)

    def gone(self, caller: Caller) -> None:
        """End it with its connection."""
        with self._lock:
            if self._holder is not None and self._holder.connection == caller.connection:
                self._holder = None

    def answer(self) -> LeaseAnswer:
        """Return who holds it and for how long."""
        with self._lock:
            return self._answer()

    @property
    def held(self) -> bool:
        """Whether anybody holds it."""
        with self._lock:
            return self._current() is not None

    def _current(self) -> Caller | None:
        if self._holder is not None and self._now_s() >= self._until_s:
            self._holder = None
        return self._holder

    def _refuse_others(self, caller: Caller) -> None:
        holder = self._current()
        if holder is not None and holder.connection != caller.connection:
            left_s = self._until_s - self._now_s()
            raise BusyError(
                f"{holder.name} (pid {holder.pid}) holds the lease for another {left_s:.0f} s; wait, or ask them"
            )

    def _answer(self) -> LeaseAnswer:
        holder = self._current()
        if holder is None:
            return LeaseAnswer(holder=None, until_s=0.0)
        return LeaseAnswer(
            holder=Holder(pid=holder.pid, uid=holder.uid, name=holder.name), until_s=self._until_s - self._now_s()
        )
