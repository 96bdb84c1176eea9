"""The rules as stories: a condition changes, the verdict follows; later rules outrank earlier ones."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.focus.safety import Action, Conditions, Verdict, decide
from elpd.records import Outcome

CALM = Conditions(travel_um=60.0, commanded_travel_um=60.0, reported_travel_um=58.0, events=10_000)


def test_a_calm_sweep_goes_on() -> None:
    assert decide(CALM) == Verdict(Action.CONTINUE)


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        ({"cancelled": True}, Outcome.CANCELLED),
        ({"ms_to_deadline": -1.0}, Outcome.DEADLINE),
        ({"lost_fraction": 0.3}, Outcome.EVENTS_LOST),
        ({"reported_travel_um": 3.0}, Outcome.LENS_DID_NOT_MOVE),
        ({"events": 10}, Outcome.TOO_FEW_EVENTS),
        ({"max_travel_um": 50.0}, Outcome.NO_CROSSING),
        ({"way_to_limit_um": 0.0}, Outcome.NO_CROSSING),
    ],
)
def test_each_trouble_has_its_outcome_and_says_what_to_do(change: dict[str, float], outcome: Outcome) -> None:
    verdict = decide(replace(CALM, **change))
    assert verdict.outcome is outcome
    assert verdict.action > Action.CONTINUE
    assert len(verdict.reason) > 20


def test_a_silent_camera_is_a_fault_and_outranks_a_cancel() -> None:
    verdict = decide(replace(CALM, camera_silent_ms=60.0, cancelled=True, max_travel_um=1.0))
    assert verdict.action is Action.FAULT
    assert "60 ms" in verdict.reason
    assert "50" in verdict.reason


def test_noise_alone_is_not_a_scene() -> None:
    """A sensor with 150 noise events in the time of the sweep, and nothing else, is looking at the dark."""
    assert decide(replace(CALM, events=160, resting_events=150.0)).outcome is Outcome.TOO_FEW_EVENTS


def test_a_lens_that_has_hardly_begun_is_not_yet_stuck() -> None:
    assert decide(replace(CALM, commanded_travel_um=10.0, reported_travel_um=0.0)).action is Action.CONTINUE


@given(
    cancelled=st.booleans(),
    ms_to_deadline=st.floats(-10, 1e4),
    silent_ms=st.floats(0, 200),
    travel_um=st.floats(0, 2000),
    events=st.integers(0, 10**7),
)
def test_a_verdict_that_ends_a_sweep_always_says_why(
    *, cancelled: bool, ms_to_deadline: float, silent_ms: float, travel_um: float, events: int
) -> None:
    verdict = decide(
        Conditions(
            cancelled=cancelled,
            ms_to_deadline=ms_to_deadline,
            camera_silent_ms=silent_ms,
            travel_um=travel_um,
            max_travel_um=1500.0,
            events=events,
        )
    )
    assert (verdict.action is Action.CONTINUE) == (verdict.reason == "")
    assert (verdict.action in {Action.GIVE_UP, Action.CANCEL}) == (verdict.outcome is not None)
