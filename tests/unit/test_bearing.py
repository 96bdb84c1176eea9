"""The direction from the image's sharpness, and what the image is made of."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from elpd.events.decoder import EventArrays
from elpd.records import Direction, Frame, Geometry, Roi
from elpd.units import SensorUs
from elpd.vision.alignment import displacement_px, laid_on, moved
from elpd.vision.bearing import BAND_PX, Bearing, Gauge, Unrest
from elpd.vision.integral import band_energy, band_gain, band_patch
from elpd.vision.memory import EventMemory
from elpd.vision.resting import Resting, order
from elpd.vision.track import FrameEnergy, frame_levels

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

SIZE = 96
ROI = Roi(0, 0, SIZE, SIZE)
GEOMETRY = Geometry(SIZE, SIZE)
MARGIN = 14


def scene(blur_px: float, shift_px: int = 0, seed: int = 3) -> NDArray[np.float32]:
    grain = np.random.default_rng(seed).standard_normal((2 * SIZE, 2 * SIZE)).astype(np.float32)
    image = 40.0 * cv2.GaussianBlur(grain, (0, 0), blur_px)
    return np.ascontiguousarray(image[40 : 40 + SIZE, 40 + shift_px : 40 + shift_px + SIZE])


def events_at(seed: int, count: int, on: NDArray[np.uint8] | None = None) -> EventArrays:
    rng = np.random.default_rng(seed)
    x, y = (rng.integers(SIZE, size=count).astype(np.uint16) for _ in range(2))
    p = rng.integers(2, size=count).astype(np.uint8) if on is None else on[y, x]
    return EventArrays(np.arange(count, dtype=np.int64) * 20, x, y, p)


def path(seed: int, looks: int = 30) -> NDArray[np.int64]:
    """Return where a scene that trembles has gone, in pixels."""
    return np.random.default_rng(seed).integers(-1, 2, size=looks).cumsum()


def unrest(seed: int = 1, blur_px: float = 4.5) -> Unrest:
    stills = [(1000 * k, scene(blur_px, int(shift))) for k, shift in enumerate(path(seed, 12))]
    found = Unrest.of(stills, MARGIN)
    assert found is not None
    return found


def judged(bearing: Bearing, images: Iterable[NDArray[np.float32]]) -> Direction:
    for k, image in enumerate(images):
        bearing.look(image, 1000 * k)
    return bearing.direction


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("end_px", "direction"), [(2.0, Direction.APPROACHING), (8.0, Direction.RECEDING)])
def test_a_picture_that_shakes_tells_the_direction(seed: int, end_px: float, direction: Direction) -> None:
    images = [scene(float(blur), int(at)) for blur, at in zip(np.linspace(4.5, end_px, 30), path(seed), strict=True)]
    assert judged(Bearing(unrest(seed + 10), MARGIN), images) is direction


@pytest.mark.parametrize("seed", range(4))
def test_shaking_alone_is_no_direction(seed: int) -> None:
    images = [scene(4.5, int(at)) for at in path(seed)]
    assert judged(Bearing(unrest(seed + 10), MARGIN), images) is Direction.UNKNOWN


def test_motion_that_was_listened_to_for_long_does_no_more_however_far_it_goes() -> None:
    known = unrest()
    near, far = known.moved(np.array([1.0, 40.0]), np.array([1.0, 1.0]))
    assert near < far == pytest.approx(known.per_px * BAND_PX)
    soon, late, later = known.moved(np.zeros(3), np.array([1.0, known.longest_ms, 1e6]))
    assert soon < late == later
    assert known.longest_ms == pytest.approx(11.0)


def test_what_the_image_lacks_of_a_picture_is_added() -> None:
    start = scene(4.5)
    images = [scene(float(blur), k // 2) - start for k, blur in enumerate(np.linspace(4.5, 8.0, 30))]
    assert judged(Bearing(unrest(), MARGIN, start), images) is Direction.RECEDING


def test_more_unrest_needs_more_change() -> None:
    images = [scene(4.5) * np.float32(np.exp(-0.5 * fall)) for fall in np.linspace(0.0, 0.1, 12)]
    assert judged(Bearing(Unrest(0.0, 0.005), MARGIN), images) is Direction.RECEDING
    assert judged(Bearing(Unrest(0.0, 0.05), MARGIN), images) is Direction.UNKNOWN


def test_a_change_that_events_make_by_chance_is_no_direction() -> None:
    rng = np.random.default_rng(4)
    image, images = scene(4.5), []
    for _ in range(20):
        image = image + rng.integers(-1, 2, size=image.shape).astype(np.float32)
        images.append(image)
    assert judged(Bearing(Unrest(0.0, 0.0), MARGIN), images[:3]) is Direction.UNKNOWN


def test_a_verdict_stands() -> None:
    images = [scene(blur) for blur in (4.5, 4.0, 3.0, 2.0, 4.0, 6.0, 9.0)]
    assert judged(Bearing(Unrest(0.01, 0.01), MARGIN), images) is Direction.APPROACHING


def test_after_a_reversal_the_same_fall_is_not_enough() -> None:
    images = [scene(4.5) * np.float32(np.exp(-0.5 * fall)) for fall in np.linspace(0.0, 0.12, 12)]
    first, again = (Bearing(Unrest(0.0, 0.01), MARGIN, again=again) for again in (False, True))
    assert judged(first, images) is Direction.RECEDING
    assert judged(again, images) is Direction.UNKNOWN


def test_too_few_stills_tell_nothing_of_unrest() -> None:
    assert Unrest.of([(1000 * k, scene(4.5)) for k in range(3)], MARGIN) is None


def test_the_scenes_travel_is_measured_from_look_to_look() -> None:
    gauge = Gauge(MARGIN)
    looks = [gauge.look(scene(4.5, shift), 1000 * shift) for shift in range(7)]
    assert looks[-1].x_px == pytest.approx(-6.0, rel=0.25)  # in proportion: rest and sweep alike
    assert looks[-1].y_px == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize("seed", range(5))
def test_a_picture_is_found_where_events_show_its_gradient(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x_px, y_px = (int(one) for one in rng.integers(-8, 9, size=2))
    picture = scene(4.5, seed=seed) / np.float32(2.0)
    before, after = (moved(picture, x_px + part, y_px + part) for part in (-0.5, 0.5))
    change = np.rint(after - before + rng.uniform(-0.5, 0.5, picture.shape)).astype(np.float32)
    found = displacement_px(picture, change)
    assert found == pytest.approx((x_px, y_px), abs=2.0)


def test_a_picture_that_is_too_sharp_is_blurred_to_what_moves() -> None:
    sharp = scene(1.0) / np.float32(4.0)
    soft = cv2.GaussianBlur(sharp, (0, 0), 3.0)
    change = np.asarray(moved(soft, 2.5, 0.0) - moved(soft, 1.5, 0.0), np.float32)
    inside = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    now = moved(soft, 2.0, 0.0)[inside]
    assert np.std(laid_on(sharp, change)[inside] - now) < 0.3 * np.std(sharp[inside] - now)


def test_without_events_a_picture_is_where_it_was() -> None:
    assert displacement_px(scene(4.5), np.zeros((SIZE, SIZE), np.float32)) == (0.0, 0.0)
    noise = np.random.default_rng(2).integers(-1, 2, size=(SIZE, SIZE)).astype(np.float32)
    assert np.hypot(*displacement_px(scene(4.5), noise)) < 5.0


def rested(events: EventArrays, *frames: Frame, picture: NDArray[np.float32] | None = None) -> Resting:
    resting = Resting(ROI, GEOMETRY, None if picture is None else lambda: picture)
    resting.add(*events, None)
    resting.see(frames)
    resting.settle(np.zeros((SIZE, SIZE), np.int16))
    return resting


def levels_of(events: EventArrays, start: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    levels = np.zeros((SIZE, SIZE), np.float32) if start is None else start.copy()
    np.add.at(levels, (events.y, events.x), np.where(events.p > 0, 1.0, -1.0).astype(np.float32))
    return levels


def test_independent_events_are_no_motion_and_an_edge_that_moves_is() -> None:
    assert not rested(events_at(1, 600)).moves
    assert rested(events_at(1, 600)).image_at_start is None
    assert rested(events_at(1, 600, (scene(3.0) > 0).astype(np.uint8))).moves


def test_a_pixel_that_fires_alone_is_no_motion() -> None:
    levels = np.zeros((SIZE, SIZE), np.float32)
    levels[40, 40] = 200.0
    assert order(levels) < 4.0


def test_the_order_of_noise_scatters_by_its_own_standard_deviation() -> None:
    orders = [order(levels_of(events_at(seed, 1500))) for seed in range(60)]
    assert abs(np.mean(orders)) < 0.5
    assert 0.5 < np.std(orders) < 1.5


def test_a_patch_is_what_white_noise_varies_over() -> None:
    rng = np.random.default_rng(1)
    weight = np.ones((128, 128), np.float32)
    energies = [band_energy(rng.standard_normal((128, 128)).astype(np.float32), 2.4, weight) for _ in range(80)]
    assert np.mean(energies) == pytest.approx(band_gain(2.4), rel=0.05)
    expected = np.sqrt(2.0 * band_patch(2.4) / weight.size)
    assert np.std(energies) / np.mean(energies) == pytest.approx(expected, rel=0.3)


def test_an_image_goes_on_where_the_one_before_left_off() -> None:
    first, whole = EventMemory(ROI, GEOMETRY), EventMemory(ROI, GEOMETRY)
    events = events_at(2, 900)
    parts = [
        EventArrays(events.t[part], events.x[part], events.y[part], events.p[part])
        for part in (slice(0, 300), slice(300, 500), slice(500, 900))
    ]
    first.add(*parts[0])
    first.advance(3_000, 0.0)
    first.add(*parts[1])  # not in the curve any more, and yet in the image
    second = EventMemory(ROI, GEOMETRY, start=first.built())
    second.add(*parts[2])
    second.advance(1_000_000, 1.0)
    whole.add(*events)
    whole.advance(1_000_000, 1.0)
    np.testing.assert_array_equal(second.image, whole.image)
    assert second.built().events == whole.built().events == 900
    assert second.track.values[-1] == pytest.approx(whole.track.values[-1], abs=1e-4)


def test_what_was_seen_since_a_frame_is_built_upon_it() -> None:
    events = events_at(4, 700, (scene(3.0) > 0).astype(np.uint8))
    pixels = np.clip(100 + 10 * scene(2.0, seed=8), 0, 255).astype(np.uint8)
    when = SensorUs(int(events.t[300]))
    start = rested(events, Frame(when, when, 0, pixels)).image_at_start
    assert start is not None
    assert start.events == 400
    since = EventArrays(events.t[300:], events.x[300:], events.y[300:], events.p[300:])
    np.testing.assert_allclose(start.levels, levels_of(since, frame_levels(pixels)), atol=1e-4)


def test_a_sensor_without_frames_builds_beside_its_first_picture() -> None:
    events = events_at(4, 700, (scene(3.0) > 0).astype(np.uint8))
    picture = scene(4.5, seed=8)
    resting = rested(events, picture=picture)
    assert resting.image_at_start is not None
    np.testing.assert_array_equal(resting.image_at_start.levels, levels_of(events))
    assert resting.beneath is not None
    assert resting.unrest is not None
    alone = rested(events)
    assert alone.beneath is None
    assert alone.unrest is None  # nothing shows a direction but the product


def test_a_region_that_goes_with_its_scene_sees_the_same_sharpness() -> None:
    picture = np.random.default_rng(6).standard_normal((160, 160)).astype(np.float32)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.5)
    picture[:, 70:] *= 4.0  # busier on one side: a region that stands still would take the shift for focus
    frames = [np.clip(120 + 100 * picture[20:116, 20 + k : 116 + k], 0, 255).astype(np.uint8) for k in range(0, 10, 2)]
    roi = Roi(32, 32, 32, 32)
    follows, stands = FrameEnergy(roi, 14, follow=True), FrameEnergy(roi, 14)
    followed = [follows.measure(frame).bands for frame in frames]
    stood = [stands.measure(frame).bands for frame in frames]
    assert (np.ptp(followed, axis=0) < 0.5 * np.ptp(stood, axis=0)).all()


def test_bright_parts_that_move_are_as_sharp_elsewhere() -> None:
    rng = np.random.default_rng(7)
    picture = 60.0 * np.exp(0.2 * cv2.GaussianBlur(rng.standard_normal((96, 96)), (0, 0), 1.0) / 0.28)
    picture[:, 12:40] *= 3.0
    picture[:, 40:] = cv2.GaussianBlur(picture[:, 40:], (0, 0), 4.0)  # dark parts have less structure
    energy = FrameEnergy(Roi(0, 0, 96, 96), 0)
    still, moved = (energy.measure(np.roll(picture, k, axis=1).clip(0, 255).astype(np.uint8)).bands for k in (0, 30))
    np.testing.assert_allclose(moved, still, atol=0.03)  # whatever lies under where bright parts were at first
