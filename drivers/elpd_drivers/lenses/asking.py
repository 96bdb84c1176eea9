"""When to ask a controller where it is, when a question counts as lost, and when silence is a fault.

Some adapters keep replies back: an FTDI waits up to its latency timer, 16 ms unless somebody set it, for more bytes to
come. That makes positions vaguer (each report is an interval, which the wait widens), not wrong, as long as a late
answer is not taken for a lost one. So how long answers take is learnt while asking, and told where it is long.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import TYPE_CHECKING

from elpd.units import NS_PER_MS
from elpd_drivers.lenses.line import Trouble

if TYPE_CHECKING:
    from collections.abc import Sequence

LATE_MS = 6.0
"""No controller here takes so long to answer where it is, its wire time included; an FTDI left alone mostly does."""

REMEMBERED = 5
"""Answers that the usual wait is taken of; few, because a slow line gives few in a cycle."""


class Asking:
    """One question in flight at a time.

    Where answers do not say which question they belong to, one that was asked again has two of them in flight. The
    next answer may be to either; a second one, if it comes, comes in the pause that is then made.

    Parameters
    ----------
    every_ms
        How often to ask.
    silence_ms
        How long nothing believable may come before that is a fault. Time in which nobody looked does not count.
    lost_share
        After which part of *silence_ms* to ask again what was not answered; later where answers take longer.
    """

    def __init__(self, every_ms: float, silence_ms: float, *, lost_share: float = 0.25) -> None:
        self.silence_ms = silence_ms
        self._every_ns = round(every_ms * NS_PER_MS)
        self._lost_ns = round(silence_ms * lost_share * NS_PER_MS)
        self._asked_ns: int | None = None
        self._first_asked_ns = 0
        self._next_ns = self._pause_until_ns = 0
        self._asked_again = False
        self._silent_since_ns: int | None = None
        self._looked_ns: int | None = None
        self._waits_ns: deque[int] = deque(maxlen=REMEMBERED)

    @property
    def open(self) -> bool:
        """Whether a question waits for its answer."""
        return self._asked_ns is not None

    @property
    def twice(self) -> bool:
        """Whether that question was asked more than once."""
        return self._asked_again

    @property
    def remarks(self) -> Sequence[str]:
        """What a person should know of how this line answers."""
        if self.held_ns == 0:
            return ()
        usual_ms = median(self._waits_ns) / NS_PER_MS
        slow = f"lens: replies take {usual_ms:.0f} ms or more (expected: less than {LATE_MS:.0f})"
        remedy = "set the adapter's latency timer to 1 ms (systemd/70-elpd.rules does), or use another adapter"
        return (f"{slow}, so positions on the way are vague; {remedy}",)

    @property
    def held_ns(self) -> int:
        """How long the line may keep back what the controller sent; 0 where it passes everything on at once."""
        if len(self._waits_ns) < REMEMBERED or median(self._waits_ns) < LATE_MS * NS_PER_MS:
            return 0
        return max(self._waits_ns)

    def due(self, now_ns: int) -> bool:
        """Say whether it is time to ask, or to ask again."""
        if self._asked_ns is None:
            return now_ns >= max(self._next_ns, self._pause_until_ns)
        return now_ns - self._asked_ns > self._patience_ns()

    def pausing(self, now_ns: int) -> bool:
        """Say whether an answer may still come that must not be taken for the next one."""
        return now_ns < self._pause_until_ns

    def asked_again(self) -> None:
        """Note that there are two questions in flight that an answer may belong to."""
        self._asked_again = True

    def asked(self, now_ns: int) -> None:
        """Note that a question left."""
        if self._asked_ns is None:
            self._first_asked_ns = now_ns
        self._asked_ns = now_ns
        self._next_ns = now_ns + self._every_ns
        if self._silent_since_ns is None:
            self._silent_since_ns = now_ns

    def answered(self) -> None:
        """Note that something came back, whatever it was; silence counts on."""
        self.late()
        self._asked_ns = None
        if self._asked_again:
            self._pause()

    def gave_up(self) -> None:
        """Note that a question will not be answered whole; what is left of its answer comes in the pause."""
        self._asked_ns = None
        self._pause()

    def late(self) -> None:
        """Note that an earlier question was answered, or one of several: answers take longer than thought."""
        if self._asked_ns is not None and self._looked_ns is not None:
            self._waits_ns.append(max(0, self._looked_ns - self._first_asked_ns))  # it was not there at that look

    def believed(self) -> None:
        """Note that what came back was good."""
        self._silent_since_ns = None

    def soon(self) -> None:
        """Ask again at the next opportunity."""
        self._next_ns = 0

    def forget(self) -> None:
        """Begin anew: nothing was asked, nothing is missing."""
        self._asked_ns = self._silent_since_ns = None
        self._next_ns = self._pause_until_ns = 0
        self._asked_again = False

    def check(self, now_ns: int, hint: str) -> None:
        """Note that what had come was looked at; raise ``Trouble`` after too long a silence.

        *hint* says what else to look at.
        """
        unseen_ns = 0 if self._looked_ns is None else now_ns - self._looked_ns - self._lost_ns
        self._looked_ns = now_ns
        if self._silent_since_ns is None:
            return
        self._silent_since_ns += max(0, unseen_ns)
        silence_ms = (now_ns - self._silent_since_ns) / NS_PER_MS
        if silence_ms > self.silence_ms:
            raise Trouble(
                f"no valid reply for {silence_ms:.0f} ms (limit {self.silence_ms:.0f}); check the cable{hint}, or "
                "raise lens.reply_ms"
            )

    def _pause(self) -> None:
        self._asked_again = False
        self._pause_until_ns = (self._looked_ns or 0) + self._patience_ns()

    def _patience_ns(self) -> int:
        """Return how long to wait for an answer: twice what one took lately, and half the silence limit at most."""
        slowest_ns = max(self._waits_ns, default=0)
        return min(max(self._lost_ns, 2 * slowest_ns), max(self._lost_ns, round(self.silence_ms * NS_PER_MS / 2)))
