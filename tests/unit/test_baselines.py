"""Each peer where it is known to work, and where it is documented to fail."""

import math
from dataclasses import replace

import naive_baselines as naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_baselines import SWEEP_US, little_stack, stack_of_rates, stars, texture

from elpd.baselines import PEERS, FocusStack, LensPath, StackFrame
from elpd.baselines.egs import golden_search
from elpd.baselines.elp_published import SYN, adaptive_filter, run
from elpd.baselines.esva import prominent_peaks
from elpd.baselines.pbf import mirror_similarity
from elpd.baselines.rates import polarity_rates, smooth, vertex
from elpd.records import Geometry, Roi

FOCUS_US = 100_000.0


@pytest.fixture(scope="module")
def still() -> FocusStack:
    return little_stack(texture(1))


@pytest.fixture(scope="module")
def sky() -> FocusStack:
    return little_stack(stars(2))


@pytest.fixture(scope="module")
def contrasty() -> FocusStack:
    """Squares of four pixels, seventeen times brighter than what is between them."""
    bright = np.random.default_rng(4).random((12, 12)) >= 0.5
    return little_stack(np.kron(np.where(bright, 2.6, 0.15), np.ones((4, 4))))


@pytest.fixture(scope="module")
def flowing() -> FocusStack:
    """A scene that drifts at 40 px/s behind a high threshold: flow makes the events, and a sharp picture makes most."""
    return little_stack(texture(3), move=lambda t_us: 4e-5 * t_us * 5.0, threshold=0.25)


# --- where they work ---------------------------------------------------------------------------------------------


def test_egs_and_the_rate_maximum_find_focus_where_flow_makes_the_events(flowing: FocusStack) -> None:
    assert abs(PEERS["egs"].run(flowing).focus_us - FOCUS_US) < 12_000
    assert abs(PEERS["event-rate"].run(flowing).focus_us - FOCUS_US) < 12_000


def test_pbf_finds_the_centre_of_symmetry_of_a_still_scene(still: FocusStack) -> None:
    answer = PEERS["pbf"].run(still)
    assert abs(answer.focus_us - FOCUS_US) < 6_000
    assert answer.details["similarity"] > 0.5


def test_pbf_is_not_misled_by_unequal_thresholds_or_a_noise_floor() -> None:
    on = [50, 80, 120, 200, 320, 90, 40, 60, 50, 45, 40, 42, 40, 41, 40]
    on = [40] * 30 + on + [40] * 30
    off = [2 * value for value in reversed(on)]
    centre_us = 0.5 * len(on) * 1_000
    answer = PEERS["pbf"].run(stack_of_rates(on, off))
    assert answer.focus_us == pytest.approx(centre_us, abs=600)
    assert answer.details["gain"] == pytest.approx(0.5)


def test_balance_tips_where_bright_points_are_sharpest(sky: FocusStack) -> None:
    assert abs(PEERS["balance"].run(sky).focus_us - FOCUS_US) < 6_000
    assert PEERS["balance"].run(sky).details["tilt"] > 0.3


def test_esva_finds_the_valley_of_a_still_scene(still: FocusStack) -> None:
    answer = PEERS["esva"].run(still)
    # The valley is as late as the first opposite events: a threshold's hysteresis.
    assert 0 < answer.focus_us - FOCUS_US < 10_000
    assert answer.details["confidence_per_ms"] > 0.0


@pytest.mark.parametrize("name", ["tenengrad", "laplacian-variance", "hill-climb", "fibonacci"])
def test_contrast_peaks_at_focus_and_searches_end_there(still: FocusStack, name: str) -> None:
    answer = PEERS[name].run(still)
    assert abs(answer.focus_us - FOCUS_US) < 2_000


def test_searches_present_the_bill_for_their_moves(still: FocusStack) -> None:
    climb, fibonacci = PEERS["hill-climb"].run(still), PEERS["fibonacci"].run(still)
    for answer in (climb, fibonacci):
        assert answer.details["moves"] >= 5
        # At least a frame period for every frame waited for, besides the travel.
        assert answer.details["search_us"] > 10_000 * answer.details["frames"]
    # Fibonacci needs fewer frames but drives to and fro.
    assert fibonacci.details["frames"] <= climb.details["frames"]


