"""Defocus: a natural scene blurred by how far the lens is from focus, fast enough to follow a moving lens.

Blur is Gaussian with sigma² = sigma0² + (k·dz)²·T; sigma0 = 0.35 px stands for pixel and aberrations, k for the lens
(0.0233 px per um where the depth of focus is 6 um, in inverse proportion otherwise), and the last factor because the
blur circle scales with the diameter of the aperture, the square root of its transmittance. A ladder of blurred *log*
images, made one from the other on first use, is interpolated linearly in sigma², in which diffusion is linear: with
steps of 20 % the error is below 0.2 % of the contrast, a hundredth of a contrast threshold. Motion of the scene is
a shift by Catmull-Rom interpolation; bilinear would blur with the sub-pixel phase and look like focusing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from elpd.events.jit import kernel
from elpd.records import Roi

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd_drivers.sim.aperture import Opening
    from elpd_drivers.sim.motion import SceneMotion

LAMP_SHAPES = ("sine", "pwm")
SIGMA0_PX = 0.35
BLUR_PX_PER_DEPTH = 0.0233 * 6.0
"""Blur in px at one depth of focus from focus (0.0233 px/um at a depth of focus of 6 um)."""

DARK = 0.01
"""Dark current of the photoreceptor in units of the brightest pixel's photocurrent.

It sets when a pixel first fires behind an opening aperture: at I·T = DARK·(e^C - 1). With this value the brightest
pixels of a scene fire after 5 % of an iris's opening and the darkest just before its end, as in the real recording
`evk4_aperture_opening.raw`."""

FINE_RATIO = 1.2
COARSE_RATIO = 1.5
FINE_UP_TO_PX2 = 25.0
LARGEST_BLUR_PX2 = 576.0

TRAVEL_PER_STEP_UM = 2.0
CACHED_PIXELS = 1 << 16
STEPS_WHILE_LIGHT_CHANGES_FAST = 2
LIGHT_CHANGE_PER_STEP = 0.15
MOST_STEPS = 4


@kernel("void(float32[:,::1], float32[:,::1], float32, int64, int64, float32, float32, float32[::1], float32[:,::1])")
def blend_shifted(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    weight: np.float32,
    row: int,
    column: int,
    part_y: np.float32,
    part_x: np.float32,
    scratch: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write ``(1-weight)·a + weight·b``, cut at (row + part_y, column + part_x), into *out*.

    The fractions lie in [0, 1); unless both are 0, the interpolation is Catmull-Rom and needs one row and column
    before the cut and two after it. *scratch* holds at least ``out.shape[1] + 3`` numbers.
    """
    height, width = out.shape
    if part_y == np.float32(0) and part_x == np.float32(0):
        for y in range(height):
            sharp, soft = a[row + y, column : column + width], b[row + y, column : column + width]
            line = out[y]
            for x in range(width):
                line[x] = sharp[x] + weight * (soft[x] - sharp[x])
        return
    half = np.float32(0.5)
    f, g = part_y, part_x
    y0 = half * f * (f * (np.float32(2) - f) - np.float32(1))
    y1 = half * (f * f * (np.float32(3) * f - np.float32(5)) + np.float32(2))
    y2 = half * f * (f * (np.float32(4) - np.float32(3) * f) + np.float32(1))
    y3 = half * f * f * (f - np.float32(1))
    x0 = half * g * (g * (np.float32(2) - g) - np.float32(1))
    x1 = half * (g * g * (np.float32(3) * g - np.float32(5)) + np.float32(2))
    x2 = half * g * (g * (np.float32(4) - np.float32(3) * g) + np.float32(1))
    x3 = half * g * g * (g - np.float32(1))
    keep = np.float32(1) - weight
    first, last = column - 1, column + width + 2
    for y in range(height):
        r = row + y
        a0, a1, a2, a3 = a[r - 1, first:last], a[r, first:last], a[r + 1, first:last], a[r + 2, first:last]
        b0, b1, b2, b3 = b[r - 1, first:last], b[r, first:last], b[r + 1, first:last], b[r + 2, first:last]
        line = out[y]
        for x in range(width + 3):
            sharp = y0 * a0[x] + y1 * a1[x] + y2 * a2[x] + y3 * a3[x]
            soft = y0 * b0[x] + y1 * b1[x] + y2 * b2[x] + y3 * b3[x]
            scratch[x] = keep * sharp + weight * soft
        for x in range(width):
            line[x] = x0 * scratch[x] + x1 * scratch[x + 1] + x2 * scratch[x + 2] + x3 * scratch[x + 3]


