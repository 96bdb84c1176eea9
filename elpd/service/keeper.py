"""Who holds the rig: opens it, loses it, opens it again, and can stop the lens from any thread.

A rig that was lost is opened again by itself, with growing patience, but it comes back *unreferenced*: whatever moved
the lens meanwhile (a hand, its own momentum, another program) was not seen, so nothing moves until somebody homes it.
The stop goes past everything here: one attribute read, then the driver's own stop.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd import rig
from elpd.errors import BusyError, ConfigError, DeviceError, FormatError, LensError
from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.config import Config
    from elpd.ports import Lens, RigParts
    from elpd.records import StopMode

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 5.0
"""Seconds between attempts to open a rig that was lost: the first, doubled each time up to the last."""


class RigKeeper:
    """Holds the parts of a rig, or tries to get them back.

    Parameters
    ----------
    config
        Which rig.
    build
        Opens it; ``elpd.rig.build`` unless a test has another.
    prepare
        Has what a configuration needs before its rig is opened, such as kernels; called again, it has nothing to do.
    """

    def __init__(
        self,
        config: Config,
        build: Callable[[Config], RigParts] = rig.build,
        prepare: Callable[[Config], None] = lambda _: None,
    ) -> None:
        self.config = config
        self._prepare = prepare
        self._prepared = config
        self.parts: RigParts | None = None
        self.needs_home = False
        """Whether the lens may have moved unseen since it last was referenced."""
        self._build = build
        self._lens: Lens | None = None
        self._retry_s = FIRST_RETRY_S
        self.retry_at_s = 0.0
        """When the next attempt is due, on the engine's clock."""

    @property
    def in_real_time(self) -> bool:
        """Whether the lens lives in the machine's own time, and moves on while nobody here does anything."""
        return self.parts is not None and isinstance(self.parts.clock, MonotonicClock)

    @property
    def unprepared(self) -> bool:
        """Whether another configuration was taken that needs preparing."""
        return self.config is not self._prepared

    def prepare(self) -> None:
        """Have what the configuration needs; may take many seconds."""
        self._prepare(self.config)
        self._prepared = self.config

    def open(self, now_s: float) -> RigParts:
        """Open the rig.

        Raises ``DeviceError``, ``ConfigError`` or ``FormatError``, after which the next attempt is due later.
        """
        try:
            parts = self._build(self.config)
        except BusyError as error:  # another program holds the port: the lens is as good as lost
            self._later(now_s)
            raise LensError(str(error)) from None
        except (DeviceError, ConfigError, FormatError):
            self._later(now_s)
            raise
        self.parts, self._lens = parts, parts.lens
        self._retry_s = FIRST_RETRY_S
        return parts

    def due(self, now_s: float) -> bool:
        """Say whether it is time to try again."""
        return self.parts is None and now_s >= self.retry_at_s

    def hurry(self) -> None:
        """Let the next attempt be due at once, and the ones after it soon."""
        self._retry_s, self.retry_at_s = FIRST_RETRY_S, 0.0

    def lose(self, now_s: float, *, lens_moved_unseen: bool) -> None:
        """Give the rig back after trouble, whatever state its devices are in; the first attempt is due soon."""
        parts, self.parts = self.parts, None
        self.retry_at_s = now_s + FIRST_RETRY_S
        self._retry_s = 2 * FIRST_RETRY_S
        if lens_moved_unseen:
            self.needs_home = True
        if parts is not None:
            self._release(parts)

    def close(self) -> None:
        """Give the rig back for good."""
        parts, self.parts = self.parts, None
        if parts is not None:
            self._release(parts)
        self._lens = None

    def stop_lens(self, mode: StopMode) -> LensError | None:
        """Send the stop now, from any thread; return why it could not be sent. Without a lens there is none to stop."""
        lens = self._lens
        if lens is None:
            return None
        try:
            lens.stop(mode)
        except LensError as error:
            return error
        return None

    def _later(self, now_s: float) -> None:
        self.retry_at_s = now_s + self._retry_s
        self._retry_s = min(LAST_RETRY_S, 2 * self._retry_s)

    def _release(self, parts: RigParts) -> None:
        try:
            rig.release(parts)
        except DeviceError:
            return  # it is gone: that is why it is given back
