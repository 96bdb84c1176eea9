"""The profile store: whole or not at all, checked on loading, never another camera's."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

import pytest
from scripted_rig import Camera, Script

from elpd.calibrate import profile
from elpd.calibrate.profile import MeasuredOn, Profile, load, make_room, path_of, save, state_directory
from elpd.calibrate.quantity import Quantity
from elpd.calibrate.sensor import SensorCalibration, sensor_in_use
from elpd.config import load as load_config
from elpd.errors import FormatError, UsageError

WHEN = datetime(2026, 3, 1, 12, tzinfo=UTC)
ON = MeasuredOn(device="evk4", serial="00050567", width=1280, height=720, settings={"camera.bias_fo": 3})


class Focal(Profile):
    """Another kind than the sensor's, as others will add."""

    KIND: ClassVar[str] = "focal"
    VERSION: ClassVar[int] = 3

    length_mm: Quantity


def focal(length_mm: float = 50.0) -> Focal:
    return Focal(**Focal.head(ON, WHEN), length_mm=Quantity.of(length_mm, 0.1, "mm"))


def test_what_was_saved_is_loaded_and_kinds_do_not_meet(tmp_path: Path) -> None:
    folder = tmp_path / "not" / "yet"
    assert load(folder, Focal) is None
    assert save(folder, focal()) == folder / "focal.json"
    assert load(folder, Focal) == focal()
    assert load(folder, SensorCalibration) is None
    assert [item.name for item in folder.iterdir()] == ["focal.json"]


def test_a_disk_that_fails_leaves_the_old_profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path, focal(50.0))

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(profile.os, "fsync", full)
    with pytest.raises(UsageError, match=r"No space left on device.*old one, if any, is untouched"):
        save(tmp_path, focal(80.0))
    assert load(tmp_path, Focal) == focal(50.0)
    assert [item.name for item in tmp_path.iterdir()] == ["focal.json"]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda text: text[: len(text) // 2], "damaged or cut off after"),
        (lambda text: text.replace('"version": 3', '"version": 2'), "profile version 2, this elpd reads 3"),
        (lambda text: text.replace('"focal"', '"lens"'), "no profile of kind 'focal' \\(found 'lens'\\)"),
        (lambda text: text.replace('"width": 1280', '"width": "wide"'), "on.width: input should be a valid integer"),
        (lambda text: text.replace('"sigma": 0.1', '"sigma": null'), "a value and a sigma, or a reason"),
        (lambda _: "[]", "found 'list'"),
        (lambda _: "", "cut off after 0 characters"),
    ],
)
def test_a_file_that_is_not_whole_is_an_error_with_a_way_out(tmp_path: Path, spoil: Any, told: str) -> None:
    path = save(tmp_path, focal())
    path.write_text(spoil(path.read_text()))
    with pytest.raises(FormatError, match=f"{told}.*(run `elpd calibrate focal` again|delete the file)"):
        load(tmp_path, Focal)


@pytest.mark.parametrize("torn", ["{", '{"kind": "focal", "version": 99}'])
def test_what_nobody_can_read_is_set_aside_before_measuring_again(tmp_path: Path, torn: str) -> None:
    path_of(tmp_path, Focal).write_text(torn, encoding="utf-8")
    make_room(tmp_path, Focal)
    assert load(tmp_path, Focal) is None
    assert (tmp_path / "focal.json.unreadable").read_text(encoding="utf-8") == torn
    save(tmp_path, focal())
    make_room(tmp_path, Focal)
    assert load(tmp_path, Focal) == focal(), "a good one stays"


def test_a_place_that_cannot_be_written_is_known_before_measuring(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"could not be written .*--dry-run"):
        make_room(tmp_path / "file" / "folder", Focal)


def test_the_state_directory_is_the_configured_or_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    assert state_directory(load_config()) == tmp_path / "xdg" / "elpd"
    monkeypatch.setenv("XDG_STATE_HOME", "relative/is/ignored")
    assert state_directory(load_config()) == Path.home() / ".local" / "state" / "elpd"
    assert state_directory(load_config(None, [f"state.directory={tmp_path}"])) == tmp_path


def test_another_camera_or_another_setting_is_told_apart() -> None:
    for change, told in (
        ({"width": 640}, "1280x720 pixels, this camera has 640x720"),
        ({"serial": "1"}, "serial number 00050567, this one is 1"),
        ({"device": "davis346"}, "camera evk4, this one is davis346"),
        ({"settings": {"camera.bias_fo": 4}}, "camera.bias_fo = 3, which is 4 now"),
        ({"settings": {}}, "camera.bias_fo = 3, which is None now"),
    ):
        assert told in str(ON.difference(ON.model_copy(update=change)))
    assert ON.difference(ON.model_copy()) is None


class _Serial(Camera):
    serial = "simulated-0"


def _sensor(on: MeasuredOn) -> SensorCalibration:
    none = Quantity.none("nobody looked")
    fields: dict[str, Any] = {
        name: none for name, field in SensorCalibration.model_fields.items() if field.annotation is Quantity
    }
    fields |= {"lag_us": Quantity.of(70.0, 9.0, "us")}
    return SensorCalibration(
        **SensorCalibration.head(on, WHEN),
        **fields,
        lag_by_brightness=(),
        hot_pixels=({"x": 3, "y": 4, "hz": 99.0},),  # type: ignore[arg-type]
        hot_reason=None,
        hot_above_hz=10.0,
        hot_false_alarms=0.01,
        rest_s=1.0,
        events=7,
    )


def test_a_cycle_takes_the_profile_of_its_own_camera_only(tmp_path: Path) -> None:
    config = load_config(None, [f"state.directory={tmp_path}"])
    camera = _Serial(Script([]))
    assert sensor_in_use(config, camera) is None
    save(tmp_path, _sensor(MeasuredOn.camera(config, camera)))
    found = sensor_in_use(config, camera)
    assert found is not None
    assert (found.hot_pixels, found.lag_us, found.lag_sigma_us) == (((3, 4),), 70.0, 9.0)
    other = load_config(None, [f"state.directory={tmp_path}", "sim.seed=1"])
    assert sensor_in_use(other, camera) is None
    unwanted = load_config(None, [f"state.directory={tmp_path}", "state.profiles=false"])
    assert sensor_in_use(unwanted, camera) is None
    path = path_of(tmp_path, SensorCalibration)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"events": "many"}))
    with pytest.raises(FormatError, match="events: "):
        sensor_in_use(config, camera)
