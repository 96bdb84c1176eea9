"""Passes there and back, each of which measured the lag by itself."""

from __future__ import annotations

import pytest

from elpd.focus import passes as said_of
from elpd.vision.witness import Witness

WHEN = (0.0, 1.0)


def passes_of(lag: float, *said: tuple[float, float, int]) -> said_of.Passes:
    """Return passes over a focus at 100, late by *lag*; each took some of it off, with an error, in a direction."""
    passes = said_of.Passes()
    for freed, shared, sign in said:
        at = sign * 100.0 + lag - freed
        one = Witness("pairs", at, 0.3, shared, freed=freed)
        passes.add(said_of.Testimony((one,)), sign, WHEN)
    return passes


def test_what_each_pass_took_off_for_lag_cancels_there_and_back() -> None:
    estimate = passes_of(6.0, (2.0, 4.0, 1), (7.0, 3.0, -1)).estimate(said_of.NO_PLAY)
    assert estimate is not None
    assert estimate.focus_um == pytest.approx(100.0, abs=0.01)
    assert estimate.sigma_um == pytest.approx(0.3 / 2**0.5, rel=0.05)
    assert estimate.method == "two_crossings"


def test_one_pass_keeps_what_it_measured() -> None:
    estimate = passes_of(9.0, (7.0, 3.0, 1)).estimate(said_of.NO_PLAY)
    assert estimate is not None
    assert estimate.focus_um == pytest.approx(102.0)
    assert estimate.sigma_um == pytest.approx(3.0, rel=0.01)


def test_another_lag_moves_a_witness_by_what_it_is_more() -> None:
    one = Witness("pairs", 10.0, 0.3, 2.0, freed=1.5)
    other = one.with_lag(4.0, 1.0)
    assert (other.at, other.freed, other.shared) == (7.5, 4.0, 1.0)
    back = one.on_the_way_back(0.0, 0.0)
    assert back.freed == -one.freed
    assert back.with_lag(-4.0, -1.0).at == pytest.approx(-other.at)
