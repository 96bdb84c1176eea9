"""Mirror pairs of a scene whose photoreceptors lag, drawn and not simulated."""

from __future__ import annotations

import numpy as np

from elpd.vision.turns import BLOCKS, Slowness, Turns


def turns_of_a_lag(
    lag: float,
    *,
    seed: int = 11,
    spread: float = 20.0,
    shared: float = 0.0,
    contrast: float = 0.0,
    reach: tuple[float, float] = (200.0, 400.0),
    kernel: float = 2.0,
) -> tuple[Turns, Slowness]:
    """Return 4000 pairs about a focus at 50, of pixels 1 to *spread* times slower than the brightest.

    *shared* is the standard deviation of what a block's pairs have in common, *contrast* by how much a pixel that is
    darker than its neighbours turns earlier, for a unit of log slowness; *reach* how long after focus pairs end.
    """
    random = np.random.default_rng(seed)
    many = 4000
    around, beyond = random.uniform(0.2, 0.8, many), random.normal(0.0, 0.2, many)
    times = np.clip(np.exp(np.log(spread) * around + beyond), 1.0, 2.0 * spread)
    half = random.uniform(*reach, many)
    late = lag * times
    for _ in range(60):
        late = 0.5 * late - 0.5 * lag * times * np.expm1(-(half + late) / np.maximum(np.abs(lag) * times, 1e-9))
    block = random.integers(0, BLOCKS**2, many)
    middle = 50.0 + late - contrast * beyond + shared * random.normal(0.0, 1.0, BLOCKS**2)[block]
    middle += random.normal(0.0, 0.5, many)
    mode = float(np.median(middle))
    return Turns(middle, 2.0 * half, np.ones(many), block, mode, kernel, 40.0), Slowness(times, beyond)
