"""`elpd park`: the last resort. Tell the lens's controller to stop, whoever else is dead.

For systemd's ``ExecStopPost=``: it runs after a crash, a kill or a watchdog's abort, when no daemon is left to stop the
lens. It needs neither camera nor kernels nor profiles, moves nothing, and asks nothing of the daemon. Opening a
controller halts what moves; the strongest stop is sent besides, and the lens is watched until it rests.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.config import load
from elpd.errors import BusyError, ConfigError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from elpd.config import LensSection
    from elpd.ports import Clock, Lens


@click.command("park")
@click.option("--emergency", is_flag=True, help="Say that you mean it: stop the lens past any daemon.")
@config_options
@json_option
def command(*, emergency: bool, config_path: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Stop the lens, past any daemon: exit 0 at rest, 3 if the controller does not obey, 4 if its port is held."""
    if not emergency:
        raise UsageError("park goes past the daemon; use `elpd stop`, or say --emergency where no daemon is left")
    config = load(config_path, overrides)
    if config.lens.driver == "sim":
        _tell({"stopped": False, "reason": "a simulated lens ends with its daemon: there is nothing to stop"}, as_json)
        return 0
    position_um = _stop(config.lens)
    _tell({"stopped": True, "position_um": position_um, "reason": "at rest"}, as_json)
    return 0


def _stop(section: LensSection) -> float:
    """Open the controller, stop it, wait until it rests; return where. By the driver alone: ``elpd.rig`` is larger."""
    from elpd.motion.errand import Errands  # noqa: PLC0415  (not for `elpd --help`)
    from elpd.ports import Closeable  # noqa: PLC0415
    from elpd.scale import LensScale  # noqa: PLC0415
    from elpd.timebase import MonotonicClock  # noqa: PLC0415

    clock = MonotonicClock()
    try:
        lens = _open(section, clock)
    except BusyError as error:
        raise BusyError(f"{error}; whoever holds it is alive and must stop it") from None
    try:
        return Errands(clock, lens, LensScale(section.um_per_step, section.steps_to_um)).stop().um
    finally:
        if isinstance(lens, Closeable):
            lens.close()


def _open(section: LensSection, clock: Clock) -> Lens:
    for point in entry_points(group="elpd.lenses"):
        if point.name == section.driver:
            settings = {**section.settings(), "um_per_step": section.um_per_step, "max_speed_um_s": section.speed_um_s}
            lens: Lens = point.load()(settings, clock)
            return lens
    raise ConfigError(f"no lens driver is called {section.driver!r}; `elpd check` lists those that are installed")


def _tell(fields: dict[str, object], as_json: bool) -> None:  # noqa: FBT001  (the command's own flag)
    if as_json:
        print_json(dict(fields))
    else:
        place = f" at {fields['position_um']:.2f} um" if "position_um" in fields else ""
        print(f"{fields['reason']}{place}")
