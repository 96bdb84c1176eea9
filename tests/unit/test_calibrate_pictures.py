"""Calibrations of the aperture and of the play as pictures, and where there is nothing to draw or no place for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import pytest
from command_line import caller

from elpd.calibrate.aperture import ApertureCalibration
from elpd.calibrate.opening_plot import draw_opening
from elpd.calibrate.play import BacklashCalibration, Reading
from elpd.calibrate.play_plot import draw_play
from elpd.calibrate.profile import MeasuredOn
from elpd.calibrate.quantity import Quantity
from elpd.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

ON = MeasuredOn(part="lens", device="a lens", serial=None, settings={})
READINGS = tuple(
    Reading(speed_um_s=speed, focus_um=400.0 + (2.0 if speed > 0 else -2.0), sigma_um=0.1)
    for speed in (500.0, -500.0, 1000.0, -1000.0)
)


def ink(path: Path) -> float:
    return float((cv2.imread(str(path)) < 250).mean())


def play(readings: tuple[Reading, ...]) -> BacklashCalibration:
    found = Quantity.of(4.0, 0.1, "um") if readings else Quantity(value=None, sigma=None, unit="um", reason="no focus")
    lag = Quantity.of(50.0, 5.0, "us") if readings else found
    return BacklashCalibration(**BacklashCalibration.head(ON), backlash_um=found, lag_us=lag, readings=readings)


def test_an_opening_is_drawn(tmp_path: Path) -> None:
    found = ApertureCalibration(
        **ApertureCalibration.head(ON),
        delay_us=Quantity.of(3000.0, 50.0, "us"),
        opening_us=Quantity.of(20_000.0, 100.0, "us"),
        since_us=(0.0, 5000.0, 10_000.0, 20_000.0),
        transmittance=(0.0, 0.0625, 0.25, 1.0),
        sigma=(1.0, 0.2, 0.1, 0.01),
        scale_sigma=0.05,
        threshold=0.18,
        lag_corrected=False,
        openings=4,
        events=1000,
    )
    draw_opening(tmp_path / "opening.png", found)
    assert ink(tmp_path / "opening.png") > 0.02
    with pytest.raises(UsageError, match="cannot be written"):
        draw_opening(tmp_path / "nowhere" / "opening.png", found)


def test_play_is_drawn_and_so_is_why_there_is_none(tmp_path: Path) -> None:
    draw_play(tmp_path / "play.png", play(READINGS))
    draw_play(tmp_path / "none.png", play(()))
    assert ink(tmp_path / "play.png") > ink(tmp_path / "none.png") > 0.001


@pytest.mark.parametrize("what", ["aperture", "backlash"])
def test_a_picture_without_a_folder_is_refused_before_anything_moves(
    what: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    answer = caller(capsys, monkeypatch, tmp_path)("calibrate", what, "--plot", "nowhere/a.png", "--json")
    assert answer.code == 2
    assert "there is no folder" in answer.json["error"]["message"]
