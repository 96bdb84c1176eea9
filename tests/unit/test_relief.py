"""Where the parts of a region are in focus, by passes there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes_of_turns import turns_of_a_lag

from elpd.vision.relief import FEWEST_PAIRS, Parts, halves_apart, is_flat
from elpd.vision.turns import BLOCKS, Turns

WITHIN, REACH = 3.0, 40.0
LEFT = [row * BLOCKS + column for row in range(BLOCKS) for column in range(BLOCKS // 2)]


def there_and_back(
    apart: float = 0.0, pairs: int = 4000, late: float = 0.0, spread: float = 20.0
) -> tuple[Turns, Turns]:
    """Return turns there and back: the left half *apart* from the right, and *late* by that much more."""
    passes = []
    for sign, seed in ((1.0, 1), (-1.0, 2)):
        turns, _ = turns_of_a_lag(0.3, seed=seed, spread=spread)
        left = np.isin(turns.block, LEFT)
        # Upon a ruler that rises with time, what lies further up lies further down on the way back.
        middle = sign * 50.0 + (turns.middle - 50.0) + left * (sign * apart + late)
        part = slice(0, pairs)
        passes.append(
            replace(
                turns, middle=middle[part], gap=turns.gap[part], weights=turns.weights[part], block=turns.block[part],
                mode=float(np.median(middle[part])),
            )
        )  # fmt: skip
    return passes[0], passes[1]


def told(there: Turns, back: Turns) -> bool | None:
    return is_flat([Parts.of(there, REACH)], [Parts.of(back, REACH)], WITHIN)


def test_a_region_at_one_depth_is_flat_however_late_its_parts_are() -> None:
    assert told(*there_and_back()) is True
    assert told(*there_and_back(late=12.0)) is True


@pytest.mark.parametrize("apart", [10.0, 15.0, 25.0])
def test_halves_at_two_depths_are_not(apart: float) -> None:
    assert told(*there_and_back(apart)) is False


def test_what_lies_within_what_is_allowed_is_flat() -> None:
    assert told(*there_and_back(2.0)) is True


def test_where_pairs_are_few_the_quarters_are_asked_and_then_nobody() -> None:
    few = there_and_back(20.0, pairs=16 * FEWEST_PAIRS // 2, spread=1.2)
    assert not np.isfinite(Parts.of(few[0], REACH).sigma[: BLOCKS**2]).all()
    assert told(*few) is False
    assert told(*there_and_back(pairs=2 * FEWEST_PAIRS)) is None
    assert is_flat([Parts.of(few[0], REACH)], [], WITHIN) is None


def test_passes_in_one_direction_are_averaged_by_how_well_each_part_is_known() -> None:
    one = Parts(np.array([0.0, 4.0, 7.0]), np.array([1.0, np.inf, np.inf]))
    other = Parts(np.array([10.0, 8.0, 9.0]), np.array([2.0, 3.0, np.inf]))
    both = Parts.together([one, other])
    assert both.at.tolist() == [2.0, 8.0, 0.0]
    np.testing.assert_allclose(both.sigma, [0.8**0.5, 3.0, np.inf])


def test_no_pair_alone_moves_its_part() -> None:
    there, _ = there_and_back()
    heavy = there.weights.copy()
    heavy[0] = 1e6
    wild = there.middle.copy()
    wild[0] = there.mode + there.reach
    moved = Parts.of(replace(there, weights=heavy, middle=wild), REACH)
    np.testing.assert_allclose(moved.at, Parts.of(there, REACH).at, atol=0.3)


def test_halves_that_agree_know_the_mode_and_halves_that_do_not_say_so() -> None:
    there, _ = there_and_back()
    assert halves_apart(there) < 1.0
    apart, _ = there_and_back(15.0)
    assert halves_apart(apart) > 2.0
    heaps = replace(there, middle=there.middle + 30.0 * np.random.default_rng(3).integers(0, 2, there.middle.size))
    few = replace(heaps, middle=heaps.middle[:60], weights=heaps.weights[:60], block=heaps.block[:60])
    assert halves_apart(few) > 3.0
