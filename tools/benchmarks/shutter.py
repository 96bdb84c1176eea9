"""A frame gathers light while its shutter is open: the mean of what there was to see, not an instant of it.

A lens at 2 mm/s travels 10 um in an exposure of 5 ms, and a hand moves the picture meanwhile, so that a frame of a
sweep is never as sharp as the sweep's sharpest instant. Read-out takes time too: a frame shows the past.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Shutter:
    """Averages the pictures of an exposure that ended ``read_out_us`` ago; every *step_us* one is shown to it.

    An exposure of no length is an instant. Both times are multiples of the step.
    """

    def __init__(self, exposure_us: int, read_out_us: int, step_us: int) -> None:
        if exposure_us % step_us or read_out_us % step_us:
            raise ValueError(f"exposure {exposure_us} us, read-out {read_out_us} us: not multiples of {step_us} us")
        self.reach_us = exposure_us + read_out_us
        """How long before a frame is there its exposure begins."""
        self._pictures: deque[NDArray[np.float32]] = deque(maxlen=self.reach_us // step_us + 1)
        steps = exposure_us // step_us
        # Linear between pictures: the outermost count by half.
        self._weights = np.ones(steps + 1, dtype=np.float32)
        self._weights[[0, -1]] = 0.5 if steps else 1.0
        self._weights /= self._weights.sum()

    def see(self, picture: NDArray[np.float32]) -> None:
        """Take the picture (height, width) of the next step."""
        self._pictures.append(picture)

    def exposed(self) -> NDArray[np.float32]:
        """Return the frame that is there now."""
        if len(self._pictures) < (self._pictures.maxlen or 0):
            raise ValueError(f"only {len(self._pictures)} pictures of the {self._pictures.maxlen} that are needed")
        frame = np.zeros_like(self._pictures[0])
        for weight, picture in zip(self._weights, self._pictures, strict=False):
            frame += weight * picture
        return frame
