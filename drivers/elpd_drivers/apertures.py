"""Apertures without a motor: none at all, and one that a person turns.

Neither can know when light truly came; both say what they do know. The expose stage takes the opening time from the
events themselves where it is not given, so an honest bound is enough here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import structlog

from elpd.errors import ConfigError
from elpd.records import CommandStamp

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from elpd.ports import Clock

_log = structlog.get_logger()

Ask = Callable[[str], None]


def open_none(settings: Mapping[str, Any], clock: Clock) -> FixedAperture:
    """Return an aperture that is always open. No settings."""
    _refuse_unknown(settings, frozenset())
    return FixedAperture(clock)


def open_manual(settings: Mapping[str, Any], clock: Clock) -> ManualAperture:
    """Return an aperture that a person opens and closes.

    Settings: ``opening_ms`` (default 10 000), how long after the request it is open for certain; ``ask``, a function
    that takes the request's words and may wait until it is done (default: the log carries the words).
    """
    _refuse_unknown(settings, frozenset({"opening_ms", "ask"}))
    opening_ms = settings.get("opening_ms", 10_000.0)
    if isinstance(opening_ms, bool) or not isinstance(opening_ms, (int, float)) or not opening_ms > 0:
        raise ConfigError(f"aperture.opening_ms is {opening_ms!r}; it must be a positive number of milliseconds")
    ask = settings.get("ask", _say_in_log)
    if not callable(ask):
        raise ConfigError(f"aperture.ask is {ask!r}; it must be a function that takes a sentence")
    return ManualAperture(clock, float(opening_ms), cast("Ask", ask))


@dataclass(frozen=True, slots=True)
class FixedAperture:
    """Always open: both commands do nothing, and the light is all there from the beginning.

    A temporal map cannot be made with it, because nothing opens; a camera with frames does not need one.
    """

    clock: Clock

    def open(self) -> CommandStamp:
        """Do nothing; it is open."""
        return self._stamp("open (fixed)")

    def close(self) -> CommandStamp:
        """Do nothing; it cannot close."""
        return self._stamp("close (fixed)")

    @property
    def opening_ms(self) -> float:
        """Zero: it is open before it is asked."""
        return 0.0

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 1 for any time, before the request too; float64, the shape of *since_open_us*."""
        return np.ones_like(since_open_us, dtype=np.float64)

    def _stamp(self, name: str) -> CommandStamp:
        now = self.clock.now_ns()
        return CommandStamp(name, now, now)


@dataclass(frozen=True, slots=True)
class ManualAperture:
    """Opened by hand: a command's stamp is the time of *asking*; the hand follows within ``opening_ms``, if at all."""

    clock: Clock
    opening_ms: float
    ask: Ask

    def open(self) -> CommandStamp:
        """Ask for it to be opened."""
        return self._request("open", "open the aperture fully, in one even turn")

    def close(self) -> CommandStamp:
        """Ask for it to be closed."""
        return self._request("close", "close the aperture")

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 0 before the request, 1 from ``opening_ms`` on, and an evenly turned iris between them.

        Its area grows with the square of time. Float64, the shape of *since_open_us*.
        """
        turned = np.clip(np.asarray(since_open_us, dtype=np.float64) / (self.opening_ms * 1000), 0.0, 1.0)
        return np.square(turned)

    def _request(self, name: str, words: str) -> CommandStamp:
        begun = self.clock.now_ns()
        self.ask(words)
        return CommandStamp(f"{name} (by hand)", begun, self.clock.now_ns())


def _say_in_log(words: str) -> None:
    _log.warning("please do this by hand", request=words)


def _refuse_unknown(settings: Mapping[str, Any], known: frozenset[str]) -> None:
    unknown = set(settings) - known
    if unknown:
        raise ConfigError(
            f"aperture.{min(unknown)}: unknown key; known are {', '.join(sorted(known)) or 'none for this aperture'}"
        )
