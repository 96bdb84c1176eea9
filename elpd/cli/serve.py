"""`elpd serve`: the daemon. Owns the rig, answers on a socket, focuses when asked or when a mode says so."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.config import load
from elpd.errors import ElpdError

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.config import Config
    from elpd.service.engine import RigEngine
    from elpd.service.notify import Notifier

SIGNALS = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}

IN_FORCE = "elpd.toml"
"""In the unit's runtime directory."""


@click.command("serve")
@config_options
@json_option
def command(*, config_path: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Serve the rig until SIGTERM or Ctrl-C: exit 0 after that, 2 for a wrong configuration, 4 if another one runs.

    SIGHUP reads the configuration again and takes it once the lens is at rest. A rig that is missing is no reason to
    end: it is a fault, told on the socket, and the rig is tried again. With --json, one object is printed once requests
    are taken.
    """
    config = _paced(load(config_path, overrides))
    _remember_for_parking(config_path)
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # before there are threads: they all inherit it
    from elpd.service.notify import Notifier  # noqa: PLC0415  (numba and pydantic only now)
    from elpd.service.warm import settle, warm_up  # noqa: PLC0415

    notifier = Notifier()
    notifier.tell(status="compiling kernels")
    warm_up(config)  # before the rooms that need them are imported, which would compile them
    from elpd.service.api import ApiServer  # noqa: PLC0415
    from elpd.service.engine import RigEngine  # noqa: PLC0415
    from elpd.service.job import Place  # noqa: PLC0415
    from elpd.service.listening import handed_over  # noqa: PLC0415
    from elpd.service.threads import API_LIMIT_S, API_LOOP, EngineThreads  # noqa: PLC0415
    from elpd.service.timing import RealTime  # noqa: PLC0415

    sockets = handed_over(os.environ, os.getpid())
    place = Place()

    def prepare(other: Config) -> None:
        warm_up(other, lambda: engine.stopping)

    engine = RigEngine(config, RealTime(place.wait), place, threaded=True, prepare=prepare)
    api = ApiServer(engine, config.api, sockets)
    threads = EngineThreads(engine, notifier, lambda: _schedule(engine, config))
    api.start()
    try:
        threads.start()
        engine.heartbeats.expect(API_LOOP, API_LIMIT_S)
        settle()
        notifier.ready(_one_line(engine))
        if as_json:
            print_json({"pid": os.getpid(), "socket": api.path, "state": engine.situation.state})
        _until_told(engine, notifier, lambda: load(config_path, overrides), lambda: _remember_for_parking(config_path))
        notifier.stopping()
    finally:
        ended = threads.stop()
        api.stop()
    return 0 if ended else 3


def _until_told(
    engine: RigEngine, notifier: Notifier, read: Callable[[], Config], accepted: Callable[[], None]
) -> None:
    """Return when a signal says that this is the end; take other configurations meanwhile."""
    import structlog  # noqa: PLC0415  (with the rest)

    log = structlog.get_logger()
    while (number := signal.sigwait(SIGNALS)) == signal.SIGHUP:
        notifier.reloading()
        try:
            config = _paced(read())
        except ElpdError as error:
            log.warning("configuration refused, the old one stays", reason=str(error))
            engine.situation.warn("config-refused", f"{error}; the configuration of before is in force")
            notifier.ready(_one_line(engine))
            continue
        engine.situation.unwarn("config-refused")
        accepted()
        engine.reload(config, lambda: notifier.ready(_one_line(engine)))
    log.info("asked to end", signal=signal.Signals(number).name)


def _remember_for_parking(path: Path | None) -> None:
    """Keep a copy of the configuration in force for `elpd park`: what is on disk may be changed, and wrong, since."""
    folder = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if not folder or path is None:
        return
    place = Path(folder, IN_FORCE)
    beside = place.with_suffix(".new")
    beside.write_bytes(path.read_bytes())
    beside.replace(place)


def _schedule(engine: RigEngine, config: Config) -> None:
    """Let the focus thread, which calls this, be urgent; not where it computes a world, which would starve the rest."""
    from elpd.service.realtime import be_urgent, lock_memory  # noqa: PLC0415  (with the rest)

    if config.rig == "sim" or config.service.priority == 0:
        return
    refused = [why for why in (be_urgent(config.service.priority), lock_memory()) if why is not None]
    if refused:
        engine.situation.warn("not-real-time", f"the focus thread runs as it can ({'; '.join(refused)})")


def _paced(config: Config) -> Config:
    """Hold a simulated world to the wall clock's pace: others live by that."""
    if config.rig != "sim" or config.sim.pace > 0:
        return config
    return config.model_copy(update={"sim": config.sim.model_copy(update={"pace": 1.0})})


def _one_line(engine: RigEngine) -> str:
    fault = engine.situation.fault
    state = engine.situation.state
    return f"{state}, {engine.autopilot.mode}" if fault is None else f"{state}: {fault.kind}: {fault.message}"
