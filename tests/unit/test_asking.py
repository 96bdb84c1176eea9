"""When to ask again, and when silence is a fault, on lines that answer late and for hosts that look seldom."""

from __future__ import annotations

import pytest
from elpd_drivers.lenses.asking import LATE_MS, REMEMBERED, Asking
from elpd_drivers.lenses.line import Trouble

MS = 1_000_000


def converse(asking: Asking, answer_ms: float, turns: int, look_ms: float = 1.0) -> None:
    """Look every *look_ms* and answer each question after *answer_ms*."""
    now, asked = 0.0, None
    for _ in range(turns):
        now += look_ms
        if asked is not None and now - asked >= answer_ms:
            asking.answered()
            asking.believed()
            asked = None
        asking.check(round(now * MS), "")
        if asking.due(round(now * MS)):
            asking.asked(round(now * MS))
            asked = now if asked is None else asked


def look_on(asking: Asking, times_ms: range) -> None:
    for ms in times_ms:
        asking.check(ms * MS, "")


@pytest.mark.parametrize(("answer_ms", "held"), [(1.0, False), (LATE_MS - 2, False), (LATE_MS + 2, True), (16.0, True)])
def test_late_answers_are_told_from_prompt_ones(answer_ms: float, *, held: bool) -> None:
    asking = Asking(4.0, 50.0)
    converse(asking, answer_ms, 40 * REMEMBERED)
    assert bool(asking.held_ns) == held
    assert bool(asking.remarks) == held


def test_a_host_that_looks_seldom_does_not_blame_the_line() -> None:
    asking = Asking(4.0, 50.0)
    converse(asking, 1.0, 100, look_ms=45.0)
    assert asking.remarks == ()


def test_a_pause_in_which_nobody_looked_is_no_silence_of_the_controller() -> None:
    asking = Asking(4.0, 50.0)
    asking.check(0, "")
    asking.asked(0)
    asking.check(3000 * MS, "")
    for ms in range(3000, 3030):
        asking.check(ms * MS, "")
    with pytest.raises(Trouble, match="no valid reply for"):
        look_on(asking, range(3030, 3060))


def test_after_a_question_that_was_asked_twice_the_second_answer_has_time_to_come() -> None:
    asked_once, asked_twice = Asking(4.0, 50.0), Asking(4.0, 50.0)
    for asking in (asked_once, asked_twice):
        asking.check(0, "")
        asking.asked(0)
        look_on(asking, range(1, 14))
    asked_twice.asked_again()
    asked_twice.asked(13 * MS)
    for asking in (asked_once, asked_twice):
        asking.answered()
        asking.believed()
    assert asked_once.due(18 * MS)
    assert asked_twice.pausing(18 * MS)
    assert not asked_twice.due(18 * MS)
    assert asked_twice.due(60 * MS)


def test_a_question_waits_for_twice_what_answers_take() -> None:
    asking = Asking(4.0, 50.0)
    converse(asking, 11.0, 200)
    asking.answered()
    asking.asked(1000 * MS)
    assert not asking.due(1019 * MS)
    assert asking.due(1023 * MS)
