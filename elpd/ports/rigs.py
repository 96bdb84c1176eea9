"""Whole rigs and what they are made of: entry points of ``elpd.rigs``, ``elpd.boards`` and ``elpd.discovery``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from elpd.ports.devices import Aperture, Clock, EventCamera, Lens
    from elpd.records import FocusResult
    from elpd.scale import LensScale


class Truth(Protocol):
    """What only a simulated rig knows."""

    def errors(self, result: FocusResult) -> dict[str, float | None]:
        """Return ``focus_um estimate_error_um stop_error_um final_error_um`` for a finished cycle."""
        ...


@runtime_checkable
class Scenery(Protocol):
    """A truth that can show the scene."""

    def picture(self) -> NDArray[np.float32]:
        """Return what falls on the sensor now, behind an open aperture: log intensity, (height, width)."""
        ...

    def carriage_error_um(self) -> float:
        """Return how far the glass is from focus now, signed."""
        ...


@runtime_checkable
class Paced(Protocol):
    """A clock that tries to keep up with the wall's."""

    @property
    def lag_s(self) -> float:
        """How far behind the wall clock it is; negative if ahead, 0 if it does not try."""
        ...


@dataclass(frozen=True, slots=True)
class RigParts:
    """Devices that share a world: what an entry point of the group ``elpd.rigs`` returns."""

    clock: Clock
    camera: EventCamera
    lens: Lens
    aperture: Aperture | None
    scale: LensScale
    truth: Truth | None = None

    @property
    def um_per_step(self) -> float:
        """The nominal length of a step; where it depends on the place, ``scale`` knows."""
        return self.scale.um_per_step


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """Something that is plugged in: a serial port, a camera on the USB.

    ``next_step`` says what a person must do before it can be used, ``None`` where nothing stands in the way.
    ``drivers`` are the installed entry points that would open it, as far as that can be told without opening it.
    """

    kind: str
    name: str
    where: str
    next_step: str | None = None
    drivers: tuple[str, ...] = ()


class Discovery(Protocol):
    """A look around without opening anything: what an entry point of the group ``elpd.discovery`` names."""

    def __call__(self) -> Sequence[FoundDevice]:
        """Return what is there now. Raises ``DeviceError`` if looking is impossible, with the reason."""
        ...


class RunningBoard(Protocol):
    """A simulated controller behind a pty."""

    @property
    def port(self) -> str:
        """The path that any program can open as a serial port."""
        ...

    def close(self) -> None:
        """Stop serving and remove the pty. Idempotent."""
        ...


class Board(Protocol):
    """A simulated controller: what an entry point of the group ``elpd.boards`` names."""

    def serve(self, settings: Mapping[str, Any]) -> RunningBoard:
        """Open a pty and serve it from a thread, in real time, until closed."""
        ...
