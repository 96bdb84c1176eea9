"""How far a scene went across the sensor while the lens passed focus.

Near focus the image that the events built is sharp, whatever it was before, and two such images lie on top of each
other to some hundredths of a pixel. So motion that moves a blurred picture too little to be seen at rest is seen there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product
from typing import TYPE_CHECKING

import cv2
import numpy as np

from elpd.vision.integral import band_image

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCALE_PX = 1.2
"""Band in which images are laid on each other: the finest but one, where what pixels hold back is less."""

LOOKS = 5
"""How many images of a pass are compared, each with the next."""

SIGMAS = 6.0
LEAST_PX = 0.1
"""What counts as motion: so many standard errors, and more than thresholds that differ between pixels ever feign."""

SIGMAS_BETWEEN = 5.0
"""The same between two passes: what is built in the second began as the first left it, and lies within 0.06 px of it
where nothing moved, even if depths are mixed; so the least size tells, and an error from four quarters has to agree. In
noise it is that error alone: of a shift in two directions and six degrees of freedom 0.7 % lie beyond five of it, 6 %
beyond three, and every further pass is compared with all before."""


@dataclass(frozen=True, slots=True)
class Drift:
    """How far apart the two places lie, at the most, where the scene was; and a standard error. Pixels."""

    px: float = 0.0
    sigma_px: float = 0.0
    isotropy: float = 1.0
    """How evenly the picture's edges point in all directions: 1 for gravel, 0 for bars. Where they all point one way,
    motion along it is not seen and motion across it looks like blur."""

    @property
    def seen(self) -> bool:
        """Whether the scene has certainly moved, as a whole."""
        return self.px > max(LEAST_PX, SIGMAS * self.sigma_px)

    @property
    def seen_between(self) -> bool:
        """Whether the scene has moved between two images that two passes have built in focus."""
        return self.px > max(LEAST_PX, SIGMAS_BETWEEN * self.sigma_px)


def shift_px(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (x, y) by which *other* lies beside *one*, by phase correlation."""
    height, width = one.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(one, other, window)
    # An odd transform has its middle between two pixels; the library takes it half a pixel off.
    odd = [cv2.getOptimalDFTSize(width) % 2, cv2.getOptimalDFTSize(height) % 2]
    return np.asarray(shift, dtype=np.float64) - 0.5 * np.array(odd, dtype=np.float64)


def find_drift(images: NDArray[np.float32]) -> Drift:
    """Return how far a scene went while its *images*, in turn, were built.

    The quarters of the picture are followed by themselves: what they have in common is motion, and how they differ is
    its error, or something else that moves edges (magnification that changes with focus, an object that goes by).
    """
    which = np.unique(np.linspace(0, len(images) - 1, LOOKS).round().astype(np.int64))
    bands = [band_image(images[k], SCALE_PX) for k in which]
    rows, columns = (np.array_split(np.arange(size), 2) for size in images.shape[1:])
    paths = np.zeros((len(rows) * len(columns), which.size, 2))
    for path, (row, column) in zip(paths, product(rows, columns), strict=True):
        quarters = [np.ascontiguousarray(band[row[0] : row[-1] + 1, column[0] : column[-1] + 1]) for band in bands]
        steps = [shift_px(one, other) for one, other in pairwise(quarters)]
        path[1:] = np.cumsum(steps, axis=0)
    common = paths.mean(axis=0)
    variance = paths[:, 1:].var(axis=0, ddof=1).mean() / len(paths)
    furthest = np.linalg.norm(common[:, None] - common[None, :], axis=-1).max()
    sharpest = int(np.argmax([np.square(band).mean() for band in bands]))
    return Drift(float(furthest), float(np.sqrt(variance)), isotropy(images[which[sharpest]]))


def isotropy(image: NDArray[np.float32]) -> float:
    """Return the smaller eigenvalue of an image's structure tensor over the mean of both."""
    down, right = np.gradient(cv2.GaussianBlur(image, (0, 0), SCALE_PX))
    tensor = np.array([[np.mean(a * b) for a in (down, right)] for b in (down, right)])
    small, large = np.linalg.eigvalsh(tensor)
    return float(2.0 * small / (small + large)) if large > 0.0 else 1.0
