"""Apertures without a motor say what they know, and no more."""

from __future__ import annotations

import numpy as np
import pytest
from elpd_drivers.apertures import open_manual, open_none
from virtual import TestClock

from elpd.errors import ConfigError


def test_none_is_always_open() -> None:
    clock = TestClock()
    aperture = open_none({}, clock)
    assert aperture.open().begun_ns == clock.now_ns()
    assert aperture.close().done_ns == clock.now_ns()
    assert aperture.opening_ms == 0.0
    assert aperture.transmittance(np.array([-5.0, 0.0, 5.0])).tolist() == [1.0, 1.0, 1.0]


def test_a_hand_is_asked_and_the_time_of_asking_is_stamped() -> None:
    clock = TestClock()
    asked: list[str] = []

    def ask(words: str) -> None:
        asked.append(words)
        clock.pass_ms(700)

    aperture = open_manual({"ask": ask, "opening_ms": 100}, clock)
    begun = clock.now_ns()
    stamp = aperture.open()
    assert (stamp.begun_ns, stamp.done_ns - stamp.begun_ns) == (begun, 700_000_000)
    aperture.close()
    assert "open" in asked[0]
    assert "close" in asked[1]
    assert aperture.transmittance(np.array([-1.0, 0.0, 50_000.0, 100_000.0, 1e9])).tolist() == [0, 0, 0.25, 1, 1]


def test_without_a_callback_the_log_carries_the_request(capsys: pytest.CaptureFixture[str]) -> None:
    open_manual({}, TestClock()).open()
    assert "by hand" in "".join(capsys.readouterr())


def test_settings_are_checked() -> None:
    clock = TestClock()
    with pytest.raises(ConfigError, match="none for this aperture"):
        open_none({"opening_ms": 3}, clock)
    with pytest.raises(ConfigError, match=r"aperture\.opening: unknown key"):
        open_manual({"opening": 3}, clock)
    with pytest.raises(ConfigError, match="positive"):
        open_manual({"opening_ms": 0}, clock)
    with pytest.raises(ConfigError, match="function"):
        open_manual({"ask": "please"}, clock)
