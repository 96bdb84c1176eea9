"""Any simulated board as an entry point of ``elpd.boards``: settings in, a pty out."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from elpd_drivers.sim.boards.line import PtyServer
from elpd_drivers.sim.boards.settings import lens_and_config

if TYPE_CHECKING:
    from collections.abc import Mapping

    from elpd.ports import RunningBoard
    from elpd_drivers.sim.boards.line import SimulatedBoard
    from elpd_drivers.sim.lens import SimulatedLens

C = TypeVar("C")
_C_contra = TypeVar("_C_contra", contravariant=True)


class MakesBoard(Protocol[_C_contra]):
    """A board's class."""

    def __call__(
        self, lens: SimulatedLens, config: _C_contra | None = None, *, seed: int, begin_ns: int
    ) -> SimulatedBoard:
        """Power a board up in front of *lens* at *begin_ns*."""
        ...


class ServedBoard(Generic[C]):
    """``elpd.ports.Board`` for a class of boards and the class of their configs."""

    def __init__(self, make: MakesBoard[C], config: type[C]) -> None:
        self.make, self.config = make, config

    def serve(self, settings: Mapping[str, Any]) -> RunningBoard:
        """Serve one in front of a lens, in real time; see ``boards.settings`` for the keys."""
        lens, config, seed = lens_and_config(settings, self.config)
        return PtyServer(self.make(lens, config, seed=seed, begin_ns=time.monotonic_ns()))
