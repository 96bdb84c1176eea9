"""Where focus is looked for next: every place of the travel within reach of one, each once, and then back."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from elpd.service.elsewhere import REACH_DOF, Elsewhere, places_um
from elpd.service.messages import FocusParams, LensStatus, MoveParams

LENS = LensStatus(driver="sim", connected=True, position_um=0.0, limits_um=(0.0, 2500.0))


@given(
    st.floats(-1e4, 1e4), st.floats(0.0, 1e4), st.floats(0.0, 1.0), st.floats(100.0, 1e4), st.floats(0.0, 1.0)
)  # fmt: skip
def test_all_of_a_travel_is_within_reach_of_here_or_of_a_place(
    low_um: float, span_um: float, here: float, reach_um: float, focus: float
) -> None:
    here_um, focus_um = low_um + here * span_um, low_um + focus * span_um
    found = places_um(here_um, (low_um, low_um + span_um), reach_um)
    assert all(low_um <= at <= low_um + span_um for at in found)
    assert min(abs(focus_um - at) for at in (here_um, *found)) <= reach_um * (1 + 1e-9)


def test_a_search_goes_and_looks_and_comes_back_once() -> None:
    search = Elsewhere()
    search.failed("NO_CROSSING", LENS, 900.0 / REACH_DOF)
    seen = []
    while search.goes_on:
        wish = search.wish()
        assert wish is not None
        method, params = wish
        if isinstance(params, MoveParams):
            seen.append(params.to_um)
            search.moved(ended_well=True)
        else:
            assert (method, params) == ("focus", FocusParams())
            seen.append(None)
            search.failed("NO_TEXTURE", LENS, 900.0 / REACH_DOF)
    assert seen == [625.0, None, 1875.0, None, 0.0]
    search.failed("NO_CROSSING", LENS, 900.0 / REACH_DOF)
    assert not search.goes_on, "not again for the same loss"
    search.forget()
    search.failed("NO_CROSSING", LENS, 900.0 / REACH_DOF)
    assert search.goes_on


def test_what_would_fail_anywhere_is_not_looked_for_elsewhere() -> None:
    search = Elsewhere()
    search.failed("EVENTS_LOST", LENS, 6.0)
    assert not search.goes_on
    search.failed("NO_CROSSING", LENS.model_copy(update={"limits_um": None}), 6.0)
    assert not search.goes_on


def test_a_move_that_fails_ends_the_search() -> None:
    search = Elsewhere()
    search.failed("NO_CROSSING", LENS, 6.0)
    search.moved(ended_well=False)
    assert not search.goes_on
