"""Several depths are told apart by their pairs, one depth is not taken for several, and nor is motion."""

import numpy as np
import pytest

from elpd.vision.depths import find_depths

WIDTH = 30.0


def plane(seed: int, at: float, count: int = 600, spread: float = 1.5, columns: tuple[int, int] = (0, 96)) -> tuple:
    rng = np.random.default_rng(seed)
    x = rng.integers(*columns, count).astype(np.uint16)
    return rng.normal(at, spread, count), rng.random(count) + 0.5, x, rng.integers(0, 96, count).astype(np.uint16)


def joined(*planes: tuple) -> tuple[np.ndarray, ...]:
    return tuple(np.concatenate(column) for column in zip(*planes, strict=True))


@pytest.mark.parametrize("apart", [14.0, 20.0, 60.0])
def test_two_planes_are_found_nearest_first(apart: float) -> None:
    middle, weights, x, y = joined(plane(0, apart, columns=(0, 48)), plane(1, 0.0, columns=(48, 96)))
    found = find_depths(middle, weights, x, y, WIDTH)
    assert [np.median(middle[one]) for one in found] == pytest.approx([0.0, apart], abs=0.5)


def test_three_planes() -> None:
    parts = [plane(k, 20.0 * k, columns=(32 * k, 32 * k + 32)) for k in range(3)]
    assert len(find_depths(*joined(*parts), WIDTH)) == 3


@pytest.mark.parametrize("spread", [0.5, 1.5, 4.0, 12.0])
def test_one_plane_is_one_however_wide_its_pairs_scatter(spread: float) -> None:
    for seed in range(20):
        assert find_depths(*plane(seed, 0.0, spread=spread), WIDTH) == []


def test_planes_within_two_depths_of_focus_are_one() -> None:
    assert find_depths(*joined(plane(0, 0.0, 500, 0.4, (0, 48)), plane(1, 8.0, 500, 0.4, (48, 96))), WIDTH) == []


def test_clusters_at_the_same_places_are_motion() -> None:
    assert find_depths(*joined(plane(0, 0.0), plane(1, 30.0)), WIDTH) == []


def test_a_small_cluster_and_scattered_pairs_are_no_depth() -> None:
    few = joined(plane(0, 0.0, 1000, columns=(0, 80)), plane(1, 30.0, 30, columns=(80, 96)))
    assert find_depths(*few, WIDTH) == []
    rng = np.random.default_rng(2)
    stray = (rng.uniform(-60, 60, 900), np.ones(900), *(rng.integers(0, 96, 900).astype(np.uint16) for _ in range(2)))
    halves = joined(plane(0, 0.0, columns=(0, 48)), plane(1, 30.0, columns=(48, 96)))
    assert find_depths(*joined(halves, stray), WIDTH) == []


def test_too_few_pairs_or_no_width_say_nothing() -> None:
    assert find_depths(*joined(plane(0, 0.0, 30), plane(1, 30.0, 30)), WIDTH) == []
    assert find_depths(*joined(plane(0, 0.0), plane(1, 30.0)), 0.0) == []
