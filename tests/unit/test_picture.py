from pathlib import Path

import cv2
import numpy as np
import pytest
from sweep_world import picture as scene

from elpd.errors import UsageError
from elpd.focus.picture import Picture
from elpd.records import Geometry, Roi
from elpd.vision.pictures import read_picture, write_log_png

ROI = Roi(8, 8, 48, 48)
GEOMETRY = Geometry(64, 64)


def light() -> np.ndarray:
    return np.asarray(20.0 + scene(64, 3), dtype=np.float64)


def test_the_log_of_a_stored_map_is_not_taken_twice(tmp_path: Path) -> None:
    """Weights of a log picture are those of the map it was written from, whoever reads the file."""
    log_intensity = np.log(light()).astype(np.float32)
    write_log_png(tmp_path / "map.png", log_intensity)
    for picture in (
        Picture.of_file(tmp_path / "map.png", GEOMETRY),
        Picture.of_image(read_picture(tmp_path / "map.png")),
    ):
        assert picture.map is not None
        assert picture.pixels is None
        np.testing.assert_allclose(picture.log_image, log_intensity, atol=1e-4)
        assert picture.reference(ROI).textured


def test_a_grey_file_is_linear_light_and_must_show_the_whole_sensor(tmp_path: Path) -> None:
    grey = np.rint(light() * 200).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    picture = Picture.of_file(tmp_path / "grey.png", GEOMETRY)
    assert picture.map is None
    np.testing.assert_array_equal(picture.pixels, grey)
    with pytest.raises(UsageError, match="64x64"):
        Picture.of_file(tmp_path / "grey.png", Geometry(640, 480))
