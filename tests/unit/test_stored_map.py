from pathlib import Path

import numpy as np
import pytest

from elpd.errors import FormatError, UsageError
from elpd.focus.stored_map import StoredMap, load, save
from elpd.records import Geometry, TemporalImage
from elpd.units import SensorUs


def a_map() -> StoredMap:
    image = TemporalImage(
        log_intensity=np.arange(12, dtype=np.float32).reshape(3, 4),
        valid=np.arange(12).reshape(3, 4) % 5 != 0,
        open_us=SensorUs(1234),
        fired_fraction=0.75,
        hot_pixels=1,
        filled_pixels=2,
        dynamic_range_db=61.5,
    )
    return StoredMap(image, 2000.5, 1_000_000.0)


def test_a_map_survives_the_disk(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "last-map.npz"
    save(path, a_map())
    read = load(path)
    assert (read.position_um, read.made_unix_s) == (2000.5, 1_000_000.0)
    assert np.array_equal(read.image.log_intensity, a_map().image.log_intensity)
    assert np.array_equal(read.image.valid, a_map().image.valid)
    assert (read.image.open_us, read.image.hot_pixels, read.image.dynamic_range_db) == (1234, 1, 61.5)
    assert [item.name for item in path.parent.iterdir()] == ["last-map.npz"]


@pytest.mark.parametrize("cut", [0, 1, 100, -1])
def test_a_torn_file_is_refused(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "last-map.npz"
    save(path, a_map())
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(FormatError, match="elpd expose"):
        load(path)


def test_a_map_must_fit_be_young_and_made_here() -> None:
    stored, geometry = a_map(), Geometry(4, 3)
    stored.check(geometry, 2000.0, 6.0, 1_000_060.0)
    with pytest.raises(UsageError, match="4x3"):
        stored.check(Geometry(5, 3), 2000.0, 6.0, 1_000_060.0)
    with pytest.raises(UsageError, match="old"):
        stored.check(geometry, 2000.0, 6.0, 1_000_000.0 + 90_000)
    with pytest.raises(UsageError, match="away"):
        stored.check(geometry, 2100.0, 6.0, 1_000_060.0)
