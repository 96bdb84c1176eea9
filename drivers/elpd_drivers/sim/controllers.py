"""Every lens controller there is a board for, fitted to a simulated lens and driven by its own driver.

One table instead of a branch per board: how the board is set up for a wanted speed, and what its driver's ``[lens]``
table then says. ``sim.board`` names a row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from elpd.errors import ConfigError
from elpd_drivers.lenses import avr, avr_wire, grbl, scf4, scf4_wire, theia, tic, tmcl, zaber
from elpd_drivers.sim.boards.avr import BOARD as AVR
from elpd_drivers.sim.boards.grbl import BOARD as GRBL
from elpd_drivers.sim.boards.line import MemoryPort
from elpd_drivers.sim.boards.scf4 import BOARD as SCF4
from elpd_drivers.sim.boards.scf4 import Scf4Config
from elpd_drivers.sim.boards.theia import BOARD as THEIA
from elpd_drivers.sim.boards.tic import BOARD as TIC
from elpd_drivers.sim.boards.tmcl import BOARD as TMCL
from elpd_drivers.sim.boards.zaber import BOARD as ZABER

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from elpd.ports import BytePort, Clock, Lens
    from elpd_drivers.sim.boards.served import ServedBoard
    from elpd_drivers.sim.lens import SimulatedLens

    Table = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a lens should be able to do."""

    um_per_step: float
    travel_um: float
    speed_um_s: float
    acceleration_um_s2: float


@dataclass(frozen=True, slots=True)
class Controller:
    """A board and its driver. ``setup`` gives the board's config beyond ``referenced``, ``table`` the driver's."""

    board: ServedBoard[Any]
    open_lens: Callable[[Mapping[str, Any], Clock, BytePort | None], Lens]
    setup: Callable[[Wanted], Table]
    table: Callable[[Wanted], Table]


def _nothing(wanted: Wanted) -> Table:
    del wanted
    return {}


def _told_by_driver(wanted: Wanted) -> Table:
    """Return the table of a driver that tells its controller how fast to be."""
    return {
        "um_per_step": wanted.um_per_step,
        "max_um": wanted.travel_um,
        "max_speed_um_s": wanted.speed_um_s,
        "acceleration_um_s2": wanted.acceleration_um_s2,
    }


def _told_within(fastest_sps: float) -> Callable[[Wanted], Table]:
    """Return such a table for a controller that makes so many steps a second at the most."""

    def table(wanted: Wanted) -> Table:
        return {**_told_by_driver(wanted), "max_speed_um_s": min(wanted.speed_um_s, fastest_sps * wanted.um_per_step)}

    return table


def _set_up(wanted: Wanted) -> Table:
    """Return the config of a board that keeps speed and acceleration in its own settings."""
    return {"speed_um_s": wanted.speed_um_s, "acceleration_um_s2": wanted.acceleration_um_s2}


def _without_ramps(wanted: Wanted) -> Table:
    """Return the table of a driver whose controller starts and stops at full speed."""
    table = _told_by_driver(wanted)
    del table["acceleration_um_s2"]
    return table


_SCF4_AS_MADE = Scf4Config()


def _homed_scf4(wanted: Wanted) -> Table:
    """Return the table of an SCF4 that an earlier session has homed, so that it knows how its board counts."""
    fastest = scf4_wire.FASTEST_CODE
    return {
        "um_per_step": wanted.um_per_step,
        "max_um": wanted.travel_um,
        "max_speed_um_s": min(wanted.speed_um_s, _SCF4_AS_MADE.speed_scale / fastest * wanted.um_per_step),
        "trust_position": True,
        "relative": _SCF4_AS_MADE.relative,
        "speed_scale": _SCF4_AS_MADE.speed_scale,
    }


CONTROLLERS: Mapping[str, Controller] = {
    "tic": Controller(TIC, tic.open_lens, _nothing, _told_by_driver),
    "grbl": Controller(
        GRBL, grbl.open_lens, _set_up, lambda wanted: {"um_per_step": wanted.um_per_step, "trust_position": True}
    ),
    "avr": Controller(AVR, avr.open_lens, _nothing, _told_within(avr_wire.FASTEST_SPS)),
    "tmcl": Controller(TMCL, tmcl.open_lens, _nothing, _told_by_driver),
    "scf4": Controller(SCF4, scf4.open_lens, _nothing, _homed_scf4),
    "theia": Controller(THEIA, theia.open_lens, _nothing, _without_ramps),
    "zaber": Controller(ZABER, zaber.open_lens, _set_up, lambda wanted: {"um_per_step": wanted.um_per_step}),
}


def controller(name: str) -> Controller:
    """Return the row of ``sim.board``. Raises ``ConfigError`` with the names there are."""
    if name not in CONTROLLERS:
        raise ConfigError(f"sim.board is {name!r}; known: {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name]


def fitted(
    name: str,
    lens: SimulatedLens,
    wanted: Wanted,
    clock: Clock,
    *,
    seed: int,
    adapter_ns: int = 0,
    own: Mapping[str, Any] | None = None,
) -> tuple[MemoryPort, Table]:
    """Power the board up in front of *lens*, homed, behind a line in memory; return it and its driver's table.

    An adapter passes on what it is sent *adapter_ns* later; *own* are config keys in which this board is not like
    others of its kind.
    """
    chosen = controller(name)
    config = chosen.board.config(referenced=True, **chosen.setup(wanted), **(own or {}))
    board = chosen.board.make(lens, config, seed=seed, begin_ns=clock.now_ns())
    return MemoryPort(board, clock, latency_ns=adapter_ns), chosen.table(wanted)
