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
FEWEST_EVENTS = 10
"""The paper's code for the EVK4 skips windows with fewer."""

RECORD = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")], align=True)
"""Events as Prophesee's reader gives them and the paper's code takes them: 16 bytes each."""

DECODERS = ("evt3", "faery", "expelliarmus", "evutils", "OpenEB")
FRAME = "evt3 + numpy event frames, as the paper's code"
SIGNED, LOOP = "evt3 + one signed event frame, bincount", "evt3 + the per-event loop of the paper's code"
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
    """Return the rows that go from bytes to the product, per window; slow, so on the stream's beginning.

    Each decodes with ``evt3``. What the paper's code gets from its decoder are records, so packing them is not timed.
    """
    weights = np.random.default_rng(1).integers(-1020, 1021, (geometry.height, geometry.width))
    try:
        evt3 = importlib.import_module("evt3")
    except ImportError as error:
        return [Missing(name, f"needs evt3: {error}") for name in (FRAME, SIGNED, LOOP)]
    forms = {
        FRAME: (FRAME_WINDOWS, released_products, np.float32),
        SIGNED: (FRAME_WINDOWS, signed_products, np.float64),
        LOOP: (LOOP_WINDOWS, loop_products, np.float32),
    }
    rows: list[Contender | Missing] = []
    for name, (windows, products_of, dtype) in forms.items():
        part = beginning(words, geometry, windows)

        def prepare(part: Any = part, products_of: Any = products_of, dtype: Any = dtype) -> Callable[[], object]:
            table, content = weights.astype(dtype), part.tobytes()
            records = packed(evt3.Decoder(geometry.width, geometry.height).feed(content))
            decoder = evt3.Decoder(geometry.width, geometry.height)

            def run() -> object:
                decoder.feed(content)
                return products_of(records, table)

            return run

        rows.append(Contender(name, prepare, part.nbytes / 1e6, count(part, geometry)))
    return rows


def packed(events: Any) -> NDArray[Any]:
    """Return what a decoder gave as records."""
    records = np.empty(len(events.t), RECORD)
    for name in "txyp":
        records[name] = getattr(events, name)
    return records


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


def released_products(events: NDArray[Any], weights: NDArray[np.float32]) -> list[float]:
    """Compute ELP as the paper's code for the EVK4 does (``EVK4_ELP/evk4_vis.py`` of its authors' repository).

    Events are first cut to a region (here: the whole sensor), windows of 1 ms are closed at both ends, each polarity is
    counted per pixel in eight bits, and each count image is multiplied with the Laplacian, of 32 bits, and summed.
    """
    height, width = weights.shape
    inside = (events["y"] >= 0) & (events["y"] < height) & (events["x"] >= 0) & (events["x"] < width)
    events = events[inside]
    answers = []
    for begin_us in range(int(events["t"][0]), int(events["t"][-1]), WINDOW_US):
        first = np.searchsorted(events["t"], begin_us, side="left")
        last = np.searchsorted(events["t"], begin_us + WINDOW_US, side="right")
        if last - first < FEWEST_EVENTS:
            continue
        counts = []
        for polarity in (1, 0):
            image = np.zeros(weights.shape, np.uint8)
            ones = events[first:last][events["p"][first:last] == polarity]
            np.add.at(image, (ones["y"], ones["x"]), 1)
            counts.append(image)
        positive, negative = counts
        answers.append(float(np.sum(weights * negative) - np.sum(weights * positive)))
    return answers


def by_windows(events: NDArray[Any], product: Callable[[NDArray[Any]], float]) -> list[float]:
    """Apply a product to each window of a stretch of events."""
    t = events["t"]
    edges = np.searchsorted(t, np.arange(t[0], t[-1] + WINDOW_US, WINDOW_US))
    return [product(events[begin:end]) for begin, end in pairwise(edges.tolist())]


def signed_products(events: NDArray[Any], weights: NDArray[np.float64]) -> list[float]:
    """Compute ELP by one signed event frame a window, numpy's fastest way to make one, and one product."""

    def product(window: NDArray[Any]) -> float:
        pixel = window["y"].astype(np.int64) * weights.shape[1] + window["x"]
        frame = np.bincount(pixel, np.where(window["p"] == 1, 1.0, -1.0), minlength=weights.size)
        return -float(np.dot(frame, weights.reshape(-1)))

    return by_windows(events, product)


def loop_products(events: NDArray[Any], weights: NDArray[np.float32]) -> list[float]:
    """Compute ELP as the paper's code for the DAVIS does: each polarity counted event by event, then two products."""

    def product(window: NDArray[Any]) -> float:
        positive, negative = (np.zeros(weights.shape, np.uint8) for _ in range(2))
        for column, row, on in zip(window["x"], window["y"], window["p"], strict=True):
            counts = positive if on == 1 else negative
            counts[row, column] += 1
        return -float((positive * weights).sum() - (negative * weights).sum())

    return by_windows(events, product)
