"""A day of continuous autofocus, or as long as it is run; hours in which nobody listens are leapt over.

Focus is knocked away while the camera listens, and the daemon is expected to find it again by itself; people come and
ask, and now and then something breaks. What must hold is asserted at every turn (``stage``): the lens stays inside its
limits, it rests when nothing is done, every request has one answer.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from elpd.service import memory
from soaks.misfortunes import Later, misfortunes
from soaks.people import visit
from soaks.stage import ANSWERED_S, TRAVEL_UM, KilledError, Stage

if TYPE_CHECKING:
    from pathlib import Path

KNOCK_S = 0.4
"""How long after the camera began to listen focus is knocked away; the rest of the look hears of it."""

KNOCK_UM, KNOCK_MS, KNOCKS = 90.0, 40.0, 0.75
"""How far (standard deviation), how long it takes, and in which share of the looks."""

ROOM_UM = 500.0
"""Focus stays so far from the ends of the travel."""

PEOPLE_EVERY_S = 240.0
MISFORTUNE_EVERY_S = 900.0
CLEARED_AFTER_S = 30.0
WEIGHED_EVERY_S = 1800.0


class Day:
    """What happens when. Everything follows from the seed."""

    def __init__(
        self,
        seed: int,
        directory: Path,
        *,
        people_every_s: float = PEOPLE_EVERY_S,
        misfortune_every_s: float = MISFORTUNE_EVERY_S,
    ) -> None:
        self.enough = False
        """Set to end ``run`` early."""
        self._stage = Stage(seed, directory)
        self._people_every_s, self._misfortune_every_s = people_every_s, misfortune_every_s
        self._next_person_s = self._next_misfortune_s = 0.0
        self._clear_at_s: float | None = None
        self._knocked_look = True

    def run(self, hours: float, cycles: int = 0) -> None:
        """Let so many hours pass, and more until there were so many cycles."""
        stage = self._stage
        memory.drop_compiler()  # as the daemon does
        end_s, weighed_s = stage.elapsed_s + 3600.0 * hours, stage.elapsed_s
        while not self.enough and (stage.elapsed_s < end_s or stage.ledger.outcomes.total() < cycles):
            try:
                self._turn()
            except KilledError:
                stage.killed()
            if stage.elapsed_s - weighed_s >= WEIGHED_EVERY_S:
                weighed_s = stage.elapsed_s
                row = stage.ledger.weigh(weighed_s / 3600)
                print(f"{row}  {dict(stage.ledger.outcomes)}", file=sys.stderr, flush=True)

    def finish(self) -> None:
        """End in order; nothing may be left unanswered."""
        self._stage.finish()

    def figures(self) -> dict[str, Any]:
        """Return what came of it."""
        return {"hours": round(self._stage.elapsed_s / 3600, 2), **self._stage.ledger.figures()}

    # --- one turn ---

    def _turn(self) -> None:
        stage = self._stage
        before = stage.ledger.outcomes.total()
        stage.engine.step()
        if stage.ledger.outcomes.total() != before:
            memory.give_back()  # as the daemon does
        stage.elapsed_s = stage.time.now_s()
        stage.check()
        self._knock()
        if stage.elapsed_s > self._next_person_s:
            self._next_person_s = stage.elapsed_s + float(stage.chance.exponential(self._people_every_s))
            visit(stage)
        if stage.elapsed_s > self._next_misfortune_s:
            self._next_misfortune_s = stage.elapsed_s + float(stage.chance.exponential(self._misfortune_every_s))
            self._misfortune()
        if stage.engine.situation.fault is None:
            self._clear_at_s = None
        elif self._clear_at_s is None:
            self._clear_at_s = stage.elapsed_s + CLEARED_AFTER_S
        elif stage.elapsed_s > self._clear_at_s:
            self._clear_at_s = None
            stage.recover()

    def _knock(self) -> None:
        """Move focus while the camera listens, once a look, mostly."""
        stage = self._stage
        if stage.engine.place.current is not None or not stage.engine.idle.looking:
            self._knocked_look = False
            return
        if self._knocked_look or stage.chance.random() > KNOCKS:
            self._knocked_look = True
            return
        self._knocked_look = True
        by_um = float(stage.chance.normal(0.0, KNOCK_UM))
        if not ROOM_UM < stage.focus_um + by_um < TRAVEL_UM - ROOM_UM:
            by_um = -by_um
        stage.ledger.counts["knocks"] += 1
        stage.shift(by_um, KNOCK_S, KNOCK_MS)

    def _misfortune(self) -> None:
        """Let something break, at any moment of whatever is being done."""
        stage = self._stage
        if stage.engine.keeper.parts is None or stage.engine.situation.fault is not None:
            return
        what = misfortunes(stage)
        name = str(stage.chance.choice(list(what)))
        stage.ledger.counts[name] += 1
        if stage.chance.random() < 0.5 or name.startswith("27"):
            stage.ask("focus")
            stage.world.add(Later(stage.world.now_ns() + int(stage.chance.uniform(1e6, 300e6)), what[name]))
            stage.until(lambda: not stage.waiting, ANSWERED_S)
        else:
            what[name]()
        if stage.afterwards is not None and stage.engine.situation.fault is None and stage.engine.worker.reload is None:
            stage.afterwards()
            stage.afterwards = None
