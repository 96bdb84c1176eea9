"""What a real lens makes of a picture while it sweeps through focus, and while the picture moves.

The paper convolves a 600 x 600 picture with 1001 ray-traced PSFs, translates it and down-samples by three.
Convolution, translation, averaging over a pixel and sampling are all products in the frequency domain, so a frame
costs one pass over the spectrum and one small inverse transform, and fractional shifts are exact. Between the table's
nodes the PSF is interpolated by cubic (Catmull-Rom) weights: they reproduce parabolas, and the variance of a defocused
PSF *is* a parabola in lens position. Linear weights would give it a kink at every node, one of them at focus, where it
would be mistaken for a sign mutation.

The picture is larger than the sensor's view by a margin, so that nothing wraps in at the edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from elpd.events.jit import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

TABLE = Path(__file__).parent / "data" / "double_gauss_50mm_f2.npz"

CELLS_PER_PIXEL = 3
"""Cells of the picture to a pixel of the sensor, along each axis."""

KEPT_NODES = 48
"""Transformed PSFs that a renderer keeps, of 2 to 4 MB each: as many as a pass over focus and back needs."""


@dataclass(frozen=True, slots=True)
class PsfTable:
    """PSFs of one field of view on equally spaced planes.

    ``kernels`` (planes, cells, cells) float32, each of sum one; ``positions_um`` (planes,); ``rms_um`` (planes,) the
    rays' own RMS radius; ``cell_um`` the side of a cell.
    """

    kernels: NDArray[np.float32]
    positions_um: NDArray[np.float64]
    rms_um: NDArray[np.float64]
    cell_um: float

    @property
    def step_um(self) -> float:
        """The distance between planes."""
        return float(self.positions_um[1] - self.positions_um[0])


def load_psf(field_of_view: int) -> PsfTable:
    """Return the shipped table for *field_of_view*, 1 (axis) to 4 (corner)."""
    with np.load(TABLE) as table:
        counts = table["kernels"][field_of_view - 1].astype(np.float64)
        kernels = counts / counts.sum(axis=(1, 2), keepdims=True)
        return PsfTable(
            kernels.astype(np.float32),
            table["positions_um"],
            table["rms_um"][field_of_view - 1],
            float(table["cell_um"]),
        )


def cubic_weights(position: float, nodes: int) -> tuple[int, NDArray[np.float64]]:
    """Return the first of four nodes and their weights (4,) at a (fractional) node index.

    Catmull-Rom inside; at the ends the four outermost nodes serve with Lagrange's weights. Both reproduce parabolas.
    """
    first = int(np.clip(np.floor(position) - 1, 0, nodes - 4))
    u = position - first - 1.0
    if 0.0 <= u <= 1.0:
        weights = (
            0.5 * u * (u * (2.0 - u) - 1.0),
            0.5 * (u * u * (3.0 * u - 5.0) + 2.0),
            0.5 * u * (u * (4.0 - 3.0 * u) + 1.0),
            0.5 * u * u * (u - 1.0),
        )
    else:
        weights = (
            -u * (u - 1.0) * (u - 2.0) / 6.0,
            (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
            -(u + 1.0) * u * (u - 2.0) / 2.0,
            (u + 1.0) * u * (u - 1.0) / 6.0,
        )
    return first, np.array(weights)


class FocusRenderer:
    """Renders one picture through one field of view.

    Parameters
    ----------
    picture:
        (3n, 3n) float32, cells of linear intensity; 3n must be even and a multiple of 6.
    psf:
        The field's table.
    margin_px:
        How many pixels of the sensor's grid to cut off each side of what is rendered.
    """

    def __init__(self, picture: NDArray[np.float32], psf: PsfTable, margin_px: int) -> None:
        side = picture.shape[0]
        if picture.shape != (side, side) or side % (2 * CELLS_PER_PIXEL):
            raise ValueError(f"the picture must be square with a side that 6 divides; got {picture.shape}")
        self._psf = psf
        self._margin_px = margin_px
        self._side = side
        self._scene = np.fft.rfft2(picture).astype(np.complex64) * _pixel_transfer(side)
        self._nodes: dict[int, NDArray[np.complex64]] = {}
        self._folded = np.zeros((side // CELLS_PER_PIXEL, side // CELLS_PER_PIXEL // 2 + 1), dtype=np.complex64)

    @property
    def size_px(self) -> int:
        """Width and height of a rendered frame."""
        return int(self._side // CELLS_PER_PIXEL - 2 * self._margin_px)

    def frame(self, position_um: float, shift_px: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float32]:
        """Return the picture (size_px, size_px) with the lens at *position_um*, moved by *shift_px* = (x, y).

        Cheap when called for neighbouring positions in turn, there and back: the newest transformed PSFs are kept.
        """
        index = (position_um - float(self._psf.positions_um[0])) / self._psf.step_um
        first, weights = cubic_weights(index, self._psf.positions_um.size)
        a, b, c, d = (self._nodes.pop(n) if n in self._nodes else self._node(n) for n in range(first, first + 4))
        self._nodes.update(zip(range(first, first + 4), (a, b, c, d), strict=True))
        while len(self._nodes) > KEPT_NODES:
            del self._nodes[next(iter(self._nodes))]
        fold_spectrum(
            a,
            b,
            c,
            d,
            weights.astype(np.float32),
            self._phase(shift_px[1])[0],
            self._phase(shift_px[0])[1],
            self._folded,
        )
        image = np.fft.irfft2(self._folded, s=(self._side // CELLS_PER_PIXEL,) * 2)
        cut = slice(self._margin_px, self._margin_px + self.size_px)
        return np.ascontiguousarray(image[cut, cut], dtype=np.float32)

    def _node(self, number: int) -> NDArray[np.complex64]:
        kernel_cells = self._psf.kernels[number]
        cells = kernel_cells.shape[0]
        reach = cells // 2
        padded = np.zeros((cells, self._side), dtype=np.float32)
        padded[:, :cells] = kernel_cells
        # Along rows only those are transformed that hold anything: what the whole transform makes, in half the time.
        rows = np.zeros((self._side, self._side // 2 + 1), dtype=np.complex64)
        rows[:cells] = np.fft.rfft(np.roll(padded, -reach, axis=1), axis=1)
        transfer = np.fft.fft(np.roll(rows, -reach, axis=0), axis=0)
        return np.ascontiguousarray(self._scene * transfer.astype(np.complex64))

    def _phase(self, shift_px: float) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Return the phase factors of a shift along rows (side,) and along columns (side/2+1,)."""
        cells = -2.0j * np.pi * CELLS_PER_PIXEL * shift_px
        rows = np.exp(cells * np.fft.fftfreq(self._side)).astype(np.complex64)
        columns = np.exp(cells * np.fft.rfftfreq(self._side)).astype(np.complex64)
        return rows, columns


