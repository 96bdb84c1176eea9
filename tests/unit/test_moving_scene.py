"""What events are asked where the scene is seen to move, and what they are not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from benchmarks.retina import Retina, RetinaSettings
from sweep_world import picture

from elpd.vision import crossing
from elpd.vision.bands import BandFocus, average_focus, focus_of_bands
from elpd.vision.crossing import ask_events
from elpd.vision.integral import BANDS_PX
from elpd.vision.pairs import Mode
from elpd.vision.rebuilt import EventStretch, by_pixel, rebuilt
from elpd.vision.refractory import Refractory
from elpd.vision.witness import LOSSES_UNEXPLAINED

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd.vision.witness import EventWitnesses

MARGIN = 14
STEPS = 160
FOCUS, BEGIN, END = 80.0, 45.0, 110.0
"""Positions: of focus, of where the curve's flank begins, of the end."""
THRESHOLD = 0.15


def events_of(levels: NDArray[np.float64]) -> EventStretch:
    """Return what threshold pixels send that see *levels*, (steps, height, width), in log intensity; one per step."""
    rng = np.random.default_rng(5)
    _, height, width = levels.shape
    known = levels[0] + THRESHOLD * rng.uniform(-1.0, 1.0, (height, width))
    columns = []
    for k in range(1, len(levels)):
        change = levels[k] - known
        y, x = np.nonzero(np.abs(change) >= THRESHOLD)
        up = change[y, x] > 0.0
        known[y, x] += np.where(up, THRESHOLD, -THRESHOLD)
        run = levels[k][y, x] - levels[k - 1][y, x]
        part = np.clip((known[y, x] - levels[k - 1][y, x]) / np.where(run == 0.0, 1.0, run), 0.0, 0.99)
        order = np.argsort(part, kind="stable")
        columns.append((k - 1 + part[order], x[order], y[order], up[order]))
    position, x, y, on = (np.concatenate(one) for one in zip(*columns, strict=True))
    t_us = (1000.0 * position).astype(np.int64)
    pixels = x.astype(np.uint16), y.astype(np.uint16), on.astype(np.uint8)
    return EventStretch(t_us, *pixels, position, height, width, MARGIN)


def seen(blur_px: Callable[[float], float], aside_px: Callable[[float], float], size: int = 96) -> NDArray[np.float64]:
    """Return the log intensity of a picture under a blur and a displacement to the right that follow the position."""
    light = picture(size + 40, 3)
    levels = []
    for k in range(STEPS):
        blurred = cv2.GaussianBlur(light, (0, 0), blur_px(float(k)), borderType=cv2.BORDER_REFLECT_101)
        moved = cv2.warpAffine(blurred, np.float64([[1, 0, aside_px(float(k))], [0, 1, 0]]), blurred.shape[::-1])
        levels.append(np.log(moved[20:-20, 20:-20] + 2.0))
    return np.array(levels)


def defocus(at: float) -> float:
    return float(np.hypot(0.4, 0.035 * (at - FOCUS)))


def wandering(at: float) -> float:
    return 3.0 * float(np.sin(0.05 * at)) + 0.02 * at


def still(_at: float) -> float:
    return 0.0


def asked(levels: NDArray[np.float64], **options: float) -> EventWitnesses:
    events = events_of(levels)
    before = events.position < END
    events = EventStretch(
        *(column[before] for column in (events.t_us, events.x, events.y, events.on, events.position)),
        events.height,
        events.width,
        MARGIN,
    )
    light = np.exp(levels[0]) - 2.0
    bright = np.asarray(light / np.percentile(light, 99.5), dtype=np.float32)
    return ask_events(events, BEGIN, FOCUS, END, bright, 0.5, bright, **options)