def test_published_elp_finds_the_sign_change_and_says_when_it_could_know(still: FocusStack) -> None:
    scaled = replace(SYN, span=2.0, below=-1.0)
    answer = run(still, scaled)
    assert 0 < answer.details["transition_us"] - FOCUS_US < 15_000
    # The release answers three bins and five milliseconds before the transition it saw; the decision came after it.
    assert answer.focus_us == answer.details["transition_us"] - 2_000 - 2 * 2_000 - 5_000
    assert answer.details["trigger_us"] > answer.details["transition_us"]


@pytest.mark.parametrize("name", ["elp-syn", "elp-syn-1fps", "elp-davis", "elp-evk4", "elp-no-filter"])
def test_published_elp_works_with_its_own_constants_where_contrast_is_high(name: str, contrasty: FocusStack) -> None:
    """Each data set's thresholds, as released, on a scene whose grey levels reach them."""
    answer = PEERS[name].run(contrasty)
    assert abs(answer.focus_us - FOCUS_US) < 12_000
    assert answer.details["trigger_us"] > FOCUS_US


def test_without_a_laplacian_elp_works_where_all_that_is_sharp_is_bright(sky: FocusStack) -> None:
    answer = PEERS["elp-no-laplacian"].run(sky)
    assert abs(answer.focus_us - FOCUS_US) < 12_000


# --- where they are documented to fail ---------------------------------------------------------------------------


