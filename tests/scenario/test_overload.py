"""More events than the computer takes: what is let go, what is made of the rest, and when it is too much."""

from typing import Any

import pytest
from scenarios import Event, Story, assert_invariants, play

from elpd.records import Outcome


def waiting(packets: int) -> Any:
    def fall_behind(story: Story) -> None:
        story.waiting = packets

    return fall_behind


def test_a_short_overload_is_told_and_focus_is_found_all_the_same() -> None:
    story = play("sim.seed=3", "sim.start_um=-500", events=[Event("sweep", 75.0, waiting(24))])
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.lost > 0
    assert any("7.0 ms of the sweep were not looked at" in told for told in story.result.warnings)
    assert_invariants(story)


def test_a_backlog_that_is_read_in_time_is_no_overload() -> None:
    calm, story = play("sim.seed=3"), play("sim.seed=3", events=[Event("sweep", 5.0, waiting(20))])
    assert story.result is not None
    assert calm.result is not None
    assert (story.result.focus_um, story.result.lost) == (calm.result.focus_um, 0)


@pytest.mark.parametrize("after_ms", [20.0, 50.0])
def test_an_overload_that_takes_too_much_is_refused(after_ms: float) -> None:
    story = play("sim.seed=3", events=[Event("sweep", after_ms, waiting(200))])
    assert story.outcome is Outcome.EVENTS_LOST
    assert_invariants(story)


def test_what_was_lost_while_the_sensor_was_at_rest_is_missing_in_no_sweep() -> None:
    """As with a camera whose ring ran full while nobody read it yet."""
    calm = play("sim.seed=3")
    probed_ms = next(fields["at_ms"] for fields in calm.named("phase") if fields["name"] == "probe")
    story = play("sim.seed=3", f"sim.drop_from_s={(probed_ms - 15.0) / 1e3}", "sim.drop_for_s=0.012")
    assert story.outcome is Outcome.FOCUSED
    assert story.result is not None
    assert story.result.lost > 100
    assert_invariants(story)
