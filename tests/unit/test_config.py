import contextlib
from pathlib import Path

import pytest
from elpd_drivers.cameras.davis import DavisSettings
from elpd_drivers.cameras.neuromorphic_tables import NeuromorphicSettings
from elpd_drivers.cameras.source import read_table
from hypothesis import given
from hypothesis import strategies as st

from elpd import rig
from elpd.config import Config, load
from elpd.errors import ConfigError, ElpdError, LensError
from elpd.timebase import MonotonicClock

CONFIGS = Path(__file__).parents[2] / "config"


def test_without_a_file_the_rig_is_the_simulated_one() -> None:
    config = load()
    assert config.rig == "sim"
    assert config == Config()


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*-*.toml")), ids=lambda path: path.name)
def test_a_shipped_rigs_lens_table_is_one_that_its_driver_reads(path: Path) -> None:
    with pytest.raises(LensError, match="no such port"):
        rig._open_lens(load(path).lens, MonotonicClock())


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*-*.toml")), ids=lambda path: path.name)
def test_a_shipped_rigs_camera_table_is_one_that_its_driver_reads(path: Path) -> None:
    camera = load(path).camera
    tables = {"neuromorphic": NeuromorphicSettings, "davis": DavisSettings}
    assert read_table(tables[camera.driver], camera.settings()).serial is None


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.name)
def test_every_shipped_configuration_is_valid(path: Path) -> None:
    assert load(path).lens.speed_um_s > 0


def test_the_annotated_defaults_are_the_defaults() -> None:
    assert load(CONFIGS / "elpd.toml") == Config()


def test_overrides_win_over_the_file(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("[sim]\nseed = 1\nscene = 'coffee'\n")
    config = load(path, ["sim.seed=3", "focus.roi=[1,2,30,40]", "lens.port=/dev/ttyACM0"])
    assert (config.sim.seed, config.sim.scene) == (3, "coffee")
    assert config.focus.roi == (1, 2, 30, 40)
    assert config.lens.settings() == {"port": "/dev/ttyACM0"}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[focus]\ndeadlin_ms = 3\n", ":2: focus.deadlin_ms: unknown key"),
        ("[focus]\n\ndeadline_ms = -3\n", ":3: focus.deadline_ms: input should be greater than 0"),
        ("[fokus]\n", ":1: fokus: unknown key"),
        ("[focus\n", "Expected ']'"),
        ("rig = 'moon'\n", ":1: rig: input should be 'sim' or 'hardware'"),
    ],
)
def test_a_wrong_file_is_refused_with_its_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load(path)
    assert str(path) in str(refused.value)
    assert told in str(refused.value)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "absent.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not text"):
        load(tmp_path / "binary.toml")


@pytest.mark.parametrize("override", ["sim.seed", "=3", "sim..seed=3", "rig.x=3"])
def test_a_wrong_override_is_refused(override: str) -> None:
    with pytest.raises(ConfigError):
        load(None, [override])


@given(st.text(max_size=40))
def test_no_override_makes_a_traceback(override: str) -> None:
    loaded: Config | None = None
    with contextlib.suppress(ElpdError):
        loaded = load(None, [override])
    assert loaded is None or isinstance(loaded, Config)