def test_egs_lands_on_a_peak_beside_focus_where_nothing_moves(still: FocusStack) -> None:
    """The rate of a still scene has two peaks and a valley at focus; golden search takes one of the peaks."""
    rates = polarity_rates(still, 2_000).both
    middle = int(FOCUS_US // 2_000)
    assert rates[middle - 1 : middle + 1].sum() < 0.3 * np.sort(rates)[-2:].sum()
    assert abs(PEERS["egs"].run(still).focus_us - FOCUS_US) > 6_000


def test_balance_follows_a_lamp_that_comes_on(sky: FocusStack) -> None:
    rates = polarity_rates(sky, 1_000)
    on = rates.on.astype(int)
    on[150:155] += 5_000
    answer = PEERS["balance"].run(stack_of_rates(on.tolist(), rates.off.astype(int).tolist()))
    assert 145_000 < answer.focus_us < 160_000


def test_esva_has_no_valley_in_a_single_peak() -> None:
    on = [round(200 * math.exp(-0.5 * ((k - 50) / 12) ** 2)) + 2 for k in range(100)]
    answer = PEERS["esva"].run(stack_of_rates(on, on))
    assert not answer.found
    assert "valley" in answer.details["reason"]


def test_hill_climbing_stops_on_a_false_peak() -> None:
    """Two peaks of contrast: the climb takes the one it meets first, the full stack the higher one."""
    heights = np.concatenate((np.linspace(1, 5, 8), np.linspace(5, 1, 8), np.linspace(1, 9, 8), np.linspace(9, 1, 8)))
    grid = np.indices((SIDE := 16, SIDE)).sum(axis=0) % 4 < 2
    frames = tuple(
        StackFrame(10_000 * k, (100 + 10 * height * grid).astype(np.uint8)) for k, height in enumerate(heights)
    )
    nothing = np.empty(0, dtype=np.int64)
    empty = FocusStack(
        nothing,
        nothing.astype(np.uint16),
        nothing.astype(np.uint16),
        nothing.astype(np.uint8),
        Geometry(SIDE, SIDE),
        Roi(0, 0, SIDE, SIDE),
        0,
        310_000,
        frames,
    )
    assert abs(PEERS["hill-climb"].run(empty).focus_us - 75_000) < 15_000
    assert abs(PEERS["tenengrad"].run(empty).focus_us - 235_000) < 15_000


def test_published_thresholds_do_not_transfer_to_another_contrast(still: FocusStack) -> None:
    """The release's numbers are grey levels per event of its own scenes; a faint picture never reaches them."""
    faint = replace(still, frames=tuple(StackFrame(f.t_us, f.pixels // 40) for f in still.frames))
    answer = PEERS["elp-syn"].run(faint)
    assert not answer.found
    assert "thresholds" in answer.details["reason"]


def test_without_a_laplacian_the_series_is_only_the_rate_of_off_less_on(still: FocusStack) -> None:
    rates = polarity_rates(still, 2_000)
    answer = PEERS["elp-no-laplacian"].run(still)
    balance = (rates.off - rates.on) / np.maximum(rates.both, 1.0)
    assert "curve" in answer.details
    assert np.all(np.abs(answer.details["curve"]["elp"]) <= np.abs(balance).max() + 1e-9)


# --- what every peer must do -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(PEERS))
def test_every_peer_answers_an_empty_stack_with_a_reason(name: str) -> None:
    nothing = np.empty(0, dtype=np.int64)
    short = tuple(kind(nothing) for kind in (np.uint16, np.uint16, np.uint8))
    empty = FocusStack(nothing, *short, Geometry(8, 8), Roi(0, 0, 8, 8), 0, SWEEP_US)
    answer = PEERS[name].run(empty)
    assert not answer.found
    assert answer.details["reason"]


@pytest.mark.parametrize("name", list(PEERS))
def test_no_peer_depends_on_where_time_begins(name: str, still: FocusStack) -> None:
    moved = replace(
        still,
        t_us=still.t_us + 5_000_000,
        begin_us=still.begin_us + 5_000_000,
        end_us=still.end_us + 5_000_000,
        frames=tuple(StackFrame(frame.t_us + 5_000_000, frame.pixels) for frame in still.frames),
    )
    here, there = PEERS[name].run(still), PEERS[name].run(moved)
    assert here.found == there.found
    if here.found:
        assert there.focus_us - here.focus_us == pytest.approx(5_000_000, abs=0.01)


def test_a_lens_that_brakes_is_looked_up_by_its_path() -> None:
    path = LensPath(np.array([0.0, 100.0, 300.0]), np.array([0.0, 50.0, 60.0]))
    assert path.at(200.0) == 55.0
    assert path.time_at(55.0) == 200.0
    back = LensPath(path.t_us, -path.position_um)
    assert back.time_at(-55.0) == 200.0


# --- twins -------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 60_000), min_size=2, max_size=60))
@settings(max_examples=60, deadline=None)
def test_golden_search_is_its_twin(stamps: list[int]) -> None:
    t_us = np.sort(np.array(stamps, dtype=np.int64))
    assert golden_search(t_us)[0] == naive.golden_search(t_us.tolist())


@given(
    st.integers(2, 24).flatmap(
        lambda n: st.tuples(*(st.lists(st.integers(0, 9), min_size=n, max_size=n) for _ in range(2)), st.integers(2, 9))
    )
)
@settings(max_examples=60, deadline=None)
def test_mirror_similarity_is_its_twin(drawn: tuple[list[int], list[int], int]) -> None:
    on, off, reach = drawn
    fast = np.empty(2 * len(on) - 1)
    mirror_similarity(np.array(on, dtype=np.float64), np.array(off, dtype=np.float64), reach, fast)
    slow = naive.mirror_similarity(on, off, reach)
    np.testing.assert_allclose(fast, slow, rtol=1e-9, atol=1e-9)


@given(st.lists(st.floats(-2e5, 2e5), min_size=1, max_size=40))
@settings(max_examples=60, deadline=None)
def test_the_released_filter_is_its_twin(raw: list[float]) -> None:
    np.testing.assert_allclose(adaptive_filter(np.array(raw)), naive.adaptive_filter(raw), rtol=1e-9, atol=1e-6)


def test_prominence_counts_from_the_saddle() -> None:
    curve = np.array([0.0, 5.0, 3.0, 4.0, 1.0, 6.0, 6.0, 0.0])
    assert prominent_peaks(curve, 0.9) == [1, 3, 5]
    assert prominent_peaks(curve, 1.5) == [1, 5]
    assert prominent_peaks(curve, 4.5) == [5]


def test_smoothing_keeps_a_constant_and_a_vertex_is_exact_for_a_parabola() -> None:
    np.testing.assert_allclose(smooth(np.full(9, 7.0), 3.0), 7.0)
    parabola = -((np.arange(9.0) - 4.3) ** 2)
    assert vertex(parabola, 4) == pytest.approx(4.3)
    assert vertex(parabola, 0) == 0.0
