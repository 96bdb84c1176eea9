"""The rebuilt image against its twin, the vertex, and how witnesses are fused."""

from dataclasses import replace
from typing import Any

import cv2
import naive_vision
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.vision.bands import BandFocus, average_focus, band_energies, focus_of_bands
from elpd.vision.drift import find_drift
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
from elpd.vision.track import EventEnergy, PeakTrack, Sharpness
from elpd.vision.witness import Witness, frame_witness, fuse


@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.booleans(), st.floats(0.001, 1.0), st.floats(1.0, 3.0)), min_size=1, max_size=40
    )
)
def test_rebuilt_levels_are_their_twin(rows: Any) -> None:
    pixel = np.array([row[0] for row in rows], np.int64)
    on = np.array([row[1] for row in rows], np.uint8)
    steps = (2.0 * on - 1.0) * np.array([row[3] for row in rows])
    position = np.cumsum([row[2] for row in rows])
    ticks = np.linspace(-0.1, position[-1] + 0.5, 17)
    starts, order = group_by_pixel(pixel, 3)
    level = np.zeros((17, 3), np.float32)
    rebuild_levels(starts, position[order], steps[order], ticks, level)
    for k in range(3):
        events = [(float(z), float(p)) for z, p, one in zip(position, steps, pixel, strict=True) if one == k]
        expected = [naive_vision.level_at(events, tick) if events else 0.0 for tick in ticks]
        np.testing.assert_allclose(level[:, k], expected, rtol=1e-5, atol=1e-5)


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
    energy.measure()
    assert energy.raw == pytest.approx(expected, rel=1e-4)
    upon = EventEnergy(50, 60, 14, image)
    assert energy.measure() == pytest.approx(upon.measure(), abs=1e-3)


@pytest.mark.parametrize("noise", [0, 1, 4])
def test_what_noise_adds_to_the_sharpness_is_taken_off(noise: int) -> None:
    rng = np.random.default_rng(5)
    side = 240
    scene = cv2.GaussianBlur(rng.standard_normal((side, side)).astype(np.float32), (0, 0), 1.5)
    energy = EventEnergy(side, side, 14, 8.0 * scene)
    quiet = energy.measure()
    x, y = (rng.integers(0, side, noise * side**2).astype(np.uint16) for _ in range(2))
    energy.add(x, y, rng.integers(0, 2, x.size).astype(np.uint8))
    assert energy.measure() == pytest.approx(quiet, abs=0.1)
    assert (energy.raw > 1.5 * np.exp(quiet)) == (noise > 0)


def test_a_sensor_that_sees_nothing_shows_no_rise_and_fall_of_sharpness() -> None:
    rng = np.random.default_rng(6)
    side, track = 120, PeakTrack()
    energy = EventEnergy(side, side, 14)
    for tick in range(120):
        x, y = (rng.integers(0, side, 400).astype(np.uint16) for _ in range(2))
        energy.add(x, y, rng.integers(0, 2, x.size).astype(np.uint8))
        track.add(tick, float(tick), energy.measure())
        assert not track.passed


def test_what_whole_lamp_periods_leave_behind_is_not_taken_for_white_noise() -> None:
    rng = np.random.default_rng(6)
    x, y = (rng.integers(0, 120, 4000).astype(np.uint16) for _ in range(2))
    on = rng.integers(0, 2, x.size).astype(np.uint8)
    freed, whole = EventEnergy(120, 120, 14), EventEnergy(120, 120, 14)
    whole.white = False
    for energy in (freed, whole):
        energy.add(x, y, on)
    assert whole.measure() == pytest.approx(np.log(whole.raw), abs=1e-6)
    assert freed.measure() < whole.measure() - 1.0


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


def test_there_and_back_what_is_late_cancels_and_only_the_play_is_left() -> None:
    late, play = 7.0, 4.0
    there = Witness("vertex", 50.0 + late, 1.0, shared=12.0, held=2.0)
    back = Witness("vertex", -(50.0 - play) + late, 1.0, shared=12.0, held=2.0)
    assert fuse([there]).sigma_um > 12.0
    both = fuse([there, back.on_the_way_back(play, 1.0)])
    assert both.focus_um == pytest.approx(50.0, abs=0.05)
    assert both.sigma_um == pytest.approx(np.hypot(np.sqrt(0.5), 0.5), rel=0.05)
    unknown = fuse([there, back.on_the_way_back(play, 8.0)])
    assert unknown.sigma_um > 3.5, "a play that nobody measured is half an error of the answer"


def test_images_of_a_scene_that_moved_lie_beside_each_other() -> None:
    rng = np.random.default_rng(9)
    for side in (100, 132, 135):  # transforms of even and of odd length
        scene = cv2.GaussianBlur(rng.standard_normal((side + 8, side + 8)).astype(np.float32), (0, 0), 2.0)
        still = np.stack([scene[4 : 4 + side, 4 : 4 + side] * gain for gain in (0.5, 0.8, 1.0, 0.9, 0.7)])
        moved = np.stack([scene[4 : 4 + side, 4 - k : 4 - k + side] for k in (0, 1, 2, 3, 2)])
        assert not find_drift(still).seen
        found = find_drift(moved)
        assert found.seen
        assert found.px == pytest.approx(3.0, abs=0.2)
        middle = (0.5 * scene.shape[1], 0.5 * scene.shape[0])
        turns = [cv2.getRotationMatrix2D(middle, 0.0, gain) for gain in (1.0, 1.01, 1.02)]
        grown = np.stack([cv2.warpAffine(scene, one, scene.shape[::-1], flags=cv2.INTER_CUBIC) for one in turns])
        assert not find_drift(grown).seen, "what grows moves edges, and not the scene"
        assert found.isotropy > 0.8
        assert find_drift(np.repeat(moved[:, :1], side, axis=1)).isotropy < 0.01, "bars have edges of one direction"


