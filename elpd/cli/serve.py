"""`elpd serve`: the daemon. Owns the rig, answers on a socket, focuses when asked or when a mode says so."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options
from elpd.config import load
from elpd.errors import ElpdError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.config import Config
    from elpd.service.engine import RigEngine
    from elpd.service.notify import Notifier

SIGNALS = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}


@click.command("serve")
@config_options
def command(*, config_path: Path | None, overrides: tuple[str, ...]) -> int:
    """Serve the rig until SIGTERM or Ctrl-C: exit 0 after that, 2 for a wrong configuration, 4 if another one runs.

    SIGHUP reads the configuration again and takes it once the lens is at rest. A rig that is missing is no reason to
    end: it is a fault, told on the socket, and the rig is tried again.
    """
    config = load(config_path, overrides)
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # before there are threads: they all inherit it
    from elpd.service.api import ApiServer  # noqa: PLC0415  (numba and pydantic only now)
    from elpd.service.engine import RigEngine  # noqa: PLC0415
    from elpd.service.job import Place  # noqa: PLC0415
    from elpd.service.listening import handed_over  # noqa: PLC0415
    from elpd.service.notify import Notifier  # noqa: PLC0415
    from elpd.service.threads import API_LOOP, EngineThreads  # noqa: PLC0415
    from elpd.service.timing import RealTime  # noqa: PLC0415
    from elpd.service.warm import settle, warm_up  # noqa: PLC0415

    if config.rig == "sim" and config.sim.pace == 0:
        config = config.model_copy(update={"sim": config.sim.model_copy(update={"pace": 1.0})})
    notifier = Notifier()
    sockets = handed_over(os.environ, os.getpid())
    notifier.tell(status="compiling kernels")
    warm_up()
    place = Place()
    engine = RigEngine(config, RealTime(place.wait), place, threaded=True)
    api = ApiServer(engine, config.api, sockets)
    threads = EngineThreads(engine, notifier, lambda: _schedule(engine, config))
    api.start()
    try:
        threads.start()
        engine.heartbeats.expect(API_LOOP, API_LIMIT_S)
        settle()
        notifier.ready(_one_line(engine))
        _until_told(engine, notifier, lambda: load(config_path, overrides))
        notifier.stopping()
    finally:
        ended = threads.stop()
        api.stop()
    return 0 if ended else 3
