"""An aperture's own profile, from the events of its opening, against the simulated iris and shutter."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from command_line import caller
from elpd_drivers.sim.world import BIRTH_NS
from openings import natural_scene, record
from sim_rigs import Setup

from elpd.calibrate.aperture import ApertureCalibration, CalibratedAperture, combine, measured_on, with_profile
from elpd.calibrate.evidence import NO_EVENTS, Columns
from elpd.calibrate.opening import OpeningCurve, Pixels, measure_opening
from elpd.calibrate.profile import save
from elpd.config import load
from elpd.errors import FormatError, UsageError
from elpd.records import BiasSet, Geometry
from elpd.units import SensorUs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.temporal_map import Transmittance, iris, linear, read_transmittance, temporal_image

if TYPE_CHECKING:
    from pathlib import Path

SIZE = (64, 48)
GEOMETRY = Geometry(*SIZE)
BRIGHTNESS = 4.0
LAG_US = 60.0
CARD = 0.2 * BRIGHTNESS


def opened(seed: int, profile: str, *, biases: BiasSet = BiasSet.FOCUS, scene: str = "flat") -> tuple[Setup, Columns]:
    """Open the aperture after 15 ms of darkness; return the setup and what the pixels said in 60 ms."""
    sensor = {"lag_us": LAG_US}
    setup = Setup(
        seed=seed,
        scene=scene,
        size=SIZE,
        with_aperture=True,
        aperture={"profile": profile},
        sensor=sensor,
        brightness=BRIGHTNESS,
    )
    setup.camera.start()
    setup.camera.apply_biases(biases)
    dark = setup.run(0.015)
    setup.aperture.open()
    events = np.concatenate([dark, setup.run(0.06)])
    return setup, Columns(events["t"].astype(np.int64), events["x"], events["y"], events["on"].astype(np.uint8))


def measured(seed: int, profile: str) -> tuple[Setup, OpeningCurve]:
    setup, events = opened(seed, profile)
    pixels = Pixels(0.18, 0.005, refractory_us=500.0, lag_us=LAG_US / (CARD + 0.01), lag_sigma_us=5.0)
    return setup, measure_opening(events, GEOMETRY, 7_000, 60_000, pixels)


def off_by(setup: Setup, curve: OpeningCurve) -> tuple[Any, Any]:
    """Return the error of log T where more than 2 % of the light comes, overall factor apart, and its sigma."""
    at_ns = (BIRTH_NS + (curve.begin_us + curve.since_us) * 1e3).astype(np.int64)
    truth = setup.aperture.transmittance_at(at_ns)
    use = truth > 0.02
    error = np.log(curve.transmittance[use] / truth[use])
    stretch = curve.scale_sigma * np.abs(np.log(truth[use]) - np.log(truth[use]).mean())
    return error - np.median(error), np.hypot(curve.sigma[use], stretch)


@pytest.mark.parametrize("profile", ["iris", "linear"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_curve_is_found_within_its_error(seed: int, profile: str) -> None:
    setup, curve = measured(seed, profile)
    error, sigma = off_by(setup, curve)
    assert (np.abs(error) < 3 * np.maximum(sigma, 0.01)).all()
    assert np.abs(error[4:]).max() < 0.07  # of a range of 4; below is what the power law adds
    began_us = (setup.aperture.began_ns - BIRTH_NS) / 1e3
    assert abs(curve.begin_us - began_us) < 4 * curve.begin_sigma_us < 3_500
    assert abs(curve.opening_us - 20_000) < 4 * curve.opening_sigma_us < 3_500


def stretch_of_a_map(exponent: int, transmittance: Transmittance) -> float:
    """Return by how much a map's log intensity is stretched against the truth, where the aperture opens so."""
    scene = natural_scene(3)
    opening = record(scene, exponent=exponent, mismatch=0.03)
    first = FirstEventMap(Geometry(scene.shape[1], scene.shape[0]), begin_us=opening.open_us)
    first.add(opening.t_us, opening.x, opening.y, opening.on)
    image = temporal_image(first.believed(), transmittance, SensorUs(opening.open_us))
    return float(np.polyfit(scene[image.valid], image.log_intensity[image.valid], 1)[0])


@pytest.mark.parametrize(("exponent", "wrong"), [(2, linear), (1, iris)])
def test_a_map_made_with_it_is_truer_than_with_a_wrong_guess(
    exponent: int, wrong: Transmittance, tmp_path: Path
) -> None:
    _, curve = measured(4, {1: "linear", 2: "iris"}[exponent])
    calibration = combine([curve], [], measured_on(load()), threshold=0.18, lag_corrected=True)
    stored = read_transmittance(save(tmp_path, calibration))
    right = abs(np.log(stretch_of_a_map(exponent, stored)))
    assert right < 0.2
    assert abs(np.log(stretch_of_a_map(exponent, wrong))) > 0.6


