"""When to ask a controller where it is, when a question counts as lost, and when silence is a fault."""

from __future__ import annotations

from elpd.units import NS_PER_MS
from elpd_drivers.lenses.line import Trouble


class Asking:
    """One question in flight at a time.

    Parameters
    ----------
    every_ms
        How often to ask.
    silence_ms
        How long nothing believable may come before that is a fault.
    lost_share
        After which part of *silence_ms* to ask again what was not answered.
    """

    def __init__(self, every_ms: float, silence_ms: float, *, lost_share: float = 0.25) -> None:
        self.silence_ms = silence_ms
        self._every_ns = round(every_ms * NS_PER_MS)
        self._lost_ns = round(silence_ms * lost_share * NS_PER_MS)
        self._asked_ns: int | None = None
        self._next_ns = 0
        self._silent_since_ns: int | None = None

    @property
    def open(self) -> bool:
        """Whether a question waits for its answer."""
        return self._asked_ns is not None

    def due(self, now_ns: int) -> bool:
        """Say whether it is time to ask, or to ask again."""
        if self._asked_ns is None:
            return now_ns >= self._next_ns
        return now_ns - self._asked_ns > self._lost_ns

    def asked(self, now_ns: int) -> None:
        """Note that a question left."""
        self._asked_ns = now_ns
        self._next_ns = now_ns + self._every_ns
        if self._silent_since_ns is None:
            self._silent_since_ns = now_ns

    def answered(self) -> None:
        """Note that something came back, whatever it was; silence counts on."""
        self._asked_ns = None

    def believed(self) -> None:
        """Note that what came back was good."""
        self._silent_since_ns = None

    def soon(self) -> None:
        """Ask again at the next opportunity."""
        self._next_ns = 0

    def forget(self) -> None:
        """Begin anew: nothing was asked, nothing is missing."""
        self._asked_ns = self._silent_since_ns = None
        self._next_ns = 0

    def check(self, now_ns: int, hint: str) -> None:
        """Raise ``Trouble`` after too long a silence; *hint* says what else to look at."""
        if self._silent_since_ns is None:
            return
        silence_ms = (now_ns - self._silent_since_ns) / NS_PER_MS
        if silence_ms > self.silence_ms:
            raise Trouble(
                f"no valid reply for {silence_ms:.0f} ms (limit {self.silence_ms:.0f}); check the cable{hint}, or "
                "raise lens.reply_ms"
            )