def test_a_scene_that_moves_is_asked_for_the_finest_band_alone_and_not_for_the_lag(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    departures: list[float] = []

    def average(candidates: list[BandFocus]) -> BandFocus:
        departures.append(max(abs(one.departure) for one in candidates))
        return average_focus(candidates)

    monkeypatch.setattr(crossing, "average_focus", average)
    at_rest, in_motion = asked(seen(defocus, still)), asked(seen(defocus, wandering))
    assert not at_rest.drift.seen
    assert in_motion.drift.seen
    assert at_rest.image is not None
    assert in_motion.image is not None
    # Nothing is drawn out to coarse bands, where the ghost of the start picture is.
    assert departures[1] < 1e-6 < departures[0]
    assert in_motion.lag == in_motion.expected_lag
    assert at_rest.lag != at_rest.expected_lag
    for found in (at_rest, in_motion):
        assert found.image.at + found.lag.at == pytest.approx(FOCUS, abs=0.25 * found.image.finest.width)


def test_a_sharp_picture_that_goes_aside_and_comes_back_is_no_focus() -> None:
    levels = seen(lambda _: 0.6, lambda at: 3.0 * float(np.exp(-0.5 * ((at - FOCUS) / 26.0) ** 2)))
    events = events_of(levels)
    found = ask_events(events, BEGIN, FOCUS, END)
    assert found.drift.seen
    assert found.image is None


def test_blur_takes_fine_structure_first() -> None:
    position = np.linspace(-60.0, 60.0, 61)

    def curves(*widths: float) -> NDArray[np.float64]:
        return np.stack([-(position**2) / (2.0 * width**2) for width in widths], axis=1)

    blur, aside = (
        focus_of_bands(position, curves(40, 48, 60, 80), 50.0),
        focus_of_bands(position, curves(40, 38, 38, 40), 50.0),
    )
    assert blur is not None
    assert blur.as_blur
    assert blur.mirrored(-1.0).as_blur
    assert aside is not None
    assert not aside.as_blur
    assert len(BANDS_PX) == 4


def test_planes_are_not_believed_in_a_scene_that_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    two = [Mode(60.0, 0.5, 100.0, 0.9), Mode(95.0, 0.5, 100.0, 0.9)]
    monkeypatch.setattr(crossing, "find_planes", lambda *_: two)
    assert asked(seen(defocus, still)).depths == (60.0, 95.0)
    moving = asked(seen(defocus, wandering))
    assert moving.depths == ()
    assert moving.image is not None


def test_a_lens_that_waits_gets_a_coarser_curve_of_a_large_region() -> None:
    levels = seen(defocus, still, size=160)
    soon, late = (asked(levels, hurried=one) for one in (True, False))
    assert soon.image is not None
    assert late.image is not None
    assert late.image.finest.points > 1.5 * soon.image.finest.points
    assert soon.image.at == pytest.approx(late.image.at, abs=0.05 * late.image.finest.width)


def test_silence_tells_nothing_of_pixels_in_a_scene_that_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [seen(defocus, still), seen(defocus, wandering)]
    at_rest, in_motion = (asked(one).image for one in scenes)
    monkeypatch.setattr(crossing, "hush", lambda images, *_: images.fill(0.0))
    at_rest_deaf, in_motion_deaf = (asked(one).image for one in scenes)
    assert at_rest_deaf != at_rest, "silent pixels have not come back: what they did is taken out"
    assert in_motion_deaf.finest == in_motion.finest


def shaken_and_deaf(levels: NDArray[np.float64], deaf_us: float, threshold: float = THRESHOLD) -> EventStretch:
    """Return what pixels send that are deaf after each event, a millisecond to a step."""
    light = (60.0 * np.exp(levels - levels.mean())).astype(np.float32)
    settings = RetinaSettings(threshold, threshold, 0.0, 1e6, 0.0, 0.0, 1e-6 * deaf_us, settled=True)
    retina = Retina(settings, light[0], 0, 1000 * STEPS, np.random.default_rng(4))
    for k in range(1, STEPS):
        retina.see(light[k], 1000.0 * k)
    events = retina.events()
    columns = events.t_us, events.x, events.y, events.on
    position = (events.t_us + deaf_us) / 1000.0
    return EventStretch(*columns, position, *light[0].shape, MARGIN, deaf=Refractory(deaf_us, 0.1 * deaf_us))


def test_what_deaf_pixels_lose_of_a_scene_that_shakes_is_put_back() -> None:
    levels = seen(defocus, lambda at: 4.0 * float(np.sin(0.07 * at)))
    events = shaken_and_deaf(levels, 500.0, 0.03)
    ticks = np.arange(20.0, 140.0, 10.0)
    truth = (levels[ticks.astype(int)] - levels[0]) / 0.03
    whole, heard = (rebuilt(one, by_pixel(one), ticks) - truth for one in (events, events.as_heard()))
    assert np.sqrt(np.mean(np.square(heard))) > 1.5, "thresholds are missing"
    assert np.mean(np.square(whole)) < 0.3 * np.mean(np.square(heard))


def test_how_far_focus_goes_by_that_is_told_and_doubted() -> None:
    levels = seen(defocus, lambda at: 2.5 * float(np.sin(0.05 * at)))
    events = shaken_and_deaf(levels, 500.0)
    before = events.position < END
    columns = (one[before] for one in (events.t_us, events.x, events.y, events.on, events.position))
    events = EventStretch(*columns, events.height, events.width, MARGIN, deaf=events.deaf)
    found, heard = ask_events(events, BEGIN, FOCUS, END), ask_events(events.as_heard(), BEGIN, FOCUS, END)
    assert found.drift.seen
    assert found.image is not None
    assert heard.image is not None
    assert found.put_back == pytest.approx(found.image.at - heard.image.at)
    vertex, unheard = found.vertex(), heard.vertex()
    assert vertex is not None
    assert unheard is not None
    assert unheard.lost == 0.0
    assert vertex.lost == pytest.approx(found.put_back * np.hypot(0.1, LOSSES_UNEXPLAINED))
    longer = vertex.if_deaf_for(Refractory(600.0, 0.0))
    assert longer.at - vertex.at == pytest.approx(0.2 * found.put_back)
    back = vertex.on_the_way_back(0.0, 0.0)
    assert back.if_deaf_for(Refractory(600.0, 0.0)).at == pytest.approx(-longer.at)
    assert back.lost == -vertex.lost
