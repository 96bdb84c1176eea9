"""What others offer: decoders of EVT3, and the field's ways to the product of event frame and weights.

Decoders only decode: a comparison with our fused kernels is in their favour. ``evt3`` takes bytes as they come, the
others only files (read from the page cache, in their time). OpenEB is used where the machine has it.
"""

from __future__ import annotations

import importlib
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from speed.contender import Contender, Missing
from speed.stream import WINDOW_US, beginning, count, pieces

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import Geometry

FRAME_WINDOWS = 40
LOOP_WINDOWS = 4
DECODERS = ("evt3", "faery", "expelliarmus", "evutils", "OpenEB")
FRAME, LOOP = "evt3 + numpy event frame", "per-event loop of the paper's code"
_MODULES = {
    "evt3": "evt3",
    "faery": "faery.extension",
    "expelliarmus": "expelliarmus",
    "evutils": "evutils.io",
    "OpenEB": "metavision_core.event_io",
}


def peers(words: NDArray[np.uint16], n_events: int, file: Path, geometry: Geometry) -> list[Contender | Missing]:
    """Return the others' rows for a stream that is also in *file*."""
    size = (geometry.width, geometry.height)
    runs = {
        "evt3": lambda module: lambda: stream(module.Decoder(*size), as_bytes),
        "faery": lambda module: lambda: lambda: faery(module, file, size),
        "expelliarmus": lambda module: lambda: lambda: expelliarmus(module, file),
        "evutils": lambda module: lambda: lambda: evutils(module, file, size, n_events),
        "OpenEB": lambda module: lambda: lambda: openeb(module, file),
    }
    as_bytes = [piece.tobytes() for piece in pieces(words)]
    rows: list[Contender | Missing] = []
    for name, run in runs.items():
        try:
            module = importlib.import_module(_MODULES[name])
        except ImportError as error:
            rows.append(Missing(f"{name} decode", f"not installed here: {error}"))
        else:
            rows.append(Contender(f"{name} decode", run(module), words.nbytes / 1e6, n_events))
    return rows + products(words, geometry)


def products(words: NDArray[np.uint16], geometry: Geometry) -> list[Contender | Missing]:
    """Return the rows that go from bytes to the product, per window; slow, so on the stream's beginning."""
    weights = np.random.default_rng(1).integers(-1020, 1021, (geometry.height, geometry.width)).astype(np.float64)
    try:
        evt3 = importlib.import_module("evt3")
    except ImportError as error:
        return [Missing(name, f"needs evt3: {error}") for name in (FRAME, LOOP)]
    rows: list[Contender | Missing] = []
    for name, windows, product in ((FRAME, FRAME_WINDOWS, frame_product), (LOOP, LOOP_WINDOWS, loop_product)):
        part = beginning(words, geometry, windows)

        def prepare(part: Any = part, product: Any = product) -> Callable[[], object]:
            decoder = evt3.Decoder(geometry.width, geometry.height)
            return lambda: by_windows(decoder.feed(part.tobytes()), weights, product)

        rows.append(Contender(name, prepare, part.nbytes / 1e6, count(part, geometry)))
    return rows


def stream(decoder: Any, data: list[bytes]) -> Callable[[], object]:
    """Return a run that feeds bytes piece by piece."""

    def run() -> None:
        for piece in data:
            decoder.feed(piece)

    return run


def faery(module: Any, file: Path, size: tuple[int, int]) -> None:
    """Read a file through with faery's decoder."""
    with module.evt.Decoder(file, size, "evt3") as decoder:
        for _ in decoder:
            pass


def expelliarmus(module: Any, file: Path) -> None:
    """Read a file through with expelliarmus, in chunks, its fastest way."""
    wizard = module.Wizard(encoding="evt3", fpath=file, chunk_size=1 << 16)
    for _ in wizard.read_chunk():
        pass


def evutils(module: Any, file: Path, size: tuple[int, int], n_events: int) -> None:
    """Read a file at once with evutils, its fastest way."""
    width, height = size
    module.EventReader(file, mode="all", width=width, height=height, max_events=n_events + 1).read_all()


def openeb(module: Any, file: Path) -> None:
    """Read a file through with OpenEB's reader."""
    reader = module.RawReader(str(file))
    while not reader.is_done():
        reader.load_n_events(100_000)


def by_windows(events: Any, weights: NDArray[np.float64], product: Callable[..., float]) -> list[float]:
    """Apply a product to each window of a stretch of events."""
    t, x, y, p = (np.asarray(column) for column in (events.t, events.x, events.y, events.p))
    edges = np.searchsorted(t, np.arange(t[0], t[-1] + WINDOW_US, WINDOW_US))
    return [product(x[begin:end], y[begin:end], p[begin:end], weights) for begin, end in pairwise(edges.tolist())]


def frame_product(x: NDArray[Any], y: NDArray[Any], p: NDArray[Any], weights: NDArray[np.float64]) -> float:
    """Compute ELP as scripts do: a signed event frame, times the weights."""
    pixel = y.astype(np.int64) * weights.shape[1] + x
    frame = np.bincount(pixel, np.where(p == 1, 1.0, -1.0), minlength=weights.size)
    return -float(np.dot(frame, weights.reshape(-1)))


def loop_product(x: NDArray[Any], y: NDArray[Any], p: NDArray[Any], weights: NDArray[np.float64]) -> float:
    """Compute ELP as the paper's code does: count each polarity per pixel, event by event, then two whole products."""
    positive, negative = (np.zeros(weights.shape, np.uint8) for _ in range(2))
    for column, row, on in zip(x, y, p, strict=True):
        counts = positive if on == 1 else negative
        counts[row, column] += 1
    return -float((positive * weights).sum() - (negative * weights).sum())
