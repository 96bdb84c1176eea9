"""The rebuilt image against its twin, the vertex, and how witnesses are fused."""

from typing import Any

import naive_vision
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.vision.crossing import Witness, frame_witness, fuse, without_lag
from elpd.vision.integral import (
    BANDS_PX,
    Vertex,
    band_energy,
    band_gain,
    fit_vertex,
    group_by_pixel,
    rebuild_levels,
    stamp_events,
)
from elpd.vision.pairs import weighted_mode
from elpd.vision.track import EventEnergy, PeakTrack


@given(st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.floats(0.001, 1.0)), min_size=1, max_size=40))
def test_rebuilt_levels_are_their_twin(rows: Any) -> None:
    pixel = np.array([row[0] for row in rows], np.int64)
    on = np.array([row[1] for row in rows], np.uint8)
    position = np.cumsum([row[2] for row in rows])
    ticks = np.linspace(-0.1, position[-1] + 0.5, 17)
    starts, order = group_by_pixel(pixel, 3)
    level = np.zeros((17, 3), np.float32)
    squares = np.zeros((17, 2))
    rebuild_levels(starts, position[order], on[order], ticks, level, squares)
    for k in range(3):
        events = [(float(z), bool(p)) for z, p, one in zip(position, on, pixel, strict=True) if one == k]
        expected = [naive_vision.level_at(events, tick) if events else 0.0 for tick in ticks]
        np.testing.assert_allclose(level[:, k], expected, rtol=1e-5, atol=1e-5)
    counted = [
        [sum(((pixel == k) & (on == p) & (position <= tick)).sum() ** 2 for k in range(3)) for p in (1, 0)]
        for tick in ticks
    ]
    np.testing.assert_array_equal(squares, counted)


@given(st.lists(st.integers(0, 6), max_size=60))
def test_events_are_grouped_by_pixel_in_their_order(pixels: Any) -> None:
    starts, order = group_by_pixel(np.array(pixels, np.int64), 7)
    for k in range(7):
        assert order[starts[k] : starts[k + 1]].tolist() == [i for i, pixel in enumerate(pixels) if pixel == k]


@given(st.lists(st.tuples(st.integers(0, 22), st.integers(0, 18), st.booleans()), max_size=60))
def test_stamped_events_are_their_twin(rows: Any) -> None:
    x, y = (np.array([row[k] for row in rows], np.uint16) for k in (0, 1))
    on = np.array([row[2] for row in rows], np.uint8)
    stamp = np.arange(1.0, 26.0, dtype=np.float32).reshape(5, 5)
    band = np.zeros((19, 23), np.float32)
    stamp_events(x, y, on, stamp, band)
    np.testing.assert_array_equal(band, naive_vision.stamp_events(rows, stamp.tolist(), 19, 23))


def test_the_sharpness_that_events_keep_up_to_date_is_that_of_their_image() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.integers(0, 60, 2000).astype(np.uint16), rng.integers(0, 50, 2000).astype(np.uint16)
    on = rng.integers(0, 2, 2000).astype(np.uint8)
    energy = EventEnergy(50, 60, 14)
    energy.add(x[:700], y[:700], on[:700])
    energy.add(x[700:], y[700:], on[700:])
    image = np.zeros((50, 60), np.float32)
    np.add.at(image, (y, x), 2.0 * on - 1.0)
    expected = band_energy(image, BANDS_PX[0], np.ones_like(image), 14)
    assert energy.measure() == pytest.approx(np.log(expected), abs=1e-4)


def test_a_band_passes_white_noise_as_its_gain_says() -> None:
    noise = np.random.default_rng(4).standard_normal((400, 400)).astype(np.float32)
    for scale_px in BANDS_PX:
        assert band_energy(noise, scale_px, np.ones_like(noise), 14) == pytest.approx(band_gain(scale_px), rel=0.02)


def test_the_vertex_is_exact_on_a_parabola_however_lopsided_the_record() -> None:
    z = np.linspace(-10.0, 4.0, 57)
    vertex = fit_vertex(z, -((z - 1.0) ** 2) / 18.0, 100.0)
    assert vertex.at == pytest.approx(1.0)
    assert vertex.width == pytest.approx(3.0)
    assert vertex.sigma == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("curve", [np.linspace(0, 1, 9), np.linspace(1, 0, 9), np.linspace(-1, 1, 9) ** 2])