def table(**changes: Any) -> ApertureCalibration:
    curve = OpeningCurve(
        1000.0,
        50.0,
        50.0,
        np.array([0.0, 5e3, 1e4]),
        np.array([0.0, 0.25, 1.0]),
        np.array([0.1, 0.01, 0.01]),
        0.02,
        2.0,
        9,
        9,
    )
    on = measured_on(load(overrides=changes.get("overrides", ())))
    return combine([curve, curve], [3000.0, 3200.0], on, threshold=0.18, lag_corrected=False)


def test_openings_are_averaged_with_what_they_differ_by() -> None:
    found = table()
    assert (found.delay_us.value, found.openings) == (3100.0, 2)
    assert found.delay_us.sigma == pytest.approx(100.0)
    assert found.transmittance == (0.0, 0.25, 1.0)
    assert found.sigma[1] == pytest.approx(0.01 / np.sqrt(2))


def test_a_stored_profile_is_used_by_its_own_aperture_alone(tmp_path: Path) -> None:
    here = [f"state.directory={tmp_path}"]
    setup = Setup(with_aperture=True)
    assert with_profile(load(overrides=here), setup.aperture) is setup.aperture
    save(tmp_path, table())
    used = with_profile(load(overrides=here), setup.aperture)
    assert isinstance(used, CalibratedAperture)
    assert used.transmittance(np.array([-1.0, 2500.0, 1e6])).tolist() == [0.0, 0.125, 1.0]
    assert used.opening_ms == setup.aperture.opening_ms
    fast = Setup(with_aperture=True, aperture={"opening_ms": 5.0}).aperture
    assert 13.1 < CalibratedAperture(fast, table()).opening_ms < 14
    assert used.open().command == "open"
    assert used.close().command == "close"
    assert with_profile(load(overrides=[*here, "sim.aperture_ms=50.0"]), setup.aperture) is setup.aperture
    assert with_profile(load(overrides=[*here, "state.profiles=false"]), setup.aperture) is setup.aperture
    assert with_profile(load(overrides=here), None) is None


def test_damaged_profiles_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path, table())
    content = json.loads(path.read_text())
    content["transmittance"][2] = 0.1
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError, match="more and more light"):
        with_profile(load(overrides=[f"state.directory={tmp_path}"]), Setup(with_aperture=True).aperture)
    path.write_text('{"kind": "sensor"}')
    with pytest.raises(FormatError, match="not of an aperture"):
        read_transmittance(path)
    path.write_text('{"kind": "aperture", "since_us": [0, 1, 2], "transmittance": [0, 1]}')
    with pytest.raises(FormatError, match="one length"):
        read_transmittance(path)
    path.write_text('{"kind": "aperture"')
    with pytest.raises(FormatError, match="no aperture profile"):
        read_transmittance(path)


def test_what_cannot_be_measured_is_said() -> None:
    pixels = Pixels(0.18)
    with pytest.raises(UsageError, match="0 pixels saw it brighten"):
        measure_opening(NO_EVENTS, GEOMETRY, 0, 1000, pixels)
    _, events = opened(1, "iris", biases=BiasSet.EXPOSE)
    with pytest.raises(UsageError, match="biases allow only a first event"):
        measure_opening(events, GEOMETRY, 7_000, 60_000, pixels)
    setup, events = opened(1, "linear")
    began_us = (setup.aperture.began_ns - BIRTH_NS) // 1000
    with pytest.raises(UsageError, match="darkness before"):
        measure_opening(events, GEOMETRY, int(began_us) + 2_000, 60_000, pixels)
    with pytest.raises(UsageError, match="contrast threshold of 2"):
        measure_opening(events, GEOMETRY, 7_000, 60_000, Pixels(2.0))


def test_on_the_rig_and_from_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    elpd = caller(capsys, monkeypatch, tmp_path)
    here = ["--set", f"state.directory={tmp_path}"]
    small = ["--set", "sim.width=64", "--set", "sim.height=48", "--set", "sim.scene=flat", "--set", "sim.brightness=4"]
    said = elpd("calibrate", "aperture", "--openings", "2", "--threshold", "0.18,0.005", *here, *small, "--json")
    code, answer = said.code, said.json
    assert code == 0
    assert answer["openings"] == 2
    assert 1500 < answer["delay_us"]["value"] < 5500
    assert (tmp_path / "aperture.json").exists()
    _, events = opened(5, "iris")
    records = np.zeros(events.t_us.size, [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
    records["t"], records["x"], records["y"], records["p"] = events
    np.save(tmp_path / "card.npy", records)
    options = ["--threshold", "0.18", "--open-us", "7000,60000", "--dry-run"]
    said = elpd("calibrate", "aperture", str(tmp_path / "card.npy"), *options, *here, "--json")
    code, answer = said.code, said.json
    assert code == 0
    assert answer["saved"] is None
    assert answer["delay_us"]["value"] is None
    said = elpd("calibrate", "aperture", str(tmp_path / "card.npy"), *here, "--json")
    code, answer = said.code, said.json
    assert code == 2
    assert "nobody knows how large" in answer["error"]["message"]
