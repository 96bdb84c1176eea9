"""``elpd temporal-map`` as people and programs call it, and on the real aperture opening."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from openings import Opening, natural_scene, record
from shared import RECORDINGS, SHARED, needs_shared

from elpd.cli import main
from elpd.events.evt3_encode import Evt3Encoder
from elpd.events.stream import EventStream, open_recording
from elpd.records import Geometry
from elpd.units import SensorUs
from elpd.vision.choose import propose_roi
from elpd.vision.first_events import FirstEventMap
from elpd.vision.pictures import read_picture
from elpd.vision.temporal_map import linear, quality, temporal_image

if TYPE_CHECKING:
    from pathlib import Path

FIELDS = {"width", "height", "fired_fraction", "open_us", "hot_pixels", "filled_pixels", "dynamic_range_db", "out"}
SCENE = natural_scene(1)


@pytest.fixture
def opening() -> Opening:
    return record(SCENE, mismatch=0.05, lead_us=20_000, noise_hz=1, seed=1)


@pytest.fixture
def raw(tmp_path: Path, opening: Opening) -> Path:
    path = tmp_path / "opening.raw"
    words = Evt3Encoder(160).encode(opening.t_us, opening.x, opening.y, opening.on)
    path.write_bytes(b"% evt 3.0\n% format EVT3;height=120;width=160\n% geometry 160x120\n% end\n" + words.tobytes())
    return path


def elpd(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object
) -> tuple[int, str, str]:
    """Run the command line in this process; return its exit code, stdout and stderr."""
    monkeypatch.setattr("sys.argv", ["elpd", "temporal-map", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    captured = capsys.readouterr()
    return int(ended.value.code or 0), captured.out, captured.err


def test_json_holds_every_field_and_the_png_is_16_bit(
    raw: Path, opening: Opening, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "map.png"
    interval = f"{opening.open_us},{opening.open_us + 20_000}"
    code, text, _ = elpd(monkeypatch, capsys, raw, "--aperture-us", interval, "--out", out, "--json")
    answer: dict[str, Any] = json.loads(text)
    assert code == 0
    assert set(answer) >= FIELDS
    assert (answer["width"], answer["height"]) == (160, 120)
    assert answer["open_us"] == opening.open_us
    assert answer["out"] == str(out)
    assert answer["usable"]
    grey: Any = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert grey.dtype == np.uint16
    assert np.corrcoef(grey.ravel(), SCENE.ravel())[0, 1] > 0.99


def test_people_get_lines_and_a_picture_for_eyes(
    raw: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, text, _ = elpd(monkeypatch, capsys, raw, "--display", tmp_path / "eyes.png")
    assert code == 0
    assert "160 x 120" in text
    assert "dB" in text
    eyes: Any = cv2.imread(str(tmp_path / "eyes.png"), cv2.IMREAD_UNCHANGED)
    assert eyes.dtype == np.uint8


def test_a_profile_changes_contrast_and_no_order(
    raw: Path, opening: Opening, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    interval = ("--aperture-us", f"{opening.open_us},{opening.open_us + 20_000}")
    ranges = {}
    for profile in ("linear", "iris"):
        _, text, _ = elpd(monkeypatch, capsys, raw, *interval, "--transmittance", profile, "--json")
        ranges[profile] = json.loads(text)["dynamic_range_db"]
    assert ranges["iris"] == pytest.approx(2 * ranges["linear"], rel=1e-3)


def test_a_capped_lens_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = record(SCENE, dark=np.ones(SCENE.shape, bool), noise_hz=100, seed=1)
    path = tmp_path / "capped.npz"
    np.savez(path, t=noise.t_us, x=noise.x, y=noise.y, p=noise.on)
    code, text, _ = elpd(monkeypatch, capsys, path, "--size", "160,120", "--json")
    answer = json.loads(text)
    assert code == 1
    assert not answer["usable"]
    assert "lens capped" in answer["verdict"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--aperture-us", "1,2"], "the recording's events are from 50"),
        (["--aperture-us", "99000000,99000002"], "choose --aperture-us A,B there"),
        (["--aperture-us", "7,3"], "must end after it begins"),
        (["--aperture-us", "seven"], "whole microseconds"),
        (["--transmittance", "round"], "linear, iris or a CSV"),
        (["--size", "160"], "--size is W,H"),
        (["--size", "0,9"], "1 to 2048"),
        (["--out", "/no/such/folder/map.png"], "cannot be written"),
    ],
)
def test_bad_requests_are_refused_clearly(
    raw: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    code, text, complaint = elpd(monkeypatch, capsys, raw, *arguments)
    assert code == 2
    assert text == ""
    assert message in complaint
    assert "Traceback" not in complaint


def test_files_that_cannot_be_mapped_are_refused_clearly(
    tmp_path: Path, raw: Path, opening: Opening, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.raw").write_text("dear diary\n")
    (tmp_path / "header_only.raw").write_bytes(raw.read_bytes().split(b"% end\n")[0] + b"% end\n")
    np.savez(tmp_path / "sizeless.npz", t=opening.t_us, x=opening.x, y=opening.y, p=opening.on)
    for name, message in (
        ("text.raw", "no format"),
        ("header_only.raw", "no event"),
        ("sizeless.npz", "give --size W,H"),
        ("absent.raw", "No such file"),
    ):
        code, text, complaint = elpd(monkeypatch, capsys, tmp_path / name, "--json")
        assert code == 2
        assert json.loads(text)["error"]["kind"] == "FormatError"
        assert message in complaint
        assert "Traceback" not in complaint


# --- real recordings, and a third party's simulation -----------------------------------------------------------------


@needs_shared
def test_the_real_opening_of_an_evk4(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "map.png"
    recording = RECORDINGS / "evk4_aperture_opening.raw"
    code, text, _ = elpd(monkeypatch, capsys, recording, "--out", out, "--json")
    answer = json.loads(text)
    assert code == 0
    assert (answer["width"], answer["height"]) == (1280, 720)
    assert answer["fired_fraction"] == pytest.approx(0.99976, abs=1e-5)
    assert 10_694_945 <= answer["open_us"] <= 10_694_945 + 2_000
    assert answer["hot_pixels"] < 0.005 * 1280 * 720
    assert answer["filled_pixels"] < 0.001 * 1280 * 720
    assert 55 < answer["dynamic_range_db"] < 75
    assert answer["usable"]
    grey: Any = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert grey.dtype == np.uint16
    assert np.unique(grey).size > 20_000

    reader = open_recording(recording)
    gathered = FirstEventMap(Geometry(1280, 720))
    for chunk in EventStream(reader).chunks(100_000):
        gathered.add(chunk.t, chunk.x, chunk.y, chunk.p)
    reader.close()
    image = temporal_image(gathered.believed())
    assert image.dynamic_range_db == answer["dynamic_range_db"]
    order = np.argsort(image.log_intensity, axis=None, kind="stable")
    assert (np.diff(grey.ravel()[order].astype(int)) >= 0).all()
    # The bright tablet's text and the dark test chart both carry texture; the upper one fires within 3 ms of its page.
    page, letters = image.log_intensity[290:300, 470:800], image.log_intensity[310:338, 545:735]
    assert np.median(page) - np.percentile(letters, 5) > 0.15
    roi = propose_roi(image.log_intensity, image.valid, (300, 150))
    assert roi is not None
    assert 400 < roi.x < 600
    assert 200 < roi.y < 400


@needs_shared
def test_a_simulated_opening_of_somebody_else() -> None:
    folder = SHARED / "sweeps" / "g1_evtemmap_camera"
    events = np.load(folder / "event.npy")
    truth = np.log(np.load(folder / "aperture.npz")["defocused"].astype(np.float64) + 0.5)
    gathered = FirstEventMap(Geometry(200, 200), 0, 20_000)
    gathered.add(events["t"], events["x"], events["y"], events["p"])
    image = temporal_image(gathered.believed(), linear, SensorUs(0))
    assert quality(image)[0]
    assert np.corrcoef(image.log_intensity[image.valid], truth[image.valid])[0, 1] > 0.97


def test_a_stored_map_reads_back_as_log(
    raw: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    elpd(monkeypatch, capsys, raw, "--out", tmp_path / "map.png")
    picture = read_picture(tmp_path / "map.png")
    assert picture.is_log
    assert np.corrcoef(picture.pixels.ravel(), SCENE.ravel())[0, 1] > 0.99
