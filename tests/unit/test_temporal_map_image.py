"""From first ON times to a picture: profiles, the opening found, mending, quality, files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from openings import Opening, natural_scene, record

from elpd.errors import FormatError, UsageError
from elpd.records import Geometry, TemporalImage
from elpd.units import SensorUs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.first_times import FirstTimes
from elpd.vision.latch import EMPTY
from elpd.vision.pictures import display, read_picture, write_log_png
from elpd.vision.temporal_map import (
    DB_PER_LOG,
    Transmittance,
    fill_holes,
    find_opening,
    iris,
    linear,
    quality,
    read_transmittance,
    smoothed,
    tabulated,
    temporal_image,
)

if TYPE_CHECKING:
    from pathlib import Path

SCENE = natural_scene(1)


def first_times(opening: Opening, begin_us: int | None = None) -> FirstTimes:
    height, width = opening.log_intensity.shape
    gathered = FirstEventMap(Geometry(width, height), begin_us)
    gathered.add(opening.t_us, opening.x, opening.y, opening.on)
    return gathered.believed()


def picture_of(opening: Opening, profile: Transmittance = iris) -> TemporalImage:
    return temporal_image(first_times(opening, opening.open_us), profile, SensorUs(opening.open_us))


def error_of(image: TemporalImage, scene: np.ndarray) -> tuple[float, float]:
    """Correlation with the truth, and rms error of log intensity, over valid pixels."""
    seen, truth = image.log_intensity[image.valid], scene[image.valid]
    residual = seen - truth
    return float(np.corrcoef(seen, truth)[0, 1]), float(np.std(residual))


@pytest.mark.parametrize(("profile", "exponent", "scene"), [(iris, 2, SCENE), (linear, 1, SCENE * 0.4)])
def test_a_clean_opening_gives_back_the_scene(profile: Transmittance, exponent: float, scene: np.ndarray) -> None:
    image = picture_of(record(scene, exponent=exponent), profile)
    correlation, error = error_of(image, scene)
    assert correlation > 0.9999
    assert error < 0.01
    assert image.valid.mean() > 0.99


@pytest.mark.parametrize(("noise_hz", "limit"), [(0.0, 0.055), (5.0, 0.07), (20.0, 0.12)])
def test_mismatch_and_noise_leave_an_error_near_the_mismatch(noise_hz: float, limit: float) -> None:
    hot = [(5, 9), (60, 60), (61, 60), (119, 159)]
    opening = record(SCENE, mismatch=0.05, noise_hz=noise_hz, hot=hot, lead_us=10_000, seed=7)
    image = picture_of(opening)
    correlation, error = error_of(image, SCENE)
    assert correlation > 0.99
    assert error < limit
    assert not any(image.valid[pixel] for pixel in hot)


def test_a_table_of_a_straight_line_is_the_linear_profile() -> None:
    opening = record(SCENE * 0.4, exponent=1, mismatch=0.05, seed=2)
    table = tabulated(np.array([0.0, 5_000.0, 30_000.0]), np.array([0.0, 0.1, 0.6]))
    one, other = picture_of(opening, linear), picture_of(opening, table)
    np.testing.assert_allclose(one.log_intensity, other.log_intensity, atol=1e-5)
    np.testing.assert_array_equal(one.valid, other.valid)


@given(st.lists(st.tuples(st.floats(0.1, 1e4), st.floats(0.0, 1.0)), min_size=2, max_size=8))
def test_any_opening_table_keeps_the_order_of_brightness(steps: list[tuple[float, float]]) -> None:
    t_us = np.cumsum([step[0] for step in steps])
    transmittance = np.cumsum([step[1] for step in steps]) + 1e-3
    passed = tabulated(t_us, transmittance)(np.linspace(0.0, t_us[-1] + 100, 400))
    assert (np.diff(passed) >= 0).all()


@pytest.mark.parametrize("lead_us", [3_000, 30_000])
@pytest.mark.parametrize(("profile", "exponent"), [(iris, 2), (linear, 1)])
def test_the_opening_is_found_behind_a_closed_aperture(profile: Transmittance, exponent: float, lead_us: int) -> None:
    scene = SCENE * 0.5 * exponent
    opening = record(scene, exponent=exponent, mismatch=0.05, noise_hz=1, lead_us=lead_us, seed=11)
    first = first_times(opening)
    assert find_opening(first) == pytest.approx(opening.open_us, abs=400)
    correlation, _ = error_of(temporal_image(first, profile), scene)
    assert correlation > 0.99


def test_the_opening_is_never_before_the_record() -> None:
    first = first_times(record(SCENE, mismatch=0.05))
    assert find_opening(first) == first.begin_us


def test_events_before_a_given_opening_are_noise() -> None:
    opening = record(SCENE, mismatch=0.02, lead_us=5_000)
    later = SensorUs(opening.open_us + 2_000)
    image = temporal_image(first_times(opening), iris, later)
    early = first_times(opening).times_us + opening.t_us[0] < later
    assert early.any()
    assert not image.valid[early].any()


def test_the_dark_is_filled_darkest_and_small_flaws_with_their_neighbours() -> None:
    dark = np.zeros(SCENE.shape, bool)
    dark[30:50, 40:80] = True
    dark[90, 100] = dark[5:8, 5:8] = True
    image = picture_of(record(SCENE, mismatch=0.03, dark=dark, seed=4))
    assert not image.valid[dark].any()
    assert image.filled_pixels >= dark.sum()
    valid = image.log_intensity[image.valid]
    np.testing.assert_allclose(image.log_intensity[32:48, 42:78], np.percentile(valid, 0.1), rtol=1e-5)
    around = np.delete(image.log_intensity[89:92, 99:102].ravel(), 4)
    assert around.min() <= image.log_intensity[90, 100] <= around.max()


@given(st.integers(0, 2**32 - 1))
def test_filling_leaves_valid_pixels_alone_and_invents_no_extremes(seed: int) -> None:
    random = np.random.default_rng(seed)
    log_intensity = random.normal(size=(20, 24)).astype(np.float32)
    valid = random.random((20, 24)) < random.uniform(0.05, 1.0)
    valid[0, 0] = True
    filled = np.where(valid, log_intensity, np.float32(99.0))
    fill_holes(filled, valid)
    np.testing.assert_array_equal(filled[valid], log_intensity[valid])
    assert log_intensity[valid].min() <= filled.min() <= filled.max() <= log_intensity[valid].max()


def test_dynamic_range_is_that_of_linear_intensity() -> None:
    image = picture_of(record(SCENE))
    low, high = np.percentile(np.exp(image.log_intensity[image.valid].astype(np.float64)), [0.1, 99.9])
    assert image.dynamic_range_db == pytest.approx(20 * np.log10(high / low), abs=0.05)
    assert pytest.approx(20 / np.log(10)) == DB_PER_LOG


def test_smoothing_takes_most_of_the_jitter_off_a_soft_scene() -> None:
    soft = cv2.GaussianBlur(SCENE, (0, 0), 5.0)
    image = picture_of(record(soft, mismatch=0.05, seed=5))
    _, before = error_of(image, soft)
    assert np.std((smoothed(image) - soft)[image.valid]) < 0.6 * before


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_quality_passes_a_scene_however_slow_or_dim(seed: int) -> None:
    scene = natural_scene(seed)
    for factor, duration_us in ((1.0, 20_000), (0.05, 20_000), (1.0, 200_000)):
        opening = record(scene * factor, mismatch=0.05, duration_us=duration_us, seed=seed)
        usable, reason = quality(picture_of(opening))
        assert usable, reason


@pytest.mark.parametrize("noise_hz", [1, 5, 20, 100, 1000])
@pytest.mark.parametrize("opening_given", [True, False])
def test_a_lens_cap_never_passes(noise_hz: float, opening_given: bool) -> None:  # noqa: FBT001
    opening = record(SCENE, dark=np.ones(SCENE.shape, bool), noise_hz=noise_hz, seed=int(noise_hz))
    try:
        image = temporal_image(first_times(opening), iris, SensorUs(opening.open_us) if opening_given else None)
    except UsageError as error:
        assert "noise" in str(error)  # noqa: PT017
        return
    usable, reason = quality(image)
    assert not usable
    assert "aperture" in reason


def test_a_flat_wall_has_no_structure() -> None:
    usable, reason = quality(picture_of(record(np.zeros((120, 160)), mismatch=0.05)))
    assert not usable
    assert "without any structure" in reason


def test_without_a_lit_pixel_there_is_no_picture() -> None:
    dark = FirstTimes(0, np.full((9, 9), EMPTY, np.int32), np.zeros((9, 9), bool), np.ones((9, 9), bool), 0.0, 0)
    with pytest.raises(UsageError, match="no opening found"):
        temporal_image(dark)
    with pytest.raises(UsageError, match="no pixel fired"):
        temporal_image(dark, iris, SensorUs(0))


# --- profiles from files ------------------------------------------------------------------------------------------


def test_a_profile_is_read_from_a_table(tmp_path: Path) -> None:
    table = tmp_path / "profile.csv"
    table.write_text("# measured with a grey card\nt_us, transmittance\n0,0\n1000,0.25\n2000,1\n")
    passed = read_transmittance(table)(np.array([-5.0, 500.0, 1500.0, 9000.0]))
    np.testing.assert_allclose(passed, [0.0, 0.125, 0.625, 1.0])
    assert read_transmittance("linear") is linear
    assert read_transmittance("iris") is iris


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "two or more rows"),
        ("0,0\n", "two or more rows"),
        ("0,0\n5,nan\n", "finite"),
        ("0,0\n5,0.5\n5,0.6\n", "row 3: time 5 us does not increase"),
        ("0,0\n5,0.5\n9,0.4\n", "row 3: an opening aperture passes more"),
        ("0,-1\n5,0.5\n", "row 1"),
        ("0,0\n5,0\n", "passes more"),
        ("a,b\n1,2\n", "row 1: expected"),
        ("0;0\n1;2\n", "row 1: expected"),
        ("0,0,0\n", "row 1: expected"),
    ],
)
def test_a_bad_table_is_refused_with_its_row(tmp_path: Path, text: str, message: str) -> None:
    table = tmp_path / "profile.csv"
    table.write_text(text)
    with pytest.raises(UsageError, match=message):
        read_transmittance(table)


def test_an_unknown_profile_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="linear, iris or a CSV"):
        read_transmittance("irs")
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    with pytest.raises(FormatError, match="cannot be read"):
        read_transmittance(tmp_path / "binary")
    with pytest.raises(FormatError, match="cannot be read"):
        read_transmittance(tmp_path)


# --- pictures in files ---------------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.floats(1e-6, 1e3), st.floats(-1e3, 1e3))
def test_the_png_is_monotone_and_gives_the_log_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, scale: float, offset: float
) -> None:
    log_intensity = (np.random.default_rng(seed).normal(size=(9, 11)) * scale + offset).astype(np.float32)
    path = tmp_path_factory.mktemp("png") / "picture.png"
    write_log_png(path, log_intensity)
    grey: Any = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert grey.dtype == np.uint16
    order = np.argsort(log_intensity, axis=None, kind="stable")
    assert (np.diff(grey.ravel()[order].astype(int)) >= 0).all()
    picture = read_picture(path)
    assert picture.is_log
    span = float(np.ptp(log_intensity))
    np.testing.assert_allclose(
        picture.pixels, log_intensity, atol=0.51 * span / 65535 + 1e-6 * (abs(offset) + 5 * scale)
    )


def test_a_constant_picture_can_be_written(tmp_path: Path) -> None:
    write_log_png(tmp_path / "flat.png", np.full((4, 5), 1.5, np.float32))
    np.testing.assert_allclose(read_picture(tmp_path / "flat.png").pixels, 1.5)


def test_other_pictures_are_grey(tmp_path: Path) -> None:
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    picture = read_picture(tmp_path / "grey.png")
    assert not picture.is_log
    np.testing.assert_array_equal(picture.pixels, grey)


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "empty.png").write_bytes(b"")
    for name in ("text.png", "empty.png"):
        with pytest.raises(FormatError, match="not a picture"):
            read_picture(tmp_path / name)
    with pytest.raises(UsageError, match="cannot be read"):
        read_picture(tmp_path / "absent.png")
    with pytest.raises(UsageError, match="choose another --out"):
        write_log_png(tmp_path / "absent" / "x.png", np.zeros((2, 2), np.float32))


def test_the_display_spans_the_valid_percentiles() -> None:
    log_intensity = np.linspace(0, 1, 10_000, dtype=np.float32).reshape(100, 100)
    log_intensity[0, 0] = 50.0
    valid = np.ones((100, 100), bool)
    valid[0, 0] = False
    grey = display(log_intensity, valid)
    assert grey[0, 0] == 255
    assert abs(int(grey[50, 0]) - 128) <= 2
