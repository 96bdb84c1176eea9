"""An iris turned by a stepper on another axis of the lens's controller: a P-iris, or a ring on a motor.

To whoever exposes it is an output called "iris" that takes its time: switched on it goes to where it is open, switched
off to where it is closed. How much light passes on the way, and from when on, no controller knows; that is measured
(`elpd calibrate aperture`).

Where its motor stands after power-up nobody knows either. A controller that homes an axis by itself does so at the
first closing; others have no switch there, and drive it against its closed stop, as P-irises are made for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from elpd.errors import ConfigError, LensError

if TYPE_CHECKING:
    from collections.abc import Sequence

IRIS = "iris"
INTO_STOP = 1.1
"""How much further than its whole way it is driven to be at its closed stop wherever it was."""

A = TypeVar("A", int, str)
A_co = TypeVar("A_co", int, str, covariant=True)


class IrisSettings(Protocol[A_co]):
    """What the settings of a driver with such an axis have; ``iris_axis`` is ``None`` where there is none."""

    @property
    def iris_axis(self) -> A_co | None:
        """Which of the controller's axes turns it."""
        ...

    @property
    def iris_closed(self) -> int:
        """Where it is closed, steps from its reference."""
        ...

    @property
    def iris_open(self) -> int:
        """Where it is open, steps from its reference."""
        ...

    @property
    def iris_speed_sps(self) -> float:
        """How fast it is turned, steps/s."""
        ...


@dataclass(frozen=True, slots=True)
class IrisAxis(Generic[A]):
    """Where an iris is open and closed, in steps of its own axis, and how fast it goes from one to the other."""

    axis: A
    closed_steps: int
    open_steps: int
    speed_sps: float

    def target(self, *, opened: bool) -> int:
        """Return where it is to go."""
        return self.open_steps if opened else self.closed_steps

    @property
    def before_stop(self) -> int:
        """From where, if it is called that wherever it is, the way to ``closed_steps`` ends at the closed stop."""
        return self.closed_steps + round(INTO_STOP * (self.open_steps - self.closed_steps))


class IrisPlace(Generic[A]):
    """Where an iris is, as far as it was told: nobody knows before its first closing in a session.

    Parameters
    ----------
    axis
        Where it can be sent.
    """

    def __init__(self, axis: IrisAxis[A]) -> None:
        self.axis: IrisAxis[A] = axis
        self.steps: int | None = None

    def way(self, *, opened: bool) -> tuple[int, int]:
        """Return from where to where it is to go; unknown, it is so far away that the way ends at its closed stop.

        Raises ``LensError`` where it is to open and nobody knows where it is.
        """
        if self.steps is None and opened:
            raise LensError(
                f"lens: axis {self.axis.axis} does not know where the iris is; close it first, that homes it (`elpd "
                "expose` closes and opens it)"
            )
        here = self.axis.before_stop if self.steps is None else self.steps
        return here, self.axis.target(opened=opened)


def iris_axis(settings: IrisSettings[A], lens_axis: A, axes: Sequence[A]) -> IrisAxis[A] | None:
    """Return the axis that a table describes, ``None`` where it has none; *axes* are the controller's.

    Raises ``ConfigError`` for a table that contradicts itself.
    """
    axis = settings.iris_axis
    if axis is None:
        if settings.iris_open or settings.iris_closed or settings.iris_speed_sps:
            raise ConfigError("lens.iris_open, iris_closed and iris_speed_sps need lens.iris_axis: which one turns it")
        return None
    if type(axis) is not type(lens_axis) or axis not in axes:
        raise ConfigError(
            f"lens.iris_axis is {axis!r}; it is one of {', '.join(repr(known) for known in axes if known != lens_axis)}"
        )
    if axis == lens_axis:
        raise ConfigError(f"lens.iris_axis is {axis}, the lens's own axis; give the iris's")
    if settings.iris_open == settings.iris_closed:
        raise ConfigError(
            f"lens.iris_open and lens.iris_closed are both {settings.iris_open} steps; give where it is open, and "
            "where closed"
        )
    if not (math.isfinite(settings.iris_speed_sps) and settings.iris_speed_sps > 0):
        raise ConfigError(
            f"lens.iris_speed_sps is {settings.iris_speed_sps:g}; give steps/s (a P-iris makes some 200 full steps)"
        )
    return IrisAxis(axis, settings.iris_closed, settings.iris_open, settings.iris_speed_sps)