def test_frames_far_apart_are_trusted_less() -> None:
    focus = BandFocus(0.0, 0.5, Vertex(0.0, 0.5, 80.0, 5), 0.0, 0.1)
    assert frame_witness(focus, 80.0).sigma > 3.0 * frame_witness(focus, 16.0).sigma
    directed = replace(focus, directed=focus.sigma)
    assert frame_witness(directed, 80.0).sigma == pytest.approx(focus.sigma), "few frames do not turn a lens's edges"


def test_white_noise_has_no_energy_in_any_band() -> None:
    rng = np.random.default_rng(2)
    weight = np.ones((128, 128), np.float32)
    noise = rng.standard_normal((128, 128)).astype(np.float32)
    waves = np.cos(2.0 * np.pi * np.arange(128) / 8.0).astype(np.float32)[None, :] * weight
    alone, with_noise = (band_energies(one.astype(np.float32), weight) for one in (waves, waves + noise))
    np.testing.assert_allclose(with_noise, alone, atol=0.02)
    assert (band_energies(noise, weight) < 0.01).all()


def bands(departure: float, coarse: float = 0.0) -> Any:
    """Log S of a lens whose finest band is best *departure* beyond focus, at 2, and coarser bands in proportion."""
    z = np.linspace(-60.0, 60.0, 61)
    curves = [
        -((z - 2.0 - departure * (BANDS_PX[0] / scale) ** 2 - (coarse if scale > 2.0 else 0.0)) ** 2)
        / (2.0 * (80.0 * (1.0 + 0.2 * k)) ** 2)
        for k, scale in enumerate(BANDS_PX)
    ]
    return z, np.stack(curves, axis=1)


def test_focus_is_where_the_coarsest_bands_would_be_sharpest() -> None:
    found = focus_of_bands(*bands(0.0), 50.0)
    assert found.at == pytest.approx(2.0, abs=0.05)
    found = focus_of_bands(*bands(-5.0), 50.0)
    assert found.finest.at == pytest.approx(-3.0, abs=0.05)
    assert found.at == pytest.approx(2.0, abs=1.5)
    assert abs(found.at - 2.0) < 2.0 * found.sigma


def test_a_coarse_band_without_structure_is_not_asked() -> None:
    found = focus_of_bands(*bands(0.0, coarse=40.0), 50.0)
    assert found.at == pytest.approx(2.0, abs=0.3)


def test_candidates_are_averaged_by_how_well_they_are_parabolas() -> None:
    vertex = Vertex(0.0, 0.5, 80.0, 5)
    good, poor = BandFocus(1.0, 0.5, vertex, 0.0, 0.1), BandFocus(9.0, 0.5, vertex, 0.0, 0.3)
    assert average_focus([good, poor]).at == pytest.approx(1.0, abs=0.01)
    split = average_focus([good, BandFocus(3.0, 0.5, vertex, 0.0, 0.1)])
    assert split.at == pytest.approx(2.0)
    assert split.sigma > 1.0


def drawn(values: Any) -> Any:
    track = PeakTrack()
    for k, value in enumerate(values):
        track.add_sharpness(1000 * k, float(k), Sharpness(np.full(len(BANDS_PX), float(value))))
    return track


def test_a_peak_is_passed_when_the_curve_has_risen_and_fallen() -> None:
    z = np.arange(60.0)
    curve = -((z - 40.0) ** 2) / 200.0
    assert not drawn(curve[:41]).passed
    assert not drawn(curve[:44]).passed
    track = drawn(curve[:55])
    assert track.passed
    assert track.focus().at == pytest.approx(40.0)


def test_a_curve_that_only_falls_or_only_rises_has_not_peaked() -> None:
    z = np.arange(60.0)
    assert not drawn(-0.05 * z).passed
    assert not drawn(0.05 * z).passed


def test_a_falling_position_gives_the_same_vertex() -> None:
    track = PeakTrack()
    for k in range(60):
        track.add_sharpness(1000 * k, 100.0 - k, Sharpness(np.full(len(BANDS_PX), -((k - 40.0) ** 2) / 200.0)))
    assert track.focus().at == pytest.approx(60.0)


def test_what_the_lens_makes_is_told_apart_from_what_more_passes_would_lessen() -> None:
    pairs = Witness("pairs", 10.0, 0.3, 0.0, optics=0.4)
    frames = Witness("frames", 10.0, 0.5, 0.0)
    alone, both = fuse([pairs]), fuse([pairs, frames])
    assert alone is not None
    assert both is not None
    assert (alone.sigma_um, alone.lasting_um) == (pytest.approx(0.5), pytest.approx(0.4))
    assert both.lasting_um == pytest.approx(0.2)  # as good as each other, so half of it
