"""When the daemon focuses by itself: not without evidence, not before the hold-off, ever more rarely for nothing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.service.modes import FOUND_AGAIN, MOST_FAILURES, Patience, View, decide, hold_off_s

PATIENCE = Patience(hold_off_s=2.0, settle_s=0.3, period_s=600.0)
WATCHING = View("continuous", now_s=100.0, focused_once=True, loss=0.0, quiet_s=10.0, since_s=0.0)


def test_a_picture_that_stays_sharp_is_left_alone() -> None:
    decision = decide(WATCHING, PATIENCE)
    assert (decision.focus, decision.waits_for) == (False, "a loss of sharpness")


def test_lost_sharpness_in_a_quiet_scene_is_focused_again() -> None:
    assert decide(replace(WATCHING, loss=1.1), PATIENCE).focus


def test_the_first_cycle_needs_no_evidence() -> None:
    assert decide(replace(WATCHING, focused_once=False, loss=None), PATIENCE).focus


@pytest.mark.parametrize(
    ("change", "waits_for"),
    [
        ({"quiet_s": 0.1}, "the scene to become quiet"),
        ({"since_s": 99.0}, "the end of the hold-off"),
        ({"blocked": "the end of a lease"}, "the end of a lease"),
        ({"failures": MOST_FAILURES}, "somebody to ask"),
        ({"mode": "one-shot"}, "somebody to ask"),
        ({"mode": "manual"}, "another mode"),
    ],
)
def test_everything_else_keeps_the_lens_where_it_is(change: dict[str, object], waits_for: str) -> None:
    decision = decide(replace(WATCHING, loss=5.0, **change), PATIENCE)  # type: ignore[arg-type]
    assert not decision.focus
    assert decision.waits_for.startswith(waits_for)


def test_between_the_two_levels_the_decision_of_before_holds() -> None:
    between = (1.0 + FOUND_AGAIN) / 2
    assert not decide(replace(WATCHING, loss=between), PATIENCE).defocused
    assert decide(replace(WATCHING, loss=between, defocused=True), PATIENCE).defocused
    assert not decide(replace(WATCHING, loss=FOUND_AGAIN - 0.01, defocused=True), PATIENCE).defocused


def test_what_is_never_heard_is_checked_again_in_time() -> None:
    patient = replace(PATIENCE, recheck_s=300.0)
    waiting = decide(replace(WATCHING, now_s=299.0), patient)
    assert (waiting.focus, waiting.waits_for, waiting.left_s) == (False, "a loss of sharpness", 1.0)
    due = replace(WATCHING, now_s=300.0)
    assert decide(due, patient).focus
    assert not decide(due, PATIENCE).focus
    assert not decide(replace(due, quiet_s=0.0), patient).focus, "not while the scene moves"
    assert decide(replace(due, loss=None, quiet_s=0.0), patient).focus, "where nothing is weighed nothing is waited for"
    assert not decide(replace(due, loss=None, blocked="the end of a lease"), patient).focus


def test_a_schedule_keeps_its_time_and_nothing_else() -> None:
    view = replace(WATCHING, mode="scheduled", loss=None, now_s=599.0)
    waiting = decide(view, PATIENCE)
    assert (waiting.focus, waiting.left_s) == (False, 1.0)
    assert decide(replace(view, now_s=600.0), PATIENCE).focus
    assert not decide(replace(view, now_s=600.0, blocked="the lens to be homed"), PATIENCE).focus


@given(st.integers(0, 40))
def test_the_hold_off_doubles_to_an_end(strikes: int) -> None:
    assert hold_off_s(replace(WATCHING, strikes=strikes), PATIENCE) == 2.0 * min(2**strikes, 64)


@given(
    losses=st.lists(st.floats(0, 50), min_size=1, max_size=300),
    quiet=st.lists(st.booleans(), min_size=1, max_size=50),
    ends=st.lists(st.sampled_from(["moved", "needless", "failed"]), min_size=1, max_size=20),
)
def test_whatever_the_evidence_it_never_hunts(losses: list[float], quiet: list[bool], ends: list[str]) -> None:
    """A minute of arbitrary evidence: cycles are never closer than their hold-off, and useless ones get rarer."""
    view = replace(WATCHING, now_s=0.0, since_s=0.0)
    begun: list[float] = []
    held: list[float] = []
    for turn in range(600):
        loss, is_quiet = losses[turn % len(losses)], quiet[turn % len(quiet)]
        view = replace(view, now_s=0.1 * turn, loss=loss, quiet_s=1.0 if is_quiet else 0.0)
        decision = decide(view, PATIENCE)
        view = replace(view, defocused=decision.defocused)
        if not decision.focus:
            continue
        assert is_quiet
        assert view.loss is not None
        assert view.loss > FOUND_AGAIN
        begun.append(view.now_s)
        held.append(hold_off_s(view, PATIENCE))
        end = ends[len(begun) % len(ends)]
        view = replace(
            view,
            since_s=view.now_s,
            defocused=False,
            strikes=0 if end == "moved" else view.strikes + 1,
            failures=view.failures + 1 if end == "failed" else 0,
        )
    waits = [after - before for before, after in pairwise(begun)]
    assert all(wait >= hold - 1e-9 for wait, hold in zip(waits, held[1:], strict=True))
    if set(ends) == {"needless"}:
        assert len(begun) <= 6
    if set(ends) == {"failed"}:
        assert len(begun) <= MOST_FAILURES
