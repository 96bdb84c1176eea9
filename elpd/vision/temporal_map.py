"""Turn first-ON times of an aperture opening into an HDR picture (EvTemMap, ECCV 2024, arXiv 2403.06443).

The photoreceptor answers to ``log(I·T(t) + I_d)``: scene intensity times the aperture's transmittance, plus dark
current. Starting from darkness, the first ON event comes when ``I·T(t) = I_d·(e^C - 1)``. The right side is the same
for every pixel (up to the sensor's fixed pattern), so ``log I = -log T(t_first - t_open) + const``; the constant drops
out of every Laplacian, and nothing saturates: a lamp and the wall behind it differ in time, not in well capacity.

Needed are the instant at which the aperture began to open and its transmittance profile. A rig knows both. A
recording may not, so the opening can be found (``find_opening``) and the profile defaults to an iris, whose diameter
grows evenly and whose area, thus T, with the square of time: what a camera lens has, and what the method's authors
assume in their code. A wrong profile exponent only stretches log I; a wrong opening time flattens the bright end.

Pixels that nothing can be said about (hot, or never fired) get a value that makes no edge: their neighbours' median,
or the darkest intensity if the hole is large, because what did not fire is dark. ``valid`` is false there, and users
give such pixels no weight.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.records import TemporalImage
from elpd.units import SensorUs
from elpd.vision.latch import EMPTY

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.vision.first_times import FirstTimes

LARGE_HOLE_PX = 64
"""A hole of more unfired pixels is an unlit part of the scene; a smaller one is a flaw to be mended."""

DB_PER_LOG = 20.0 / np.log(10.0)
"""Decibels (20·log10) per unit of natural log intensity."""

TIMESTAMP_STEP_US = 1.0
"""What the sensor's clock resolves. An event stamped t happened in ``[t, t + 1)``; half a step is the best guess."""


