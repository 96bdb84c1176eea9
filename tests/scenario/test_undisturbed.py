"""Collections of garbage stop all threads: there is none while a lens moves."""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING, Any

import pytest
from scenarios import SMALL

from elpd import rig
from elpd.config import load
from elpd.focus.cycle import FocusCycle
from elpd.focus.settings import CycleSettings, FocusRequest
from elpd.records import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator


class Listener:
    """Takes a cycle's notes, and whether garbage may be collected at each."""

    def __init__(self) -> None:
        self.collecting: list[bool] = []

    def note(self, _event: str, /, **_fields: Any) -> None:
        self.collecting.append(gc.isenabled())


@pytest.fixture(params=["on", "off"])
def before(request: pytest.FixtureRequest) -> Iterator[str]:
    was = gc.isenabled()
    (gc.enable if request.param == "on" else gc.disable)()
    yield request.param
    (gc.enable if was else gc.disable)()


def test_no_garbage_is_collected_during_a_cycle_and_all_is_as_it_was_after_it(before: str) -> None:
    config = load(overrides=SMALL)
    parts, heard = rig.build(config), Listener()
    try:
        result = FocusCycle(parts, CycleSettings.from_config(config), FocusRequest(), heard).run()
    finally:
        rig.release(parts)
    assert result.outcome is Outcome.FOCUSED
    assert heard.collecting
    assert not any(heard.collecting)
    assert gc.isenabled() is (before == "on")
