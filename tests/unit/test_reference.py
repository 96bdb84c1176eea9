"""From picture to weights: balance, range, sign, texture, and the scale that a blurred picture needs."""

from typing import Any

import cv2
import numpy as np
import pytest
from sweep_world import picture

from elpd.errors import FormatError, UsageError
from elpd.records import Geometry, Roi, TemporalImage
from elpd.units import SensorUs
from elpd.vision.reference import (
    FULL_SCALE,
    check_size,
    load_image,
    reference_from_frame,
    reference_from_temporal_image,
)

ROI = Roi(10, 12, 70, 60)


def frame(seed: Any = 0, blur_px: Any = 0.7, noise: Any = 0.0) -> Any:
    image = cv2.GaussianBlur(picture(96, seed), (0, 0), blur_px)
    image += noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_weights_are_balanced_bounded_and_inside() -> None:
    reference = reference_from_frame(frame(), ROI)
    weights = reference.weights.astype(np.int64)
    inside = np.zeros(weights.shape, bool)
    inside[12:72, 10:80] = True
    assert not weights[~inside].any()
    assert np.abs(weights).max() <= FULL_SCALE
    assert abs(weights[inside].mean()) < 1.0
    assert reference.weights.dtype == np.int16
    assert reference.textured


def test_a_bright_spot_has_negative_weight_as_a_laplacian_has() -> None:
    image = np.full((40, 40), 80, np.uint8)
    cv2.circle(image, (20, 20), 3, 200, -1)
    weights = reference_from_frame(image, Roi(2, 2, 36, 36)).weights
    assert weights[20, 20] < 0
    assert weights[20, 26] > 0


def test_contrast_does_not_set_the_scale_of_weights() -> None:
    image = picture(96, 3)
    loud = reference_from_frame(np.clip(image * 100, 0, 65535).astype(np.uint16), ROI).weights
    quiet = reference_from_frame(np.clip(30000 + image * 10, 0, 65535).astype(np.uint16), ROI).weights
    assert loud.std() == pytest.approx(quiet.std(), rel=0.3)


@pytest.mark.parametrize("noise", [0.0, 2.0, 10.0])
@pytest.mark.parametrize("seed", range(5))
def test_a_flat_wall_is_refused_however_noisy(noise: Any, seed: Any) -> None:
    wall = 128.0 + noise * np.random.default_rng(seed).standard_normal((96, 96))
    assert not reference_from_frame(np.clip(np.rint(wall), 0, 255).astype(np.uint8), ROI).textured


@pytest.mark.parametrize("seed", range(5))
def test_a_picture_blurred_tenfold_is_not_refused(seed: Any) -> None:
    assert reference_from_frame(frame(seed, blur_px=5.0, noise=1.0), ROI).textured


def test_a_blurred_picture_gets_a_coarser_scale() -> None:
    assert reference_from_frame(frame(1, 0.7), ROI).scale_px < reference_from_frame(frame(1, 4.5), ROI).scale_px


def test_saturated_pixels_have_no_weight() -> None:
    image = frame()
    image[30:40, 30:40] = 255
    assert not reference_from_frame(image, ROI).weights[31:39, 31:39].any()


def test_a_map_of_log_intensity_weighs_like_the_frame_and_not_where_it_is_blind() -> None:
    light = cv2.GaussianBlur(picture(96, 2), (0, 0), 0.7)
    valid = np.ones(light.shape, bool)
    valid[30:34, 40:44] = False
    image = TemporalImage(np.log(light).astype(np.float32), valid, SensorUs(0), 1.0, 0, 16, 40.0)
    reference = reference_from_temporal_image(image, ROI)
    twin = reference_from_frame((light * 100).astype(np.uint16), ROI)
    assert not reference.weights[30:34, 40:44].any()
    assert np.corrcoef(reference.weights.ravel(), twin.weights.ravel())[0, 1] > 0.8
    np.testing.assert_allclose(reference.brightness[valid], twin.brightness[valid], atol=0.01)


def test_a_region_without_a_valid_pixel_is_flat() -> None:
    reference = reference_from_frame(frame(), ROI, mask=np.zeros((96, 96), bool))
    assert not reference.textured
    assert not reference.weights.any()


def test_images_are_read_or_refused(tmp_path: Any) -> None:
    deep = (picture(32, 1) * 200).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    np.testing.assert_array_equal(load_image(tmp_path / "deep.png"), deep)
    (tmp_path / "text.png").write_text("this is no picture")
    with pytest.raises(FormatError, match="no image"):
        load_image(tmp_path / "text.png")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(FormatError, match="0 bytes"):
        load_image(tmp_path / "empty.png")
    with pytest.raises(FormatError, match="cannot be read"):
        load_image(tmp_path / "missing.png")
    with pytest.raises(UsageError, match="32x32"):
        check_size(deep.shape, Geometry(640, 480), "deep.png")
    with pytest.raises(UsageError, match="two dimensions"):
        reference_from_frame(np.zeros((4, 4, 3), np.uint8), Roi(0, 0, 4, 4))