class Transmittance(Protocol):
    """How much light the aperture passes at times after the opening began; any overall factor drops out."""

    def __call__(self, since_open_us: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the transmittance, zero where the aperture is closed."""
        ...


def linear(since_open_us: NDArray[np.float64], /) -> NDArray[np.float64]:
    """Return the profile of a shutter curtain or slit: the open area grows evenly."""
    return np.maximum(since_open_us, 0.0)


def iris(since_open_us: NDArray[np.float64], /) -> NDArray[np.float64]:
    """Return the profile of an iris: the diameter grows evenly, the area with its square."""
    return np.square(np.maximum(since_open_us, 0.0))


def tabulated(t_us: NDArray[np.float64], transmittance: NDArray[np.float64]) -> Transmittance:
    """Return a measured profile: straight lines between the rows, closed before the first, constant after the last.

    Raises
    ------
    UsageError
        If there are fewer than two rows, times do not increase, or the transmittance is negative, decreases or is
        zero throughout.
    """
    if t_us.size < 2 or not np.isfinite(t_us).all() or not np.isfinite(transmittance).all():
        raise UsageError(f"a transmittance table needs two or more rows of finite numbers; got {t_us.size} rows")
    if (np.diff(t_us) <= 0).any():
        row = int(np.flatnonzero(np.diff(t_us) <= 0)[0]) + 2
        raise UsageError(f"transmittance table, row {row}: time {t_us[row - 1]:g} us does not increase; sort the rows")
    if (np.diff(transmittance) < 0).any() or transmittance[0] < 0 or transmittance[-1] <= 0:
        row = int(np.argmin(np.diff(transmittance, prepend=0.0))) + 1
        raise UsageError(
            f"transmittance table, row {row}: an opening aperture passes more and more light, from 0 or more upwards, "
            f"but here is {transmittance[row - 1]:g}; smooth the measurement or end the table at its maximum"
        )

    def profile(since_open_us: NDArray[np.float64], /) -> NDArray[np.float64]:
        return np.interp(since_open_us, t_us, transmittance, left=0.0)

    return profile


def read_transmittance(choice: str | Path) -> Transmittance:
    """Return the profile named ``linear`` or ``iris``, or the one in a file.

    A file holds rows of ``t_us,transmittance`` (CSV; lines with # and a heading of these words are skipped), or is
    what `elpd calibrate aperture` stores: a JSON object whose ``kind`` is ``aperture`` and whose ``since_us`` and
    ``transmittance`` are such columns.

    Raises
    ------
    UsageError
        If there is no such file or the table is no opening profile.
    FormatError
        If the file does not hold two columns of numbers.
    """
    if choice == "linear":
        return linear
    if choice == "iris":
        return iris
    try:
        with open(choice, encoding="utf-8") as file:  # noqa: PTH123  (choice may be str)
            text = file.read()
    except FileNotFoundError:
        raise UsageError(f"transmittance is linear, iris or a CSV file; there is no file {str(choice)!r}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{choice}: cannot be read as a table of t_us,transmittance ({error})") from None
    if text.lstrip().startswith("{"):
        return _stored_profile(choice, text)
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and lines[0].replace(" ", "").lower() == "t_us,transmittance":
        del lines[0]
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            t_us, transmittance = (float(field) for field in line.split(","))
        except ValueError:
            raise FormatError(f"{choice}, row {number}: expected t_us,transmittance; found {line[:60]!r}") from None
        rows.append((t_us, transmittance))
    table = np.array(rows, np.float64).reshape(-1, 2)
    return tabulated(np.ascontiguousarray(table[:, 0]), np.ascontiguousarray(table[:, 1]))


def _stored_profile(choice: str | Path, text: str) -> Transmittance:
    try:
        stored = json.loads(text)
        if stored["kind"] != "aperture":
            raise FormatError(f"{choice}: is a profile of kind {stored['kind']!r}, not of an aperture")
        columns = [np.array(stored[name], np.float64) for name in ("since_us", "transmittance")]
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{choice}: is no aperture profile ({type(error).__name__}: {error}); "
            "make one with `elpd calibrate aperture`"
        ) from None
    if columns[0].ndim != 1 or columns[0].shape != columns[1].shape:
        raise FormatError(f"{choice}: since_us and transmittance must be columns of one length")
    return tabulated(*columns)


def find_opening(first: FirstTimes) -> SensorUs:
    """Return when the aperture began to open, judged by the events alone.

    The total event rate is a poor witness: over a megapixel, noise alone is a thousand events per millisecond, and the
    brightest thing in view may be a lamp of some hundred pixels. Two things are better. *Agreement* bounds the opening
    from above: noise never makes most of a 3x3 neighbourhood fire, so the earliest one that did has seen light.
    *Jitter* tells how long before that the light began: threshold mismatch and photon noise act on intensity, thus
    scatter a pixel's time in proportion to the time *since the opening*. A straight line through the scatter of the
    brighter half of the picture over its time crosses zero at the opening (within 20 us in simulated openings with
    mismatch alone). A pixel's lag moves the crossing as it moves the events, which is as it should be: what counts is
    the time since *this pixel* could see the opening. Additive timing noise draws it early, which flattens the bright
    end a little, where a late one would make it explode. The result lies inside the interval, and at most three times
    as long before the earliest agreement as the brighter half of the picture took to fire after it.

    Raises
    ------
    UsageError
        If no neighbourhood of pixels fired at all.
    """
    agreed_us = agreed_times_us(first)
    fired_us = agreed_us[agreed_us < EMPTY]
    if fired_us.size == 0:
        raise UsageError(
            f"no opening found: {100 * first.fired_fraction:.2f} % of the pixels fired, but nowhere a patch of them "
            "together, which is noise and not light; check the aperture, the lens cap and the interval"
        )
    earliest_us = float(fired_us.min())
    half_us = float(np.median(fired_us))
    opening_us = min(_jitter_vanishes_us(first, agreed_us, half_us), earliest_us - TIMESTAMP_STEP_US)
    opening_us = max(opening_us, earliest_us - REACH * (half_us - earliest_us), 0.0)
    return SensorUs(first.begin_us + round(opening_us))


JITTER_BINS = 16

REACH = 3.0
"""How far a line is trusted beyond the data, in lengths of the data."""


def _jitter_vanishes_us(first: FirstTimes, agreed_us: NDArray[np.float32], until_us: float) -> float:
    """Return where the scatter of first times, as a line over time, reaches zero; infinity if it shows no trend."""
    times = first.times_us.astype(np.float32)
    corner, right, below, across = times[:-1, :-1], times[:-1, 1:], times[1:, :-1], times[1:, 1:]
    # The mixed second difference of a 2x2 block ignores slopes and straight edges along either axis.
    scatter = np.abs(corner - right - below + across) / 2
    latest = np.maximum(np.maximum(corner, right), np.maximum(below, across))
    usable = (latest < EMPTY) & (agreed_us[:-1, :-1] <= until_us)
    if usable.sum() < 64 * JITTER_BINS:
        return float("inf")
    when, scatter = agreed_us[:-1, :-1][usable], scatter[usable]
    order = np.argsort(when, kind="stable")
    bin_us = np.array([np.median(part) for part in np.array_split(when[order], JITTER_BINS)])
    bin_scatter = np.array([np.median(part) for part in np.array_split(scatter[order], JITTER_BINS)])
    i, j = np.triu_indices(JITTER_BINS, 1)
    rising = bin_us[j] > bin_us[i]
    if not rising.any():
        return float("inf")
    slope = float(np.median((bin_scatter[j] - bin_scatter[i])[rising] / (bin_us[j] - bin_us[i])[rising]))
    return float(np.median(bin_us - bin_scatter / slope)) if slope > 0 else float("inf")


def agreed_times_us(first: FirstTimes) -> NDArray[np.float32]:
    """Return when most of each 3x3 neighbourhood had fired: (height, width), relative, ``EMPTY`` for never."""
    median: NDArray[np.float32] = cv2.medianBlur(first.times_us.astype(np.float32), 3)
    return median


def temporal_image(
    first: FirstTimes, transmittance: Transmittance = iris, open_us: SensorUs | None = None
) -> TemporalImage:
    """Make the HDR picture.

    Parameters
    ----------
    first
        Believed first-ON times of the opening.
    transmittance
        The aperture's profile; see ``linear``, ``iris``, ``tabulated``, or ``Aperture.transmittance`` of a rig.
    open_us
        When the opening began on the sensor's clock; found from the events when not given. Events before it count
        as noise.

    Raises
    ------
    UsageError
        If no pixel fired after the opening, or no opening can be found.
    """
    if open_us is None:
        open_us = find_opening(first)
    fired = first.times_us != EMPTY
    offset_us = first.begin_us - open_us + TIMESTAMP_STEP_US / 2
    since_open_us = first.times_us.astype(np.float64) + offset_us
    # Times are whole microseconds: ask the profile once for each that occurs, not once for each pixel.
    stamps, which = np.unique(first.times_us, return_inverse=True)
    passed = transmittance(stamps.astype(np.float64) + offset_us)[which].reshape(fired.shape)
    valid = fired & (since_open_us > 0) & (passed > 0)
    if not valid.any():
        raise UsageError(
            f"no pixel fired together with its neighbours after the aperture began to open at {open_us} us; "
            f"{100 * first.fired_fraction:.2f} % fired at all, which is noise; check the opening time and the profile"
        )
    log_intensity = np.zeros(first.times_us.shape, np.float32)
    log_intensity[valid] = -np.log(passed[valid])
    log_intensity -= np.float32(np.median(log_intensity[valid]))
    early = fired & ~valid
    hot = first.hot | early
    fill_holes(log_intensity, valid)
    low, high = np.percentile(log_intensity[valid], [0.1, 99.9])
    return TemporalImage(
        log_intensity=log_intensity,
        valid=valid,
        open_us=open_us,
        fired_fraction=first.fired_fraction,
        hot_pixels=int(hot.sum()),
        filled_pixels=int((~valid & ~hot).sum()),
        dynamic_range_db=float((high - low) * DB_PER_LOG),
    )


def fill_holes(log_intensity: NDArray[np.float32], valid: NDArray[np.bool_]) -> None:
    """Give invalid pixels a value, in place: neighbours' median inwards from the rim, large holes the darkest one."""
    hole = ~valid
    if not hole.any():
        return
    count, label, statistics, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] > LARGE_HOLE_PX
    large[0] = False
    if count > 1 and large.any():
        log_intensity[large[label]] = np.percentile(log_intensity[valid], 0.1)
    height, width = valid.shape
    padded = np.full((height + 2, width + 2), np.nan, np.float32)
    padded[1:-1, 1:-1] = np.where(hole & ~large[label], np.float32(np.nan), log_intensity)
    rows, columns = np.nonzero(np.isnan(padded[1:-1, 1:-1]))
    while rows.size:
        around = np.stack(
            [padded[rows + 1 + dy, columns + 1 + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy], axis=-1
        )
        reached = ~np.isnan(around).all(axis=1)
        padded[rows[reached] + 1, columns[reached] + 1] = np.nanmedian(around[reached], axis=1)
        rows, columns = rows[~reached], columns[~reached]
    log_intensity[:] = padded[1:-1, 1:-1]


def smoothed(image: TemporalImage) -> NDArray[np.float32]:
    """Return the log image through a 3x3 median: (height, width) float32.

    First-ON times scatter by 4 to 5 % from pixel to pixel (threshold mismatch, photon noise), white in space, which a
    Laplacian amplifies most. The median leaves 0.4 of it and straight edges where they are; it does cost detail of a
    pixel's size, so a region of interest is better chosen on the unsmoothed picture.
    """
    median: NDArray[np.float32] = cv2.medianBlur(image.log_intensity, 3)
    return median


MIN_VALID_FRACTION = 0.02
"""Fewer pixels than this leave no room for a region of interest."""

MIN_AGREEMENT = 0.1
"""Correlation of a pixel with its neighbour. Noise has 0, a textureless wall about 0, pictures 0.5 to 1."""


def quality(image: TemporalImage) -> tuple[bool, str]:
    """Say whether the map shows a scene, and why not: a stuck aperture or a lens cap yields noise, not a picture.

    Both tests are free of scale: the share of pixels that fired believably, and the correlation of adjacent pixels,
    which does not depend on contrast, exposure or the opening's speed. Values beyond the 1st and 99th percentile are
    clipped first, so that one lamp in the dark does not speak for the rest.
    """
    share = float(image.valid.mean())
    if share < MIN_VALID_FRACTION:
        return False, (
            f"only {100 * share:.2f} % of the pixels fired while the aperture opened (limit "
            f"{100 * MIN_VALID_FRACTION:.0f} %); check that the aperture moves and the lens cap is off, or add light"
        )
    agreement = neighbour_correlation(image)
    if agreement < MIN_AGREEMENT:
        return False, (
            f"the map is noise: adjacent pixels correlate by {agreement:.3f} (limit {MIN_AGREEMENT:g}); "
            "the aperture may be stuck, the lens capped, or the scene without any structure"
        )
    return True, f"{100 * share:.2f} % of the pixels fired, adjacent pixels correlate by {agreement:.3f}"


def neighbour_correlation(image: TemporalImage) -> float:
    """Return the correlation of horizontally and vertically adjacent valid pixels, 0 for noise (Moran's I)."""
    low, high = np.percentile(image.log_intensity[image.valid], [1, 99])
    if high <= low:
        return 0.0
    clipped = np.clip(image.log_intensity, low, high).astype(np.float64)
    centred = np.where(image.valid, clipped - clipped[image.valid].mean(), 0.0)
    variance = float(np.square(centred).sum()) / image.valid.sum()
    product = float((centred[:, 1:] * centred[:, :-1]).sum() + (centred[1:] * centred[:-1]).sum())
    pairs = int((image.valid[:, 1:] & image.valid[:, :-1]).sum() + (image.valid[1:] & image.valid[:-1]).sum())
    return product / pairs / variance if pairs else 0.0
