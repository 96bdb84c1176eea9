"""The simulated world shows each misfortune that the guards are there for."""

import numpy as np
import pytest
from elpd_drivers.sim.camera import RateLimit
from elpd_drivers.sim.motion import SceneMotion
from elpd_drivers.sim.optics import Lamp, Layer
from elpd_drivers.sim.rig import build_rig
from elpd_drivers.sim.sensor import Events
from elpd_drivers.sim.world import BIRTH_NS, random_stream
from sim_rigs import Ramp, Setup

from elpd.errors import ConfigError
from elpd.records import Roi

WHOLE = Roi(0, 0, 96, 80)


def picture(setup: Setup, since_ms: float = 0.0) -> np.ndarray:
    out = np.empty((80, 96), np.float32)
    setup.light.render(setup.light.wide_open(BIRTH_NS + round(since_ms * 1e6)), WHOLE, out)
    return out


def sharpness(part: np.ndarray) -> float:
    return float(np.square(np.diff(part, axis=0)).mean())


def test_a_pulsed_lamp_has_two_levels_and_a_mean_of_one() -> None:
    light = Lamp(200.0, 0.5, "pwm").light(np.arange(0, 10_000_000, 1000))
    assert set(np.round(light, 6)) == {0.5, 1.5}
    assert light.mean() == pytest.approx(1.0, abs=1e-3)


def test_a_second_plane_is_in_focus_where_it_is() -> None:
    def at(defocus_um: float) -> tuple[float, float]:
        setup = Setup(Ramp(start_um=defocus_um, speed_um_s=1e-9))
        behind = Layer(setup.stack, (48, 0, 48, 80), focus_offset_um=60.0)
        layered = Setup(Ramp(start_um=defocus_um, speed_um_s=1e-9), light={"layers": (behind,)})
        shown = picture(layered)
        return sharpness(shown[:, :46]), sharpness(shown[:, 50:])

    left_first, right_first = at(0.0)
    left_second, right_second = at(60.0)
    assert left_first > 1.5 * left_second
    assert right_second > 1.5 * right_first


def test_an_object_goes_by_and_takes_its_picture_along() -> None:
    setup = Setup(scene="flat")
    other = Setup(scene="gravel").stack
    setup = Setup(scene="flat", light={"layers": (Layer(other, (0, 20, 24, 24), velocity_px_s=1000.0),)})
    shown = [picture(setup, ms) for ms in np.arange(0.0, 130.0, 5.0)]
    columns = [np.flatnonzero(np.ptp(one[20:44], axis=0) > 0.05) for one in shown]
    seen = [one for one in columns if one.size]
    assert seen
    assert max(one.size for one in seen) <= 24
    assert all(np.ptp(one[:20]) < 1e-5 for one in shown), "outside its box nothing changes"
    assert len({int(one[0]) for one in seen}) > 5


def test_breathing_enlarges_about_the_centre() -> None:
    calm = Setup(Ramp(start_um=100.0, speed_um_s=1e-9))
    breathing = Setup(Ramp(start_um=100.0, speed_um_s=1e-9), light={"breathing_per_mm": 0.2})
    a, b = picture(calm), picture(breathing)
    assert np.abs(a - b)[38:42, 46:50].max() < np.abs(a - b).max() / 2
    at_focus = Setup(light={"breathing_per_mm": 0.2}, lens=Ramp(start_um=0.0, speed_um_s=1e-9))
    np.testing.assert_allclose(picture(at_focus), picture(Setup(Ramp(start_um=0.0, speed_um_s=1e-9))), atol=1e-5)


def test_a_pan_adds_to_any_motion_and_stays_within_reach() -> None:
    pan = SceneMotion("static", random_stream(1, "motion"), 29.0, (100.0, 0.0))
    assert pan.moving
    assert pan.displacement_px(100_000.0) == pytest.approx((10.0, 0.0))
    assert all(abs(pan.displacement_px(t)[0]) <= 29.0 for t in np.arange(0.1e6, 3e6, 5e4))


@pytest.mark.parametrize("told", [True, False])
def test_a_rate_limit_thins_evenly_and_counts_or_not(*, told: bool) -> None:
    count = 10_000
    events = Events(np.arange(count), np.zeros(count, np.uint16), np.zeros(count, np.uint16), np.ones(count, np.uint8))
    left = RateLimit(2.0, told=told).thinned(events)
    assert len(left.t_us) == 1000
    assert left.lost == (9000 if told else 0)
    assert np.ptp(np.diff(left.t_us)) <= 1
    assert RateLimit().thinned(events) is events


@pytest.mark.parametrize(
    "setting",
    [{"flicker_shape": "square"}, {"flicker_depth": 1.5}, {"overexposed": 0.0}, {"rate_limit_mev_s": -1.0}],
    ids=str,
)
def test_impossible_misfortunes_are_refused(setting: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(setting))):
        build_rig({"seed": 1, "width": 64, "height": 64, **setting})