def test_no_vertex_without_a_peak_inside(curve: Any) -> None:
    assert fit_vertex(np.arange(9.0), curve, 100.0) is None


def test_the_vertex_knows_its_error() -> None:
    rng = np.random.default_rng(5)
    z = np.linspace(-5.0, 5.0, 41)
    pulls = []
    for _ in range(200):
        vertex = fit_vertex(z, -(z**2) / 18.0 + 0.02 * rng.standard_normal(z.size), 100.0)
        pulls.append(vertex.at / vertex.sigma)
    assert 0.7 < np.std(pulls) < 1.3


def test_witnesses_are_weighed_by_their_errors() -> None:
    estimate = fuse([Witness("frames", 10.0, 1.0), Witness("pairs", 13.0, 2.0)])
    assert estimate.focus_um == pytest.approx(10.6)
    assert [one[3] for one in estimate.contributions] == pytest.approx([0.8, 0.2])
    assert estimate.method == "crossing"
    assert fuse([Witness("vertex", 0.0, 3.0), Witness("pairs", 1.0, 1.0)]).method == "pairs"
    assert fuse([]) is None


def test_disagreement_widens_the_error() -> None:
    agree = fuse([Witness("frames", 10.0, 1.0), Witness("pairs", 10.5, 1.0)])
    differ = fuse([Witness("frames", 10.0, 1.0), Witness("pairs", 30.0, 1.0)])
    assert agree.sigma_um == pytest.approx(0.5**0.5)
    assert differ.sigma_um > 9.0


def test_an_error_that_is_shared_does_not_average_out() -> None:
    many = [Witness(name, 0.0, 0.1, shared=3.0) for name in ("vertex", "pairs")]
    assert fuse(many).sigma_um == pytest.approx(3.0, rel=0.01)


def test_frames_far_apart_are_trusted_less() -> None:
    vertex = Vertex(0.0, 0.0, 80.0, 5)
    assert frame_witness(vertex, 80.0).sigma > 3.0 * frame_witness(vertex, 16.0).sigma


def test_the_lag_of_dark_pixels_is_taken_off() -> None:
    rng = np.random.default_rng(11)
    slowness = rng.uniform(1.0, 20.0, 2000)
    middle = 50.0 + 0.3 * slowness + rng.normal(0.0, 1.0, slowness.size)
    mode = weighted_mode(middle, np.ones(middle.size), 2.0)
    assert mode.at > 51.0
    corrected, lag = without_lag(middle, np.ones(middle.size), slowness, mode, 2.0)
    assert corrected.at == pytest.approx(50.0, abs=4.0 * corrected.sigma)
    assert lag.at == pytest.approx(0.3, abs=0.05)
    assert lag.sigma < 0.02


def test_without_a_lag_nothing_is_taken_off() -> None:
    rng = np.random.default_rng(12)
    slowness = rng.uniform(1.0, 20.0, 500)
    middle = 50.0 - 0.02 * slowness + rng.normal(0.0, 1.0, slowness.size)
    mode = weighted_mode(middle, np.ones(middle.size), 2.0)
    corrected, lag = without_lag(middle, np.ones(middle.size), slowness, mode, 2.0)
    assert lag.at == pytest.approx(0.0, abs=0.01)
    assert corrected.at == pytest.approx(49.8, abs=0.3)


def drawn(values: Any) -> Any:
    track = PeakTrack()
    for k, value in enumerate(values):
        track.add(1000 * k, float(k), float(value))
    return track


def test_a_peak_is_passed_when_the_curve_has_risen_and_fallen() -> None:
    z = np.arange(60.0)
    curve = -((z - 40.0) ** 2) / 200.0
    assert not drawn(curve[:41]).passed
    assert not drawn(curve[:44]).passed
    track = drawn(curve[:55])
    assert track.passed
    assert track.vertex().at == pytest.approx(40.0)


def test_a_curve_that_only_falls_or_only_rises_has_not_peaked() -> None:
    z = np.arange(60.0)
    assert not drawn(-0.05 * z).passed
    assert not drawn(0.05 * z).passed


def test_a_falling_position_gives_the_same_vertex() -> None:
    track = PeakTrack()
    for k in range(60):
        track.add(1000 * k, 100.0 - k, -((k - 40.0) ** 2) / 200.0)
    assert track.vertex().at == pytest.approx(60.0)
