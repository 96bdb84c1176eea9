"""A silent loop: hung, or kept from running?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.service.overload import MOST_PATIENCE_S, Overload, waited_s

if TYPE_CHECKING:
    from pathlib import Path


def judge(*looks: tuple[float, float]) -> Overload:
    """Return one that has looked at these instants, and seen so many seconds in line at each."""
    seen = iter([waited for _, waited in looks])
    overload = Overload(lambda: next(seen))
    for now_s, _ in looks:
        overload.look(now_s)
    return overload


def test_a_thread_that_waits_for_nothing_the_machine_could_give_has_hung() -> None:
    overload = judge((0.0, 5.0), (1.0, 5.0), (2.0, 5.0))
    assert overload.starved_s(1.5) == 0.0
    assert overload.hung(1.5, 1.0)


def test_a_silence_in_line_for_a_processor_is_the_machines() -> None:
    overload = judge((0.0, 5.0), (1.0, 5.7), (2.0, 6.5))
    assert overload.starved_s(1.0) == pytest.approx(0.8)
    assert not overload.hung(1.2, 1.0)
    assert overload.hung(3.0, 1.0), "1.5 of its 3 seconds are its own"


def test_waits_before_the_silence_excuse_nothing() -> None:
    overload = judge((0.0, 0.0), (1.0, 30.0), (2.0, 30.0), (3.0, 30.0))
    assert overload.hung(1.5, 1.0)


def test_patience_has_an_end() -> None:
    looks = [(float(s), 2.0 * s) for s in range(13)]
    overload = judge(*looks)
    assert not overload.hung(MOST_PATIENCE_S, 1.0)
    assert overload.hung(MOST_PATIENCE_S + 1.1, 1.0)


def test_one_that_has_not_looked_yet_excuses_nothing() -> None:
    assert Overload(lambda: 9.0).hung(1.1, 1.0)


@given(st.lists(st.tuples(st.floats(0.01, 2), st.floats(0, 5)), min_size=1, max_size=60), st.floats(0, 30))
def test_no_more_is_excused_than_the_silence(steps: list[tuple[float, float]], silent_s: float) -> None:
    now_s = waited = 0.0
    looks = []
    for pause_s, more in steps:
        now_s, waited = now_s + pause_s, waited + more
        looks.append((now_s, waited))
    assert 0.0 <= judge(*looks).starved_s(silent_s) <= silent_s


def test_the_line_is_the_sum_over_threads(tmp_path: Path) -> None:
    for name, text in (("1", "10 2000000000 5\n"), ("2", "7 500000000 1\n"), ("3", "torn")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "schedstat").write_text(text)
    (tmp_path / "4").mkdir()
    assert waited_s(tmp_path) == pytest.approx(2.5)
    assert waited_s(tmp_path / "nothing") == 0.0
