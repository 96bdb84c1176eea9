"""The published method, as its authors' released code really behaves, for comparison.

Bao et al., "One-Step Event-Driven High-Speed Autofocus" (CVPR 2025), and the repository YuHanBaozju/ELP. Where text
and code differ, the code is followed, because its numbers are the published ones; what the text says
instead is ``filter_of_the_paper``. In particular

- the reference is a 3x3 median of the 8-bit frame under the 4-neighbour Laplacian, cut to the ROI;
- bins are closed at both ends (an event on an edge counts twice), restart at each frame, and count events per pixel in
  eight bits, which wrap;
- synthetic and DAVIS bins are divided by their number of events, those outside the ROI included; EVK4's are raw sums;
- the filter's threshold of 5·10⁴ is out of reach of normalised values, which leaves an exponential mean of 0.4;
- a fixed threshold per data set triggers; the answer is then *looked back for* at the last sign change and moved
  earlier by a constant tuned per data set;
- in the synthetic set it may be overwritten until the next frame, in the EVK4 set until the recording ends: hindsight.

So ``decided_us`` of this method is when the answer was last written, which is honest, and long after ``focus_us``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.reference import full_scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from elpd.records import Roi

FILTER_WINDOW = 10
FILTER_SHARE = 0.4
FILTER_THRESHOLD = 5e4


@dataclass(frozen=True, slots=True)
class Constants:
    """What the authors set per data set.

    The rule is ``max - min > swing and min < floor`` of the filtered values so far, or, where ``recent`` is not zero,
    ``min(last recent) < floor and max(all before) > swing``.
    """

    name: str
    bin_us: int
    swing: float
    floor: float
    recent: int
    normalised: bool
    fewest_events: int
    whole_sensor: bool
    back_to_positive: bool
    back_bins: int
    back_us: int
    skip_us: int
    overwrites_until: str


SYNTHETIC_MANY_FRAMES = Constants(
    "synthetic, 20 and 50 fps", 2000, 10.0, -8.0, 0, True, 1, True, True, 2, 5000, 0, "the next frame"
)
SYNTHETIC_ONE_FRAME = Constants(
    "synthetic, 1 fps", 2000, 5.0, -2.0, 0, True, 1, True, True, 2, 5000, 100_000, "the first detection"
)
EVK4 = Constants("EVK4", 1000, 50.0, -500.0, 5, False, 10, False, False, 2, 0, 0, "the end of the recording")


@dataclass(frozen=True, slots=True)
class PaperResult:
    """What the method said; times in microseconds, ``None`` where it said nothing."""

    focus_us: int | None
    crossing_us: int | None
    decided_us: int | None
    first_sign: float
    first_us: int | None
    bins: int


def paper_laplacian(pixels: NDArray[np.generic], roi: Roi) -> NDArray[np.float32]:
    """Return the weight table of the released code: (height, width), zero outside the ROI."""
    image = np.asarray(pixels)
    if image.dtype != np.uint8:
        top = full_scale(image) or 1.0
        image = np.clip(np.rint(image.astype(np.float64) * (255.0 / top)), 0, 255).astype(np.uint8)
    filtered = cv2.Laplacian(cv2.medianBlur(np.ascontiguousarray(image), 3), cv2.CV_32F)
    table = np.zeros(filtered.shape, dtype=np.float32)
    inside = (slice(roi.y, roi.y + roi.height), slice(roi.x, roi.x + roi.width))
    table[inside] = filtered[inside]
    return table


def filter_of_the_code(raw: Sequence[float], previous: float | None) -> float:
    """Filter the newest of *raw* as the released code does: mixed with its own *previous* output."""
    now = raw[-1]
    if previous is None:
        return now
    if abs(now - float(np.mean(raw[-FILTER_WINDOW:]))) > FILTER_THRESHOLD:
        return now
    return FILTER_SHARE * now + (1.0 - FILTER_SHARE) * previous


def filter_of_the_paper(raw: Sequence[float], share: float, threshold: float) -> float:
    """Filter the newest of *raw* as the text says: mixed with the mean of the window, unless it jumps."""
    now = raw[-1]
    mean = float(np.mean(raw[-FILTER_WINDOW:]))
    return share * now + (1.0 - share) * mean if abs(now - mean) < threshold else now


class PaperDetector:
    """The released code's loop: give it bins in order, ask for the answer at the end."""

    def __init__(self, constants: Constants, bin_us: int | None = None) -> None:
        self._constants = constants
        self.bin_us = bin_us or constants.bin_us
        self._raw: list[float] = []
        self._filtered: list[float] = []
        self._begins_us: list[int] = []
        self._answer: tuple[int, int, int] | None = None
        self._high = float("-inf")
        self._low = float("inf")

    @property
    def found(self) -> bool:
        """Whether the rule has been met."""
        return self._answer is not None

    def feed(self, begin_us: int, value: float) -> None:
        """Take the ELP of one bin."""
        self._raw.append(value)
        output = filter_of_the_code(self._raw, self._filtered[-1] if self._filtered else None)
        self._filtered.append(output)
        self._begins_us.append(begin_us)
        self._high, self._low = max(self._high, output), min(self._low, output)
        if self._triggered():
            self._look_back(begin_us + self.bin_us)

    def result(self) -> PaperResult:
        """Return the answer as it stands."""
        focus_us, crossing_us, decided_us = self._answer or (None, None, None)
        sign = float(np.sign(self._filtered[0])) if self._filtered else 0.0
        first_us = self._begins_us[0] + self.bin_us if self._begins_us else None
        return PaperResult(focus_us, crossing_us, decided_us, sign, first_us, len(self._raw))

    def _triggered(self) -> bool:
        rule = self._constants
        if not rule.recent:
            return self._high - self._low > rule.swing and self._low < rule.floor
        before = self._filtered[: -rule.recent]
        return bool(before) and min(self._filtered[-rule.recent :]) < rule.floor and max(before) > rule.swing

    def _look_back(self, now_us: int) -> None:
        values = np.array(self._filtered)
        changes = np.flatnonzero((values[:-1] > 0.0) & (values[1:] < 0.0)) + 1
        if changes.size == 0:
            return  # the released code ends in an exception here
        first_negative = int(changes[-1])
        at = first_negative - 1 if self._constants.back_to_positive else first_negative
        focus_us = self._begins_us[at] - self._constants.back_bins * self.bin_us - self._constants.back_us
        self._answer = focus_us, self._begins_us[first_negative], now_us


def elp_of_bin(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    table: NDArray[np.float32],
    constants: Constants,
    roi: Roi,
) -> float | None:
    """Return the released code's ELP of one bin's events, or ``None`` if it skips the bin."""
    if not constants.whole_sensor:
        inside = (x >= roi.x) & (x < roi.x + roi.width) & (y >= roi.y) & (y < roi.y + roi.height)
        x, y, on = x[inside], y[inside], on[inside]
    if x.size < constants.fewest_events:
        return None
    pixel = y.astype(np.int64) * table.shape[1] + x
    brighter = np.bincount(pixel[on > 0], minlength=table.size) % 256
    darker = np.bincount(pixel[on == 0], minlength=table.size) % 256
    value = float(table.ravel().astype(np.float64) @ (darker - brighter))
    return value / x.size if constants.normalised else value
