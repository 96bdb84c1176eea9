"""Propose a region of interest: where the picture has most texture above its own noise.

Focus shows at edges, so a region is worth its band-pass energy of log intensity. Log, because events answer to
contrast and not to brightness; a band (about 3 to 25 pixels), because the picture may be far out of focus, where fine
detail is noise, while slow shading says nothing about focus. Three guards keep the choice honest. The energy that the
picture's own pixel noise would have in that band is known and subtracted, so a noisy dark corner does not win. Energy
per pixel is capped, so one lamp's rim does not outweigh a page of text. And a region that does not stand out of the
noise is refused: a flat wall yields ``None``, whatever its brightness and whatever the sensor's noise.

Everything is a ratio to the noise measured in the picture itself; there is no threshold in grey values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.errors import UsageError
from elpd.records import Roi

if TYPE_CHECKING:
    from numpy.typing import NDArray

FINE_SIGMA_PX = 1.5
COARSE_SIGMA_PX = 6.0

CAP_PERCENTILE = 95.0
"""No pixel counts for more energy than this share of the usable pixels stays below."""

MIN_TEXTURE = 0.5
"""Least ratio of texture energy to noise energy in the band."""

MIN_SIGNIFICANCE = 6.0
"""And least distance from noise alone in standard deviations; covers the search over a megapixel of positions."""

MIN_USABLE_FRACTION = 0.5


def propose_roi(
    log_intensity: NDArray[np.float32], valid: NDArray[np.bool_], size: tuple[int, int], margin_px: int = 8
) -> Roi | None:
    """Return the (width, height) rectangle of most texture, ``None`` if none stands out of the noise.

    Parameters
    ----------
    log_intensity
        (height, width) natural log intensity, *unsmoothed*: its pixel noise is what texture is compared with.
    valid
        Where it can be trusted. Half of a region must be.
    size
        Width and height of the region in pixels.
    margin_px
        Distance from the sensor's border, where defocus brings in light from outside the picture.

    Raises
    ------
    UsageError
        If the region with its margin does not fit into the picture.
    """
    height, width = log_intensity.shape
    roi_width, roi_height = size
    columns, rows = width - 2 * margin_px - roi_width + 1, height - 2 * margin_px - roi_height + 1
    if roi_width < 1 or roi_height < 1 or margin_px < 0 or columns < 1 or rows < 1:
        raise UsageError(
            f"a region of {roi_width} x {roi_height} px with a margin of {margin_px} px does not fit "
            f"into {width} x {height} px; choose a smaller one"
        )
    energy, usable = _energy_over_noise(log_intensity, valid)
    total = _box_sums(energy, roi_width, roi_height)[margin_px : margin_px + rows, margin_px : margin_px + columns]
    share = _box_sums(usable, roi_width, roi_height)[margin_px : margin_px + rows, margin_px : margin_px + columns]
    total = np.where(share >= MIN_USABLE_FRACTION * roi_width * roi_height, total, -np.inf)
    row, column = np.unravel_index(int(np.argmax(total)), total.shape)
    if not np.isfinite(total[row, column]):
        return None
    if not _stands_out(float(total[row, column]), float(share[row, column])):
        return None
    return Roi(int(column) + margin_px, int(row) + margin_px, roi_width, roi_height)


def texture(log_intensity: NDArray[np.float32], valid: NDArray[np.bool_], roi: Roi) -> float:
    """Return a region's texture energy as a multiple of the noise energy in the band; about 0 for noise alone."""
    energy, usable = _energy_over_noise(log_intensity, valid)
    window = np.s_[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width]
    return float(energy[window].sum() / max(usable[window].sum(), 1.0))


def has_texture(log_intensity: NDArray[np.float32], valid: NDArray[np.bool_], roi: Roi) -> bool:
    """Say whether a region stands out of the picture's noise enough to focus on."""
    energy, usable = _energy_over_noise(log_intensity, valid)
    window = np.s_[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width]
    return _stands_out(float(energy[window].sum()), float(usable[window].sum()))


def noise_sigma(log_intensity: NDArray[np.float32], valid: NDArray[np.bool_]) -> float:
    """Return the standard deviation of the pixel noise, from the mixed second difference of 2x2 blocks.

    Straight edges along either axis and slopes cancel in it, and the median ignores the rest of the scene as long as
    it covers less than half of the picture. Zero for a picture without noise.
    """
    mixed = log_intensity[:-1, :-1] - log_intensity[:-1, 1:] - log_intensity[1:, :-1] + log_intensity[1:, 1:]
    whole = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    if not whole.any():
        return 0.0
    # Four independent pixels: the difference has twice their standard deviation; 0.6745 is a normal one's median.
    return float(np.median(np.abs(mixed[whole]))) / (2 * 0.6745)


def _stands_out(energy: float, usable_px: float) -> bool:
    """Judge a sum of excess energies over *usable_px* pixels, in units of the noise energy per pixel."""
    if usable_px <= 0:
        return False
    # Neighbouring values of the band are correlated: one independent value per 4·pi·sigma_fine² pixels.
    independent = max(usable_px / (4 * np.pi * FINE_SIGMA_PX**2), 1.0)
    excess = energy / usable_px
    return excess > max(MIN_TEXTURE, MIN_SIGNIFICANCE * float(np.sqrt(2 / independent)))


def _energy_over_noise(
    log_intensity: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return per pixel the band's energy above noise, in units of the noise's, and where the pixel is usable (0, 1)."""
    usable = valid.astype(np.float32)
    # Only valid pixels enter the means, so that neither a hole nor its filling makes an edge.
    centre = np.float32(np.median(log_intensity[valid])) if valid.any() else np.float32(0)
    weighted = np.where(valid, log_intensity - centre, np.float32(0))
    fine, coarse = (
        cv2.GaussianBlur(weighted, (0, 0), sigma_px) / np.maximum(cv2.GaussianBlur(usable, (0, 0), sigma_px), 1e-6)
        for sigma_px in (FINE_SIGMA_PX, COARSE_SIGMA_PX)
    )
    energy = np.square(fine - coarse)
    # White noise of unit variance through the difference of two Gaussians.
    gain = (
        1 / (4 * np.pi * FINE_SIGMA_PX**2)
        + 1 / (4 * np.pi * COARSE_SIGMA_PX**2)
        - 1 / (np.pi * (FINE_SIGMA_PX**2 + COARSE_SIGMA_PX**2))
    )
    # A picture without any noise is limited by its numbers: float32 keeps 24 bits.
    resolution = (float(np.abs(log_intensity).max()) + 1e-12) * 2.0**-20
    noise = max(noise_sigma(log_intensity, valid), resolution) ** 2 * gain
    if valid.any():
        energy = np.minimum(energy, max(float(np.percentile(energy[valid], CAP_PERCENTILE)), 4 * noise))
    return np.where(valid, energy / noise - 1.0, 0.0).astype(np.float32), usable


def _box_sums(values: NDArray[np.float32], width: int, height: int) -> NDArray[np.float64]:
    """Sum every (height, width) box; element (row, column) is the box whose top left corner is there."""
    table = cv2.integral(values, sdepth=cv2.CV_64F)
    sums: NDArray[np.float64] = (
        table[height:, width:] - table[:-height, width:] - table[height:, :-width] + table[:-height, :-width]
    )
    return sums
