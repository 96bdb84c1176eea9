"""What there is to see in a case at any time, wherever the lens is: picture, motion, lamp, and the lens's blur."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.optics import FocusRenderer, load_psf
from benchmarks.scenes import load_picture
from benchmarks.shake import MOTIONS, shifts_px

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.cases import Case

LAMP_HZ = 100.0
"""A lamp on 50 Hz mains."""


class Scenery:
    """A case's scene behind its lens.

    Parameters
    ----------
    case:
        Which scene, lens and motion.
    last_us:
        How long the scene goes on moving; a longer time has the same beginning.
    motion_rng:
        Draws the motion.
    """

    def __init__(self, case: Case, last_us: int, motion_rng: np.random.Generator) -> None:
        chosen = case.of_set
        side = 3 * (chosen.size_px + 2 * chosen.margin_px)
        psf = load_psf(case.fov)
        self._chosen = chosen
        self._reach_um = float(psf.positions_um[-1])
        self._renderer = FocusRenderer(load_picture(case.scene, side), psf, chosen.margin_px)
        steps = last_us // chosen.step_us + 1
        self._moved = chosen.motion_px * shifts_px(MOTIONS[case.motion], steps, chosen.step_us / 1e3, motion_rng)

    def shift_px(self, t_us: int) -> tuple[float, float]:
        """Return how far the scene has moved, (x, y): before time zero, which exposures see, as after it, mirrored."""
        shift = np.sign(t_us) * self._moved[abs(t_us) // self._chosen.step_us]
        return float(shift[0]), float(shift[1])

    def picture(self, t_us: int, position_um: float, opened: float = 1.0) -> NDArray[np.float32]:
        """Return the picture (size, size) in grey levels, the lens *position_um* from focus.

        *opened* is the share of the aperture's area that is open. It changes the blur only: who looks dims the light.
        """
        chosen = self._chosen
        # The area opens evenly, so the diameter, and with it the blur of a given defocus, with the square root.
        blur_um = float(np.sqrt(opened)) * chosen.defocus_per_um * position_um
        blur_um = min(max(blur_um, -self._reach_um), self._reach_um)
        lamp = np.float32(1.0 + chosen.flicker * np.sin(2.0 * np.pi * LAMP_HZ * t_us / 1e6))
        seen = lamp * self._renderer.frame(blur_um, self.shift_px(t_us))
        return np.asarray(np.clip(seen, 0.0, 255.0), dtype=np.float32)
