"""People at odds with each other: whatever the order, each accepted request has one answer and a stop always wins."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from engines import ME, SOMEBODY, Asked, Daemon
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from elpd.errors import BusyError, ElpdError
from elpd.service.messages import LEASE_FREE

CALLERS = st.sampled_from([ME, SOMEBODY])


class Conflicts(RuleBasedStateMachine):
    """Two people and the daemon's own turns, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.daemon = Daemon(Path(self.folder.name), "journal.enabled=false").begin()
        self.stopped: list[Asked] = []

    def teardown(self) -> None:
        for _ in range(20):
            self.daemon.engine.step()
        self.daemon.assert_all_answered()
        self.daemon.end()
        self.folder.cleanup()

    @rule(by=CALLERS, fraction=st.floats(0, 1))
    def move(self, by: Any, fraction: float) -> None:
        self._ask("move", by, fraction=fraction)

    @rule(by=CALLERS, by_um=st.floats(-3000, 3000))
    def jog(self, by: Any, by_um: float) -> None:
        self._ask("jog", by, by_um=by_um)

    @rule(by=CALLERS, action=st.sampled_from(["acquire", "renew", "release"]))
    def lease(self, by: Any, action: str) -> None:
        self._ask("lease", by, action=action, seconds=60.0)

    @rule(by=CALLERS)
    def stop(self, by: Any) -> None:
        waiting = [asked for asked in self.daemon.asked if not asked.answers]
        asked = self._ask("stop", by)
        assert asked is not None, "a stop is never refused"
        assert asked.result.stopped
        self.stopped += waiting

    @rule(by=CALLERS)
    def cancel(self, by: Any) -> None:
        waiting = any(not asked.answers for asked in self.daemon.asked)
        asked = self._ask("cancel", by)
        assert asked is not None
        assert asked.result.cancelled is waiting

    @rule(by=CALLERS)
    def leave(self, by: Any) -> None:
        self.daemon.engine.gone(by)

    @rule()
    def turn(self) -> None:
        self.daemon.engine.step()

    @invariant()
    def nothing_moves_between_requests(self) -> None:
        assert self.daemon.velocity == 0.0
        assert 0.0 <= self.daemon.steps * self.daemon.parts.um_per_step <= 2500.0

    @invariant()
    def what_was_stopped_before_its_turn_did_not_move(self) -> None:
        for asked in self.stopped:
            assert not asked.answers or asked.kind == "Cancelled"

    def _ask(self, method: str, by: Any, **params: Any) -> Asked | None:
        try:
            return self.daemon.ask(method, by=by, **params)
        except BusyError:
            assert method not in LEASE_FREE or method == "lease"
        except ElpdError as error:
            raise AssertionError(f"{method}: {error}") from error
        return None


Conflicts.TestCase.settings = settings(
    max_examples=12,
    stateful_step_count=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
test_conflicts = Conflicts.TestCase