def blur_ladder() -> NDArray[np.float64]:
    """Return the blurs, as sigma² in px², at which images are kept."""
    steps = [SIGMA0_PX**2]
    while steps[-1] < LARGEST_BLUR_PX2:
        steps.append(steps[-1] * (FINE_RATIO if steps[-1] < FINE_UP_TO_PX2 else COARSE_RATIO))
    return np.array(steps)


class DefocusStack:
    """Log images of one scene at the ladder's blurs, made when first asked for.

    Parameters
    ----------
    linear
        (height, width) float32, linear intensity including the margin.
    brightness
        Scales the photocurrent against the dark current.
    """

    def __init__(self, linear: NDArray[np.float32], brightness: float) -> None:
        self.ladder_px2 = blur_ladder()
        self._brightness = brightness
        self._widest = _spread(linear, float(self.ladder_px2[0]))
        self._logs = [self._log(self._widest)]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the images, margin included."""
        height, width = self._widest.shape
        return height, width

    def bracket(self, sigma2_px2: float) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        """Return the log images around a blur and the weight of the second. Clamped at the ladder's ends."""
        index = int(np.searchsorted(self.ladder_px2, sigma2_px2, side="right")) - 1
        index = min(max(index, 0), len(self.ladder_px2) - 2)
        below, above = self.ladder_px2[index : index + 2]
        weight = min(max((sigma2_px2 - below) / (above - below), 0.0), 1.0)
        return self._level(index), self._level(index + 1), float(weight)

    def _level(self, index: int) -> NDArray[np.float32]:
        while len(self._logs) <= index:
            done = len(self._logs)
            self._widest = _spread(self._widest, float(self.ladder_px2[done] - self.ladder_px2[done - 1]))
            self._logs.append(self._log(self._widest))
        return self._logs[index]

    def _log(self, linear: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(np.log(linear * np.float32(self._brightness) + np.float32(DARK)), np.float32)


def _spread(image: NDArray[np.float32], variance_px2: float) -> NDArray[np.float32]:
    """Blur by exactly *variance_px2*: a sampled Gaussian is too narrow below about half a pixel, three taps are not."""
    if variance_px2 > 0.5:
        blurred = cv2.GaussianBlur(image, (0, 0), variance_px2**0.5, borderType=cv2.BORDER_REFLECT)
    else:
        taps = np.array([variance_px2 / 2, 1 - variance_px2, variance_px2 / 2])
        blurred = cv2.sepFilter2D(image, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, np.float32)


class LayerCondition(NamedTuple):
    """Blur and place of one layer at one instant."""

    sigma2_px2: float
    shift_x_px: float
    shift_y_px: float


class Condition(NamedTuple):
    """All that the picture on the sensor depends on, at one instant. Equal conditions give equal pictures."""

    sigma2_px2: float
    shift_x_px: float
    shift_y_px: float
    light: float
    layers: tuple[LayerCondition, ...] = ()
    magnification: float = 1.0


@dataclass(frozen=True, slots=True)
class Layer:
    """A rectangle of another picture before the scene: at another depth, or moving by itself.

    ``box`` is (x, y, width, height) in pixels of the sensor while nothing moves. The picture moves with its box.
    """

    stack: DefocusStack
    box: tuple[int, int, int, int]
    focus_offset_um: float = 0.0
    velocity_px_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp that varies by ± ``depth`` at ``hz``: a sine, or ``pwm`` (on and off, half of the time each)."""

    hz: float = 0.0
    depth: float = 0.1
    shape: str = "sine"

    def light(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return its light at the given instants, relative to its mean."""
        if self.hz <= 0:
            return np.ones(len(times_ns))
        wave = np.sin(2e-9 * np.pi * self.hz * times_ns)
        return 1 + self.depth * (np.where(wave >= 0, 1.0, -1.0) if self.shape == "pwm" else wave)


class LightField:
    """The log photocurrent of every pixel, as lens, aperture, scene and lamp have it.

    Parameters
    ----------
    carriage_um
        Where the lens carriage was at the given host instants (int64 ns -> float64 um).
    focus_um
        The carriage position of true focus.
    margin_px
        How much larger the stack's images are than the sensor, on each side.
    lamp
        What lights the scene.
    cap
        The lens cap is on.
    layers
        What stands before the scene, each on top of those before it.
    breathing_per_mm
        Relative change of the magnification with the lens's travel away from focus.
    """

    def __init__(
        self,
        stack: DefocusStack,
        carriage_um: Callable[[NDArray[np.int64]], NDArray[np.float64]],
        focus_um: float,
        motion: SceneMotion,
        *,
        aperture: Opening | None,
        depth_of_focus_um: float,
        margin_px: int,
        lamp: Lamp | None = None,
        cap: bool = False,
        layers: tuple[Layer, ...] = (),
        breathing_per_mm: float = 0.0,
    ) -> None:
        self._stack = stack
        self._carriage_um = carriage_um
        self._focus_um = focus_um
        self._motion = motion
        self._aperture = aperture
        self._px_per_um = BLUR_PX_PER_DEPTH / depth_of_focus_um
        self._margin_px = margin_px
        height, width = stack.shape
        self._centre_px = (width / 2 - margin_px, height / 2 - margin_px)
        self._lamp = lamp or Lamp()
        self._cap = cap
        self._layers = layers
        self._breathing_per_um = 1e-3 * breathing_per_mm

    def conditions(self, times_ns: NDArray[np.int64]) -> list[Condition]:
        """Return what holds at each of the given instants."""
        light = np.ones(len(times_ns)) if self._aperture is None else self._aperture.transmittance_at(times_ns)
        lit = np.zeros_like(light) if self._cap else light * self._lamp.light(times_ns)
        places = self._carriage_um(times_ns) - self._focus_um
        return [
            self._condition(int(t), float(um), float(open_), float(q))
            for t, um, open_, q in zip(times_ns, places, light, lit, strict=True)
        ]

    def wide_open(self, when_ns: int) -> Condition:
        """Return what holds at an instant behind a fully open aperture, under a lamp that does not flicker."""
        carriage_um = float(self._carriage_um(np.array([when_ns], np.int64))[0])
        return self._condition(when_ns, carriage_um - self._focus_um, 1.0, 0.0 if self._cap else 1.0)

    def _condition(self, when_ns: int, defocus_um: float, transmittance: float, light: float) -> Condition:
        shift_x_px, shift_y_px = self._motion.displacement_px(when_ns / 1e3)

        def sigma2_px2(offset_um: float) -> float:
            return float(SIGMA0_PX**2 + (self._px_per_um * (defocus_um - offset_um)) ** 2 * transmittance)

        layers = tuple(
            LayerCondition(sigma2_px2(one.focus_offset_um), shift_x_px + 1e-9 * when_ns * one.velocity_px_s, shift_y_px)
            for one in self._layers
        )
        magnification = 1.0 + self._breathing_per_um * defocus_um
        return Condition(sigma2_px2(0.0), shift_x_px, shift_y_px, light, layers, magnification)

    def steps_needed(self, conditions: list[Condition]) -> int:
        """Say into how many pieces the time spanned by *conditions* must be cut for the picture to change evenly."""
        lights = [condition.light for condition in conditions]
        if max(lights) != min(lights):
            fast = max(lights) - min(lights) > LIGHT_CHANGE_PER_STEP * max(lights)
            return STEPS_WHILE_LIGHT_CHANGES_FAST if fast else 1
        defocus = [max(condition.sigma2_px2 - SIGMA0_PX**2, 0.0) ** 0.5 for condition in conditions]
        travel_um = sum(abs(after - before) for before, after in pairwise(defocus))
        travel_um /= self._px_per_um
        return next((n for n in (1, 2) if travel_um <= n * TRAVEL_PER_STEP_UM * 1.05), MOST_STEPS)

    def render(self, condition: Condition, window: Roi, out: NDArray[np.float32]) -> None:
        """Write the log photocurrent of *window*'s pixels, (height, width) float32 in C order, into *out*."""
        if condition.light <= 0:
            out.fill(np.log(DARK))
            return
        self._lay(self._stack, LayerCondition(*condition[:3]), window, out)
        for layer, place in zip(self._layers, condition.layers, strict=True):
            self._stand_before(layer, place, window, out)
        if condition.magnification != 1.0:
            _magnify(out, condition.magnification, window, self._centre_px)
        if condition.light != 1.0:
            for rows in np.array_split(out, max(1, out.size // CACHED_PIXELS)):
                np.exp(rows, out=rows)
                rows *= np.float32(condition.light)
                rows += np.float32(DARK * (1 - condition.light))
                np.log(rows, out=rows)

    def _lay(self, stack: DefocusStack, place: LayerCondition, window: Roi, out: NDArray[np.float32]) -> None:
        a, b, weight = stack.bracket(place.sigma2_px2)
        top = self._margin_px + window.y - place.shift_y_px
        left = self._margin_px + window.x - place.shift_x_px
        row, column = int(np.floor(top)), int(np.floor(left))
        scratch = np.empty(window.width + 3, np.float32)
        blend_shifted(
            a, b, np.float32(weight), row, column, np.float32(top - row), np.float32(left - column), scratch, out
        )

    def _stand_before(self, layer: Layer, place: LayerCondition, window: Roi, out: NDArray[np.float32]) -> None:
        """Cover what the layer's box covers; a box that moves comes back on the other side."""
        x, y, width, height = layer.box
        drift_px, part_px = 0, place.shift_x_px  # what stands still is a window onto a picture that may shake
        if layer.velocity_px_s:
            shift_px = (x + width + place.shift_x_px) % (2 * self._centre_px[0] + width) - width - x
            drift_px, part_px = round(shift_px), shift_px - round(shift_px)
        left, top = max(x + drift_px, window.x), max(y, window.y)
        right = min(x + drift_px + width, window.x + window.width)
        bottom = min(y + height, window.y + window.height)
        if left >= right or top >= bottom:
            return
        picture = np.empty((bottom - top, right - left), np.float32)
        # The picture goes with the box, so the cut in it is where the box would be without the drift.
        cut = Roi(left - drift_px, top, right - left, bottom - top)
        self._lay(layer.stack, place._replace(shift_x_px=part_px), cut, picture)
        out[top - window.y : bottom - window.y, left - window.x : right - window.x] = picture


def _magnify(out: NDArray[np.float32], magnification: float, window: Roi, centre_px: tuple[float, float]) -> None:
    """Enlarge the picture about the sensor's centre, in place; what comes from outside the window is its border."""
    x, y = centre_px[0] - window.x, centre_px[1] - window.y
    affine = np.array([[magnification, 0.0, x * (1 - magnification)], [0.0, magnification, y * (1 - magnification)]])
    size = (out.shape[1], out.shape[0])
    out[:] = cv2.warpAffine(out, affine, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
