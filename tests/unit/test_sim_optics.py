"""Scene, defocus, motion and aperture: what light falls on the sensor."""

from __future__ import annotations

import cv2
import naive_sim
import numpy as np
import pytest
from elpd_drivers.sim.aperture import SimulatedAperture
from elpd_drivers.sim.motion import KINDS, SceneMotion
from elpd_drivers.sim.optics import DARK, SIGMA0_PX, Condition, DefocusStack, blend_shifted, blur_ladder
from elpd_drivers.sim.scene import FLOOR, NAMES, PICTURES, choose_scene, scene_canvas
from elpd_drivers.sim.world import BIRTH_NS, World, random_stream
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_rigs import MARGIN_PX, Ramp, Setup

from elpd.errors import ConfigError
from elpd.records import Roi


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    weight=st.floats(0, 1),
    part_y=st.sampled_from([0.0, 0.25, 0.7]),
    part_x=st.sampled_from([0.0, 0.5, 0.99]),
)
def test_blend_equals_its_slow_twin(seed: int, weight: float, part_y: float, part_x: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 16, 18)).astype(np.float32)
    out = np.empty((9, 10), np.float32)
    f = np.float32
    blend_shifted(a, b, f(weight), 3, 4, f(part_y), f(part_x), np.empty(13, f), out)
    expected = naive_sim.blend_shifted(a, b, weight, 3 + part_y, 4 + part_x, 9, 10)
    np.testing.assert_allclose(out, expected, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("name", NAMES)
def test_every_scene_covers_the_sensor_in_linear_light(name: str) -> None:
    canvas = scene_canvas(name, 1280, 720, MARGIN_PX)
    assert canvas.shape == (720 + 2 * MARGIN_PX, 1280 + 2 * MARGIN_PX)
    assert canvas.dtype == np.float32
    assert canvas.min() >= FLOOR
    assert canvas.max() <= 1.0
    assert (canvas.std() > 0.02) == (name != "flat")


def test_scenes_are_chosen_by_seed_and_unknown_names_refused() -> None:
    drawn = {choose_scene("random", random_stream(seed, "scene")) for seed in range(60)}
    assert drawn == set(PICTURES)
    with pytest.raises(ConfigError, match=r"sim\.scene is 'moon'; known: random, astronaut"):
        choose_scene("moon", random_stream(0, "scene"))


@pytest.mark.parametrize("name", ["camera", "grass"])
@pytest.mark.parametrize("sigma_px", [0.35, 0.5, 0.9, 2.0, 4.7])
def test_the_ladder_is_as_good_as_blurring_afresh(name: str, sigma_px: float) -> None:
    canvas = scene_canvas(name, 128, 96, MARGIN_PX)
    a, b, weight = DefocusStack(canvas, 1.0).bracket(sigma_px**2)
    # The discrete Gaussian (Lindeberg 1990): the kernel of diffusion on a grid, exp(-sigma²(1 - cos w)) in frequency.
    frequency = 2 * np.pi * np.fft.fftfreq(63)
    taps = np.fft.fftshift(np.fft.ifft(np.exp(-(sigma_px**2) * (1 - np.cos(frequency)))).real)
    fresh = np.log(cv2.sepFilter2D(canvas, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT) + DARK)
    error = (a + weight * (b - a) - fresh)[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    assert np.sqrt(np.mean(error**2)) < 0.01  # a twentieth of a contrast threshold


def test_the_ladder_begins_at_the_sharpest_and_is_clamped_at_its_end() -> None:
    assert blur_ladder()[0] == pytest.approx(SIGMA0_PX**2)
    stack = DefocusStack(scene_canvas("brick", 32, 32, MARGIN_PX), 1.0)
    assert stack.bracket(0.0)[2] == 0.0
    assert stack.bracket(1e9)[2] == 1.0


def test_defocus_grows_with_distance_and_shrinks_with_the_aperture() -> None:
    setup = Setup(Ramp(start_um=-60.0), with_aperture=True)
    instant = np.array([BIRTH_NS], np.int64)
    assert setup.light.conditions(instant)[0].light == 0.0
    setup.aperture.open()
    setup.world.sleep_until(BIRTH_NS + 40_000_000)
    late = setup.light.conditions(np.array([BIRTH_NS + 6_000_000]))[0]  # still at -60 um
    assert late.sigma2_px2 == pytest.approx(SIGMA0_PX**2 + (0.0233 * 60) ** 2 * late.light)
    assert 0 < late.light < 0.1


def test_a_whole_pixel_of_motion_is_a_shift_of_the_picture() -> None:
    setup = Setup(scene="gravel")
    window = Roi(8, 8, 40, 30)
    still, shifted = np.empty((30, 40), np.float32), np.empty((30, 40), np.float32)
    setup.light.render(Condition(0.5, 0.0, 0.0, 1.0), Roi(7, 10, 40, 30), still)
    setup.light.render(Condition(0.5, 1.0, -2.0, 1.0), window, shifted)
    np.testing.assert_array_equal(still, shifted)


@pytest.mark.parametrize(("kind", "rms_px_s"), [("moderate", 20.2), ("violent", 100.0), ("shake", 100.0)])
def test_motion_has_the_stated_speed_and_stays_in_the_margin(kind: str, rms_px_s: float) -> None:
    motion = SceneMotion(kind, random_stream(5, "motion"), 29.0)
    path = np.array([motion.displacement_px(1000.0 * k) for k in range(6000)])
    assert np.abs(path).max() <= 29.0
    speed = np.hypot(*np.diff(path, axis=0).T) * 1000
    rms = np.sqrt(np.mean(speed**2)) / (1.0 if kind == "shake" else np.sqrt(2))
    assert rms == pytest.approx(rms_px_s, rel=0.15)


def test_motion_is_repeatable_and_static_is_still() -> None:
    a, b = (SceneMotion("shake", random_stream(2, "motion"), 29.0) for _ in range(2))
    assert [a.displacement_px(t) for t in range(0, 50_000, 700)] == [
        b.displacement_px(t) for t in range(0, 50_000, 700)
    ]
    assert SceneMotion("static", random_stream(2, "motion"), 29.0).displacement_px(1e9) == (0.0, 0.0)
    with pytest.raises(ConfigError, match=", ".join(KINDS)):
        SceneMotion("wobble", random_stream(2, "motion"), 29.0)


# --- aperture ------------------------------------------------------------------------------------------------------


def _ms(world: World, ms: float) -> np.ndarray:
    return np.array([world.now_ns() + round(ms * 1e6)], np.int64)


def test_the_iris_opens_quadratically_after_a_delay() -> None:
    world = World()
    aperture = SimulatedAperture(world, random_stream(1, "aperture"))
    assert aperture.transmittance_at(_ms(world, 0)) == 0
    stamp = aperture.open()
    assert stamp.begun_ns == world.now_ns()
    delay_ms = (aperture.began_ns - world.now_ns()) / 1e6
    assert 2 <= delay_ms <= 5
    assert aperture.transmittance_at(_ms(world, delay_ms + 10))[0] == pytest.approx(0.25, abs=1e-6)
    assert aperture.transmittance(np.array([-5.0, 10_000.0, 20_000.0, 90_000.0])) == pytest.approx([0, 0.25, 1, 1])
    assert aperture.transmittance_at(_ms(world, aperture.opening_ms)) == 1
    world.sleep_until(world.now_ns() + 15_000_000)
    aperture.close()  # half way
    assert aperture.transmittance_at(_ms(world, 30)) == 0
    assert aperture.transmittance_at(_ms(world, 1)) > 0


@pytest.mark.parametrize(("fault", "light_at_the_end"), [(None, 1.0), ("stuck", 0.0), ("slow", 0.1)])
def test_apertures_that_fail(fault: str | None, light_at_the_end: float) -> None:
    world = World()
    aperture = SimulatedAperture(world, random_stream(1, "aperture"), fault=fault)
    aperture.open()
    assert aperture.transmittance_at(_ms(world, aperture.opening_ms))[0] == pytest.approx(light_at_the_end, abs=0.05)


def test_bad_apertures_are_refused() -> None:
    with pytest.raises(ConfigError, match="iris, linear"):
        SimulatedAperture(World(), random_stream(1, "aperture"), profile="square")
    with pytest.raises(ConfigError, match="aperture_ms"):
        SimulatedAperture(World(), random_stream(1, "aperture"), opening_ms=0)
