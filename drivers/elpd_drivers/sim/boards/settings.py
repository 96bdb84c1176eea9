"""A flat table of settings, split into what a simulated lens is like and how its board is set up."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

from elpd.errors import ConfigError
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens

if TYPE_CHECKING:
    from collections.abc import Mapping

C = TypeVar("C")


def lens_and_config(settings: Mapping[str, Any], config: type[C]) -> tuple[SimulatedLens, C, int]:
    """Return a lens, the board's config of type *config* and the seed.

    Keys are the fields of ``LensMechanics`` and of *config*, and ``start_um`` and ``seed``. Raises ``ConfigError``.
    """
    of_lens = {item.name for item in fields(LensMechanics)}
    of_board = {item.name for item in fields(config)}  # type: ignore[arg-type]
    known = of_lens | of_board | {"start_um", "seed"}
    for key in settings:
        if key not in known:
            raise ConfigError(f"board.{key}: unknown key; known are {', '.join(sorted(known))}")
    try:
        mechanics = LensMechanics(**{key: value for key, value in settings.items() if key in of_lens})
        lens = SimulatedLens(mechanics, start_um=float(settings.get("start_um", mechanics.travel_um / 2)))
        return lens, config(**{k: v for k, v in settings.items() if k in of_board}), int(settings.get("seed", 0))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"board: {error}") from None
