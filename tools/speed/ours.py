"""Our kernels: decoding, and decoding fused with what is wanted of the events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.evt2_encode import Evt2Encoder, Evt21Encoder
from elpd.events.evt3 import Evt3Decoder
from elpd.events.evt3_fast import Evt3BlockDecoder
from elpd.events.simd import available
from elpd.events.stream import PacketDecoder
from elpd.records import CameraPacket, Encoding
from elpd.units import HostNs
from elpd.vision import elp_words
from elpd.vision.elp import ElpWindows
from elpd.vision.first_events import FirstEventMap
from speed.contender import Contender, Missing
from speed.stream import WINDOW_US, events, pieces

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd.records import Geometry

NO_SIMD = "this processor has neither AVX-512 nor AVX2"
SQUARE = 400
CAMERA_DTYPE = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])  # 13 bytes, as neuromorphic-drivers
SOME_WORDS = 6_000_000
"""Contenders that do not read EVT3 run on the beginning, translated; memory would not hold all of it."""


def ours(words: NDArray[np.uint16], n_events: int, geometry: Geometry) -> list[Contender | Missing]:
    """Return our rows for a stream."""
    cut = pieces(words)
    packets = [CameraPacket(piece, Encoding.EVT3, HostNs(0)) for piece in cut]
    megabytes = words.nbytes / 1e6
    weights = np.random.default_rng(1).integers(-1020, 1021, (geometry.height, geometry.width))
    square = np.zeros(weights.shape, np.bool_)
    y, x = (max((side - SQUARE) // 2, 0) for side in weights.shape)
    square[y : y + SQUARE, x : x + SQUARE] = True

    def row(name: str, prepare: Callable[[], Callable[[], object]]) -> Contender:
        return Contender(name, prepare, megabytes, n_events)

    def fused(kernel: Any = None, *, inside: Any = None, rate_cap: bool = False) -> Callable[[], object]:
        meter = ElpWindows(weights, inside, window_us=WINDOW_US, rate_cap=rate_cap)
        if kernel is not None:
            meter._words[Encoding.EVT3] = kernel  # noqa: SLF001  (what another processor would run)
        return feed(meter, packets)

    slow, slow_capped = elp_words.evt3_to_windows, elp_words.evt3_to_windows_capped
    copy = np.empty_like(words)
    rows: list[Contender | Missing] = [row("memcpy", lambda: lambda: np.copyto(copy, words))]
    fast_names = ["elpd fused simd", "elpd fused simd, 400x400", "elpd fused simd, rate cap", "elpd decode simd"]
    if available():
        rows += [
            row(fast_names[0], fused),
            row(fast_names[1], lambda: fused(inside=square)),
            row(fast_names[2], lambda: fused(rate_cap=True)),
            row(fast_names[3], lambda: feed(Evt3BlockDecoder(geometry), cut)),
        ]
    else:
        rows += [Missing(name, NO_SIMD) for name in fast_names]
    rows += [
        row("elpd fused scalar", lambda: fused(slow)),
        row("elpd fused scalar, 400x400", lambda: fused(slow, inside=square)),
        row("elpd fused scalar, rate cap", lambda: fused(slow_capped, rate_cap=True)),
        row("elpd decode scalar", lambda: feed(Evt3Decoder(geometry), cut)),
        row("elpd first events", lambda: first_events(geometry, packets)),
        row("elpd first events, decoded", lambda: first_events_decoded(geometry, packets)),
    ]
    return rows + translated(words[:SOME_WORDS], geometry, weights)


def translated(words: NDArray[np.uint16], geometry: Geometry, weights: NDArray[np.int64]) -> list[Contender | Missing]:
    """Return the rows of other encodings of the same events."""
    columns = events(words, geometry)
    arrays = np.empty(columns.t.size, CAMERA_DTYPE)
    arrays["t"], arrays["x"], arrays["y"], arrays["on"] = columns
    data = {
        "elpd arrays to ELP": (Encoding.ARRAY, arrays, 20_000),
        "elpd fused EVT2": (Encoding.EVT2, Evt2Encoder().encode(*columns), 1 << 15),
        "elpd fused EVT2.1": (Encoding.EVT21, Evt21Encoder().encode(*columns), 1 << 14),
    }
    rows: list[Contender | Missing] = []
    for name, (encoding, whole, size) in data.items():
        packets = [
            CameraPacket(whole[begin : begin + size], encoding, HostNs(0)) for begin in range(0, whole.size, size)
        ]

        def fused(packets: list[CameraPacket] = packets) -> Callable[[], object]:
            return feed(ElpWindows(weights, window_us=WINDOW_US), packets)

        rows.append(Contender(name, fused, whole.nbytes / 1e6, arrays.size))
    return rows


def first_events(geometry: Geometry, packets: list[CameraPacket]) -> Callable[[], object]:
    """Return a run of the temporal map's first stage."""
    first = FirstEventMap(geometry)

    def run() -> None:
        for packet in packets:
            first.add_packet(packet)

    return run


def first_events_decoded(geometry: Geometry, packets: list[CameraPacket]) -> Callable[[], object]:
    """Return a run of the same in two passes: all events of a packet to arrays, then to the map."""
    first, decoder = FirstEventMap(geometry), PacketDecoder(geometry)

    def run() -> None:
        for packet in packets:
            first.add(*decoder.feed(packet))

    return run


def feed(feeder: Any, data: list[Any]) -> Callable[[], object]:
    """Return a run that feeds each of *data*."""

    def run() -> None:
        for piece in data:
            feeder.feed(piece)

    return run
