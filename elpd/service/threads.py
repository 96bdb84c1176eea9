"""The engine's threads: one that focuses, one that watches over it.

The focus thread turns until the end. The supervisor owns no device: when the focus thread gives no sign of life it
sends the lens the strongest stop, and it feeds the watchdog only while every loop lives, so that a process that hangs
is ended and begun again from outside.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import structlog

from elpd.records import Cancel, StopMode
from elpd.service import overload
from elpd.service.engine import FOCUS_LOOP
from elpd.service.overload import Overload

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.service.engine import RigEngine
    from elpd.service.notify import Notifier

FOCUS_LIMIT_S = 1.0
"""The focus thread beats every few milliseconds; silent for so long it hangs."""

API_LOOP = "api"
API_LIMIT_S = 1.5
"""The socket's loop beats four times a second."""

LOOK_EVERY_S = 0.1
"""How often the supervisor looks."""

FORGOTTEN_AFTER_LOOKS = 600
"""An overload is warned of until this long after the last."""

END_S = 5.0
"""How long the lens may take to come to rest at the end, and the journal to be written."""

log = structlog.get_logger(__name__)


class EngineThreads:
    """Runs an engine against the wall clock.

    Parameters
    ----------
    engine
        Built with ``threaded=True``.
    notifier
        Who hears that all is well.
    prepare
        Called first on the focus thread, for its scheduling.
    """

    def __init__(self, engine: RigEngine, notifier: Notifier, prepare: Callable[[], None] = lambda: None) -> None:
        self._engine = engine
        self._notifier = notifier
        self._prepare = prepare
        self._watch = Supervisor(engine, notifier)
        self._ready = threading.Event()
        self._end = threading.Event()
        self._focus = threading.Thread(target=self._run, name="elpd-focus", daemon=True)
        self._supervisor = threading.Thread(target=self._supervise, name="elpd-supervisor", daemon=True)

    def start(self) -> None:
        """Begin; returns once the rig was tried and requests are taken."""
        self._focus.start()
        self._ready.wait()
        self._engine.heartbeats.expect(FOCUS_LOOP, FOCUS_LIMIT_S)
        self._supervisor.start()

    def stop(self) -> bool:
        """Stop the lens, end what runs, give the rig back. ``False`` if the focus thread did not end in time."""
        self._engine.begin_stopping()
        self._end.set()
        self._focus.join(END_S)
        ended = not self._focus.is_alive()
        if not ended:
            self._engine.keeper.stop_lens(StopMode.ABRUPT)
            log.error("focus thread did not end", limit_s=END_S)
        if self._supervisor.is_alive():
            self._supervisor.join(END_S)
        return ended

    def _run(self) -> None:
        self._prepare()
        self._turn()
        self._engine.ready()
        self._ready.set()
        while not self._end.is_set():
            self._turn()
        self._engine.heartbeats.forget(FOCUS_LOOP)
        self._engine.finish_stopping()

    def _turn(self) -> None:
        try:
            self._engine.step()
        except Exception as error:
            log.exception("focus thread failed")
            self._engine.worker.lost(error)

    def _supervise(self) -> None:
        pause_s = min(LOOK_EVERY_S, self._notifier.watchdog_s / 4 or LOOK_EVERY_S)
        while not self._end.wait(pause_s):
            self._watch.look()


class Supervisor:
    """Looks whether every loop lives; stops the lens of a focus thread that does not, once.

    A loop that the machine did not let run is not hung (``overload``). Its lens is stopped all the same where it moves
    by itself meanwhile, and what runs is ended, but nothing is latched, and the watchdog is fed.

    Parameters
    ----------
    engine, notifier
        Whom it watches over, and who hears that all is well.
    waited_s
        Tells how long this process has stood in line for a processor.
    """

    def __init__(
        self, engine: RigEngine, notifier: Notifier, waited_s: Callable[[], float] = overload.waited_s
    ) -> None:
        self._engine = engine
        self._notifier = notifier
        self._overload = Overload(waited_s)
        self._overload.look(engine.heartbeats.now_s())  # the first look may itself come late
        self._told = ""
        self._slow_looks_ago = FORGOTTEN_AFTER_LOOKS

    def look(self) -> None:
        """Look once."""
        beats = self._engine.heartbeats
        late = beats.late()
        self._overload.look(beats.now_s())
        hung = {loop for loop, silent_s in late.items() if self._overload.hung(silent_s, beats.limit_s(loop))}
        focus = "hung" if FOCUS_LOOP in hung else "slow" if FOCUS_LOOP in late else ""
        if focus != self._told:
            self._told = focus
            if focus == "hung":
                self._stop_for(late[FOCUS_LOOP])
            elif focus == "slow":
                self._bear_with(late[FOCUS_LOOP])
        self._slow_looks_ago = 0 if late else self._slow_looks_ago + 1
        if self._slow_looks_ago == FORGOTTEN_AFTER_LOOKS:
            self._engine.situation.unwarn("overloaded")
        if not hung:
            self._notifier.alive()

    def _stop_for(self, silent_s: float) -> None:
        """Stop the lens of a focus thread that hangs: the bytes first."""
        failure = self._engine.keeper.stop_lens(StopMode.ABRUPT)
        why = f"the focus thread was silent for {silent_s:.1f} s (limit {FOCUS_LIMIT_S:g}); the lens was stopped"
        if failure is not None:
            why = f"{why}, or should have been: {failure}"
        log.error("focus thread hangs", silent_s=silent_s, limit_s=FOCUS_LIMIT_S)
        if self._engine.place.cancel_all(Cancel.HOLD, why):  # a machine that is slow while nothing is done harms nobody
            self._engine.situation.latch("Hang", f"{why}; see the log for where it hung, then clear")

    def _bear_with(self, silent_s: float) -> None:
        """Say that the machine is overloaded; what moves by itself meanwhile is stopped."""
        starved_s = self._overload.starved_s(silent_s)
        why = (
            f"the machine is overloaded: the focus thread was silent for {silent_s:.1f} s (limit {FOCUS_LIMIT_S:g}), "
            f"of which this process stood in line for {starved_s:.1f} s; end what else runs, or give the "
            "daemon real-time priority"
        )
        if self._engine.keeper.in_real_time and self._engine.place.busy:
            self._engine.keeper.stop_lens(StopMode.ABRUPT)
            self._engine.place.cancel_all(Cancel.HOLD, f"{why}; the lens was stopped")
        log.warning("machine overloaded", silent_s=silent_s, starved_s=starved_s, limit_s=FOCUS_LIMIT_S)
        self._engine.situation.warn("overloaded", why)