def _pixel_transfer(side: int) -> NDArray[np.complex64]:
    """Return the transfer function of averaging 3 x 3 cells about a pixel's middle cell, and of sampling there.

    The first pixel's middle is cell 1, hence the shift by one cell; one ninth comes with the folding.
    """
    rows, columns = np.fft.fftfreq(side), np.fft.rfftfreq(side)

    def along(frequency: NDArray[np.floating]) -> NDArray[np.complex128]:
        box = (1.0 + 2.0 * np.cos(2.0 * np.pi * frequency)) / CELLS_PER_PIXEL
        return np.asarray(box * np.exp(2.0j * np.pi * frequency) / CELLS_PER_PIXEL, dtype=np.complex128)

    return np.outer(along(rows), along(columns)).astype(np.complex64)


@kernel(
    "void(complex64[:, ::1], complex64[:, ::1], complex64[:, ::1], complex64[:, ::1], float32[::1], complex64[::1], "
    "complex64[::1], complex64[:, ::1])"
)
def fold_spectrum(
    a: NDArray[np.complex64],
    b: NDArray[np.complex64],
    c: NDArray[np.complex64],
    d: NDArray[np.complex64],
    weights: NDArray[np.float32],
    row_phase: NDArray[np.complex64],
    column_phase: NDArray[np.complex64],
    folded: NDArray[np.complex64],
) -> None:
    """Blend four half spectra (3n, 3n/2+1), shift, and alias them onto the spectrum (n, n/2+1) of every third cell.

    Column j of the small spectrum collects columns j, j+n and j+2n of the large one; the last lies in the half that a
    real transform leaves out and is the conjugate of column n-j at the mirrored row.
    """
    small = folded.shape[0]
    side = 3 * small
    columns = small // 2 + 1
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    for row in range(small):
        for column in range(columns):
            folded[row, column] = 0.0
    # A loop for each part, so that each runs along the rows of all arrays and is done several numbers at a time.
    for row in range(side):
        target = row % small
        phase = row_phase[row]
        for column in range(columns):
            blend = w0 * a[row, column] + w1 * b[row, column] + w2 * c[row, column] + w3 * d[row, column]
            folded[target, column] += blend * (phase * column_phase[column])
        for column in range(columns):
            at = column + small
            blend = w0 * a[row, at] + w1 * b[row, at] + w2 * c[row, at] + w3 * d[row, at]
            folded[target, column] += blend * (phase * column_phase[at])
        mirrored = (side - row) % side
        phase = row_phase[mirrored]
        for column in range(columns):
            at = small - column
            blend = w0 * a[mirrored, at] + w1 * b[mirrored, at] + w2 * c[mirrored, at] + w3 * d[mirrored, at]
            folded[target, column] += np.conj(blend * (phase * column_phase[at]))
