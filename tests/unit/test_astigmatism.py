"""Edges of each direction have their own focus behind an astigmatic lens; their mean over all directions has one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from elpd.vision.astigmatism import WEDGES, Astigmatism, Edges, directions, edges_of, find_astigmatism
from elpd.vision.bands import band_energies, focus_of_bands
from elpd.vision.integral import BANDS_PX, band_gain
from elpd.vision.track import Sharpness

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIDE = 128
WIDTH_UM = 60.0
PLACES_UM = np.linspace(-45.0, 45.0, 19)
ONES = np.ones((SIDE, SIDE), np.float32)
NOTHING = np.zeros((len(BANDS_PX), WEDGES))


def textured(seed: int, stretch: float) -> NDArray[np.float32]:
    """Noise whose edges lie mostly along x where *stretch* is above one: its spectrum falls off sooner that way."""
    noise = np.random.default_rng(seed).standard_normal((SIDE, SIDE)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), sigmaX=0.8 * stretch, sigmaY=0.8).astype(np.float32)


def behind(picture: NDArray[np.float32], z_um: float, astigmatism_um: float, turned_deg: float = 0.0) -> Any:
    """Blur a picture as a lens does whose waves along x are best at +a, those along y at -a; or with axes turned."""
    down, right = np.meshgrid(2 * np.pi * np.fft.fftfreq(SIDE), 2 * np.pi * np.fft.rfftfreq(SIDE), indexing="ij")
    turn = np.deg2rad(turned_deg)
    along, across = right * np.cos(turn) + down * np.sin(turn), down * np.cos(turn) - right * np.sin(turn)
    # The finest band's curve has the width that was asked for where sigma is some two pixels at that distance.
    gain = 1.6 / WIDTH_UM
    exponent = np.square(gain * (z_um - astigmatism_um) * along) + np.square(gain * (z_um + astigmatism_um) * across)
    return np.fft.irfft2(np.fft.rfft2(picture) * np.exp(-0.5 * exponent), s=picture.shape).astype(np.float32)


def seen(picture: NDArray[np.float32], astigmatism_um: float, turned_deg: float = 0.0) -> list[Sharpness]:
    images = [behind(picture, z_um, astigmatism_um, turned_deg) for z_um in PLACES_UM]
    return [Sharpness(np.log(band_energies(one, ONES) + 1e-12), edges_of(one, ONES)) for one in images]


def focus(frames: list[Sharpness], *, asked: bool) -> Any:
    edges = [one.edges for one in frames if one.edges is not None]
    bands = np.array([one.bands for one in frames])
    return focus_of_bands(PLACES_UM, bands, 40.0, edges=edges if asked else None)


@pytest.mark.parametrize("astigmatism_um", [-12.0, 0.0, 6.0])
def test_focus_is_the_mean_over_all_directions_whatever_edges_a_picture_has(astigmatism_um: float) -> None:
    frames = seen(textured(1, 2.0), astigmatism_um)
    plain, freed = focus(frames, asked=False), focus(frames, asked=True)
    assert abs(plain.at) > 0.25 * abs(astigmatism_um), "edges of one direction draw the answer to their own focus"
    assert abs(freed.at) < 0.1 * abs(astigmatism_um) + 0.05
    assert abs(freed.at) < 2.0 * freed.sigma
    assert freed.astigmatism.at == pytest.approx([astigmatism_um, 0.0], abs=0.12 * abs(astigmatism_um) + 0.1)


def test_axes_may_lie_anyhow() -> None:
    found = focus(seen(textured(2, 1.0), 8.0, turned_deg=30.0), asked=True).astigmatism
    expected = 8.0 * np.array([np.cos(np.pi / 3.0), np.sin(np.pi / 3.0)])
    np.testing.assert_allclose(found.at, expected, atol=1.0)


def test_one_direction_alone_tells_nothing_and_its_error_says_so() -> None:
    bars = np.repeat(np.random.default_rng(3).standard_normal((1, SIDE)).astype(np.float32), SIDE, axis=0)
    frames = seen(cv2.GaussianBlur(bars, (0, 0), 0.8), 2.0)
    plain, freed = focus(frames, asked=False), focus(frames, asked=True)
    assert plain.at == pytest.approx(2.0, abs=0.2)
    assert abs(freed.at - 2.0) < 0.2, "nothing is taken off that was not seen"
    assert freed.sigma > 0.8 * 0.05 * freed.finest.width
    assert abs(freed.at) < 3.0 * freed.sigma


def test_wedges_of_noise_have_no_say() -> None:
    """Of bars, three wedges hold what pixels hold back and nothing else, and that has a peak somewhere too."""
    places_um = np.arange(-20.0, 21.0, 2.0)
    directions_of_wedges = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    towards = np.broadcast_to(directions_of_wedges, (*NOTHING.shape, 2))

    def found(noise: float) -> Astigmatism:
        sharpest_um = np.array([0.0, -12.0, -12.0, -12.0])  # by wedge
        share = np.array([100.0, 1.0, 1.0, 1.0])
        edges = [
            Edges(
                np.broadcast_to(share * np.exp(-0.5 * np.square((z_um - sharpest_um) / 40.0)), NOTHING.shape),
                towards,
                NOTHING + noise * np.array([0.0, 1.0, 1.0, 1.0]),
            )
            for z_um in places_um
        ]
        return find_astigmatism(places_um, edges, 15.0, 40.0)

    along = np.array([1.0, 0.0])
    assert found(0.0).shift(along)[0] > 4.0, "edges that are there are believed"
    shift, sigma = found(5.0).shift(along)
    assert abs(shift) < 1.0
    assert sigma > 1.5


def test_wedges_share_out_what_a_band_has_and_white_noise_has_none() -> None:
    picture = textured(4, 1.5)
    noise = np.random.default_rng(5).standard_normal(picture.shape).astype(np.float32)
    alone, with_noise = edges_of(picture, ONES), edges_of(picture + np.float32(0.2) * noise, ONES)
    whole = band_energies(picture, ONES) * SIDE**4  # the spectrum's sums are not divided by their number, twice
    np.testing.assert_allclose(alone.energy.sum(axis=1), whole, rtol=0.35)
    np.testing.assert_allclose(with_noise.energy, alone.energy, rtol=0.25)
    unfreed = np.array([band_gain(scale_px) for scale_px in BANDS_PX]) * SIDE**4
    assert (edges_of(noise, ONES).energy.sum(axis=1) < 0.05 * unfreed).all()


@pytest.mark.parametrize("degrees", [0.0, 45.0, 90.0, 135.0])
def test_a_wave_lies_in_its_own_wedge(degrees: float) -> None:
    y, x = np.mgrid[:SIDE, :SIDE]
    turn = np.deg2rad(degrees)
    wave = np.cos(2.0 * np.pi * 0.15 * (x * np.cos(turn) + y * np.sin(turn))).astype(np.float32)
    found = edges_of(wave, ONES)
    wedge = round(degrees / 45.0)
    assert found.energy[0, wedge] > 0.9 * found.energy[0].sum()
    expected = [np.cos(2.0 * turn), np.sin(2.0 * turn)]
    np.testing.assert_allclose(found.towards[0, wedge], expected, atol=0.1)
    np.testing.assert_allclose(directions(wave)[40:-40, 40:-40].mean(axis=(0, 1)), expected, atol=0.05)


def test_a_ruler_that_runs_the_other_way_has_the_same_lens() -> None:
    one = Astigmatism(np.array([3.0, -1.0]), np.eye(2), np.zeros((len(BANDS_PX), 2)))
    towards = np.array([0.5, 0.2])
    assert one.mirrored().shift(towards)[0] == -one.shift(towards)[0]
    assert one.mirrored().shift(towards)[1] == one.shift(towards)[1]


def test_without_a_peak_in_any_wedge_nothing_is_taken_off() -> None:
    rising = [Edges(np.full(NOTHING.shape, np.exp(0.1 * k)), np.zeros((*NOTHING.shape, 2)), NOTHING) for k in range(9)]
    found = find_astigmatism(np.arange(9.0), rising, 4.0, 10.0)
    assert found.shift(np.array([1.0, 0.0])) == pytest.approx((0.0, 0.5))
