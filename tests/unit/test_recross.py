"""When further rounds over focus are worth their time."""

from __future__ import annotations

from math import hypot

import pytest

from elpd.focus.passes import Play
from elpd.focus.recross import _lessened
from elpd.focus.settings import CycleSettings
from elpd.records import FocusEstimate


def test_what_the_lens_and_the_play_leave_open_no_further_round_would_lessen() -> None:
    settings = CycleSettings(backlash_um=6.0)
    half_play_um = 0.5 * Play.up_to(6.0).sigma_um
    estimate = FocusEstimate(10.0, hypot(1.0, 2.0, half_play_um), "two_crossings", (), 2.0)
    lessened = _lessened(estimate, settings)
    assert lessened is not None
    assert lessened.sigma_um == pytest.approx(1.0)
    measured = _lessened(estimate, CycleSettings(measured_play_um=(4.0, 0.1)))
    assert measured is not None
    assert measured.sigma_um > lessened.sigma_um, "of a play that was measured less is left open"
    assert _lessened(None, settings) is None
