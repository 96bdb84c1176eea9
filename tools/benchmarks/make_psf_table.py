"""Trace a real 50 mm F/2 lens and write the PSF table that the benchmark ships.

The lens is the double Gauss of U.S. Patent 2,532,751 in the form that optical design programs distribute as their
standard example (100 mm, here halved: EFL 50.00 mm, F/2.00 at full aperture), with Schott's present glasses. It is
traced with ``optiland``, which is a development tool and no dependency of anything shipped:

    python -m venv .trace && .trace/bin/pip install optiland && .trace/bin/python tools/benchmarks/make_psf_table.py

For each of four image heights, from the axis to the corner of a DAVIS346, rays of three wavelengths are followed to a
plane, carried on to planes over ±544 um about the one of least RMS radius, and counted in cells of a third of that
sensor's pixel. Two liberties, both the paper's as well: each field is focused for itself (field curvature would move
its truth), and each spot is centred on its centroid (no focus breathing). Vignetting is not traced: within 4.6 degrees
the rims of this lens cut nothing.
"""

from __future__ import annotations

import argparse
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

SCALE = 0.5
SURFACES: tuple[tuple[float, float, Any], ...] = (
    # radius mm, distance to the next mm, glass (None: air)
    (56.20238, 8.75, ("N-SSK2", "schott")),
    (152.28580, 0.5, None),
    (37.68262, 12.5, ("N-SK2", "schott")),
    (math.inf, 3.8, ("F5", "schott")),
    (24.23130, 16.369445, None),
    (math.inf, 13.747957, None),  # the stop
    (-28.37731, 3.8, ("F5", "schott")),
    (math.inf, 11.0, ("N-SK16", "schott")),
    (-37.92546, 0.5, None),
    (177.41176, 7.0, ("N-SK16", "schott")),
    (-79.41143, 61.487536, None),
)
STOP = 6
PUPIL_MM = 25.0
WAVELENGTHS = ((0.4861, 0.5), (0.5876, 1.0), (0.6563, 0.5))
"""F, d and C lines in um, and how much of each a silicon sensor behind an infrared stop sees."""
IMAGE_HEIGHTS_MM = (0.0, 4.0 / 3.0, 8.0 / 3.0, 4.0)
"""Axis to the corner of a DAVIS346 (346 x 260 pixels of 18.5 um)."""
CELL_UM = 18.5 / 3.0
CELLS = 55
REACH_UM = 544.0
STEP_UM = 8.0
RAYS_ACROSS = 900


def main() -> None:
    """Trace, bin, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "data" / "double_gauss_50mm_f2.npz")
    out = parser.parse_args().out
    positions_um = np.arange(-REACH_UM, REACH_UM + 0.5 * STEP_UM, STEP_UM)
    kernels = np.zeros((len(IMAGE_HEIGHTS_MM), positions_um.size, CELLS, CELLS), dtype=np.uint16)
    rms_um = np.zeros(kernels.shape[:2])
    lens = build_lens()
    for field in range(len(IMAGE_HEIGHTS_MM)):
        rays = trace(lens, field)
        best_um = least_rms_um(rays)
        for k, position_um in enumerate(positions_um):
            spot, rms_um[field, k] = bin_spot(rays, best_um + position_um)
            kernels[field, k] = np.round(spot / spot.max() * 65_535.0)
        middle = rms_um[field, positions_um.size // 2]
        first, last = rms_um[field, 0], rms_um[field, -1]
        print(f"field {field + 1}: RMS {middle:.2f} um in focus, {first:.1f} and {last:.1f} at the ends")
    np.savez_compressed(
        out, kernels=kernels, positions_um=positions_um, rms_um=rms_um, cell_um=CELL_UM, heights_mm=IMAGE_HEIGHTS_MM
    )
    print(f"{out}: {out.stat().st_size} bytes")


def build_lens() -> Any:
    """Return the lens as optiland's object, its fields those of ``IMAGE_HEIGHTS_MM``."""
    from optiland.optic import Optic  # type: ignore[import-not-found]  # noqa: PLC0415  (a development tool)

    warnings.simplefilter("ignore")
    lens = Optic()
    lens.surfaces.add(index=0, radius=math.inf, thickness=math.inf)
    for number, (radius, distance, glass) in enumerate(SURFACES, start=1):
        more = {} if glass is None else {"material": glass}
        lens.surfaces.add(
            index=number, radius=radius * SCALE, thickness=distance * SCALE, is_stop=number == STOP, **more
        )
    lens.surfaces.add(index=len(SURFACES) + 1)
    lens.set_aperture(aperture_type="EPD", value=PUPIL_MM)
    lens.fields.set_type(field_type="angle")
    for height_mm in IMAGE_HEIGHTS_MM:
        lens.fields.add(y=math.degrees(math.atan2(height_mm, 100.0 * SCALE)))
    for wavelength_um, _ in WAVELENGTHS:
        lens.wavelengths.add(value=wavelength_um, is_primary=wavelength_um == 0.5876)
    return lens


def trace(lens: Any, field: int) -> np.ndarray:
    """Return rays (5, n): x, y at the last surface in um, slopes, and weight."""
    top = IMAGE_HEIGHTS_MM[-1]
    angle = math.degrees(math.atan2(IMAGE_HEIGHTS_MM[field], 100.0 * SCALE))
    full = math.degrees(math.atan2(top, 100.0 * SCALE))
    parts = []
    for wavelength_um, weight in WAVELENGTHS:
        traced = lens.trace(
            Hx=0, Hy=angle / full, wavelength=wavelength_um, num_rays=RAYS_ACROSS, distribution="uniform"
        )
        columns = [1e3 * traced.x, 1e3 * traced.y, traced.L / traced.N, traced.M / traced.N, weight * traced.i]
        parts.append(np.stack([np.asarray(column, dtype=np.float64) for column in columns]))
    rays = np.concatenate(parts, axis=1)
    return rays[:, np.isfinite(rays).all(axis=0) & (rays[4] > 0.0)]


def at_plane(rays: np.ndarray, position_um: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where the rays meet the plane at *position_um*, about their centroid."""
    x = rays[0] + position_um * rays[2]
    y = rays[1] + position_um * rays[3]
    return x - np.average(x, weights=rays[4]), y - np.average(y, weights=rays[4])


def radius_um(rays: np.ndarray, position_um: float) -> float:
    """Return the RMS radius about the centroid."""
    x, y = at_plane(rays, position_um)
    return math.sqrt(float(np.average(x * x + y * y, weights=rays[4])))


def least_rms_um(rays: np.ndarray) -> float:
    """Return the plane of least RMS radius: its square is a parabola, so three planes tell."""
    planes = np.array([-600.0, 0.0, 600.0])
    bend, slope, _ = np.polyfit(planes, [radius_um(rays, plane) ** 2 for plane in planes], 2)
    return float(-0.5 * slope / bend)


def bin_spot(rays: np.ndarray, position_um: float) -> tuple[np.ndarray, float]:
    """Return the spot in cells (CELLS, CELLS), sum 1, and the rays' RMS radius in um."""
    x, y = at_plane(rays, position_um)
    column = np.floor(x / CELL_UM + 0.5 * CELLS).astype(np.int64)
    row = np.floor(y / CELL_UM + 0.5 * CELLS).astype(np.int64)
    inside = (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    spot = np.bincount(row[inside] * CELLS + column[inside], weights=rays[4][inside], minlength=CELLS * CELLS)
    return spot.reshape(CELLS, CELLS) / spot.sum(), radius_um(rays, position_um)


if __name__ == "__main__":
    main()
