"""The lens's ruler."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.errors import ConfigError
from elpd.scale import LensScale

TABLE = ((0.0, 0.0), (4000.0, 1000.0), (8000.0, 2500.0))


@given(st.integers(-50_000, 50_000), st.floats(0.01, 20.0))
def test_steps_come_back_through_a_straight_ruler(steps: int, um_per_step: float) -> None:
    scale = LensScale(um_per_step)
    assert scale.to_steps(scale.to_um(steps)) == steps


@given(
    st.integers(-20_000, 20_000),
    st.lists(st.tuples(st.floats(1.0, 900.0), st.floats(0.5, 900.0)), min_size=2, max_size=8),
)
def test_steps_come_back_through_a_table(steps: int, rises: list[tuple[float, float]]) -> None:
    rows, at, um = [], -2000.0, 100.0
    for dx, dy in rises:
        rows.append((at, um))
        at, um = at + dx, um + dy
    scale = LensScale(0.3, tuple(rows))
    assert scale.to_steps(scale.to_um(steps)) == steps
    assert scale.to_um(steps + 1) > scale.to_um(steps)


def test_a_table_is_read_between_its_rows_and_beyond_its_ends() -> None:
    scale = LensScale(0.3125, TABLE)
    assert scale.to_um(2000) == 500.0
    assert scale.to_um(6000) == 1750.0
    assert scale.to_um(-1000) == -250.0
    assert scale.to_um(9000) == 2875.0
    assert scale.um_per_step_at(100.0) == 0.25
    assert scale.um_per_step_at(2000.0) == 0.375
    assert LensScale(0.3125).um_per_step_at(7.0) == 0.3125


@pytest.mark.parametrize(
    ("um_per_step", "table", "told"),
    [
        (0.0, (), "lens.um_per_step is 0"),
        (float("nan"), (), "lens.um_per_step is nan"),
        (0.3, ((0.0, 0.0),), "one row"),
        (0.3, ((0.0, 0.0), (10.0, -3.0)), r"\(10, -3\) follows \(0, 0\)"),
        (0.3, ((0.0, 0.0), (0.0, 3.0)), r"\(0, 3\) follows \(0, 0\)"),
    ],
)
def test_what_is_no_ruler_is_refused(um_per_step: float, table: tuple[tuple[float, float], ...], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        LensScale(um_per_step, table)
