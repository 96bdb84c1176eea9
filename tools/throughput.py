"""How fast are our kernels beside others', on a real recording: ``tools/throughput.py FILE [--json]``.

Absolute speeds on a shared machine mean little, so what counts here are ratios within a round: every contender runs
once per round, interleaved, over the same bytes, timed by the CPU time of its thread; a ratio is the median over
rounds. The recording's payload is tiled to a useful size, with TIME_HIGH rewritten so that time goes on and no
decoder sees a jump. A memcpy of the same bytes runs along, as the measure of the machine. Contenders get the stream
in 128 KiB pieces, as a camera's USB transfers would bring it, except those that can only read files.

The event-frame contender does what the field's scripts do, from bytes to the same numbers: decode (by the ``evt3``
package), build a frame per 1 ms window, multiply by the weights, sum. It is slow, so it runs on the stream's
beginning and is compared by bytes per second.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from elpd_drivers.formats.raw import write_raw

from elpd.errors import ElpdError, UsageError
from elpd.events.evt3 import Evt3Decoder
from elpd.events.stream import open_recording
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd.vision.elp import ElpWindows

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

Run: TypeAlias = "Callable[[], object]"

PIECE_WORDS = 1 << 16
WINDOW_US = 1000
FRAME_WINDOWS = 40
PEERS = ("evt3", "faery")
NO_SIMD = "there is no SIMD kernel in this version"


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="an EVT3 recording")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--mb", type=float, default=16.0, help="size to tile the payload to")
    arguments = parser.parse_args()
    try:
        answer = measure(arguments.file, arguments.rounds, arguments.mb)
    except ElpdError as error:
        if arguments.json:
            print(json.dumps({"error": {"kind": error.kind, "message": str(error)}}))
        print(f"throughput: {error}", file=sys.stderr)
        return error.exit_code
    if arguments.json:
        print(json.dumps(answer))
        return 0
    for row in answer["rows"]:
        print(f"{row['name']:<34}{row['mb_s']:>9.0f} MB/s{row['mev_s']:>9.1f} Mev/s")
    for name, ratio in answer["ratios"].items():
        print(f"{name:<40}" + (f"{ratio:6.2f}" if ratio is not None else f"  none: {answer['reasons'][name]}"))
    return 0


def measure(path: Path, rounds: int, megabytes: float) -> dict[str, Any]:
    """Run every contender *rounds* times, interleaved; return rows, ratios and the reasons for missing ones."""
    geometry, payload = _payload(path)
    words = _tiled(payload, geometry, round(megabytes * 1e6 / 2))
    events = _count(words, geometry)
    weights = np.random.default_rng(1).integers(-1020, 1021, (geometry.height, geometry.width))
    with tempfile.TemporaryDirectory() as folder:
        tiled = Path(folder) / "tiled.raw"
        write_raw(tiled, geometry, [words], {})
        contenders, missing = _contenders(words, tiled, geometry, weights)
        speeds: dict[str, list[float]] = {name: [] for name in contenders}
        for prepare, _ in contenders.values():
            prepare()()
        for _ in range(rounds):
            for name, (prepare, data) in contenders.items():
                run = prepare()
                begun = time.thread_time()
                run()
                speeds[name].append(data.nbytes / (time.thread_time() - begun) / 1e6)
    per_byte = {name: _count(data, geometry) / data.nbytes for name, (_, data) in contenders.items()}
    ratios, reasons = _ratios(speeds, missing)
    return {
        "file": path.name,
        "bytes": words.nbytes,
        "events": events,
        "rounds": rounds,
        "rows": [
            {"name": name, "mb_s": round(median(values), 1), "mev_s": round(median(values) * per_byte[name], 2)}
            for name, values in speeds.items()
        ],
        "ratios": ratios,
        "reasons": reasons,
    }


def _contenders(
    words: NDArray[np.uint16], tiled: Path, geometry: Geometry, weights: NDArray[np.int64]
) -> tuple[dict[str, tuple[Callable[[], Run], NDArray[np.uint16]]], dict[str, str]]:
    """Return what can run here and the words it reads, and why the rest cannot.

    Each is a function that makes what it needs (a decoder, a weight table) and returns what is then timed.
    """
    pieces = np.split(words, range(PIECE_WORDS, words.size, PIECE_WORDS))
    as_bytes = [piece.tobytes() for piece in pieces]
    packets = [CameraPacket(piece, Encoding.EVT3, HostNs(0)) for piece in pieces]
    copy = np.empty_like(words)
    square = np.zeros(weights.shape, np.bool_)
    y, x = (max((side - 400) // 2, 0) for side in weights.shape)
    square[y : y + 400, x : x + 400] = True

    def feed(feeder: Any, data: list[Any]) -> Run:
        def run() -> None:
            for piece in data:
                feeder.feed(piece)

        return run

    def fused(*, inside: NDArray[np.bool_] | None = None, rate_cap: bool = False) -> Run:
        return feed(ElpWindows(weights, inside, window_us=WINDOW_US, rate_cap=rate_cap), packets)

    contenders: dict[str, tuple[Callable[[], Run], NDArray[np.uint16]]] = {
        "memcpy": (lambda: lambda: np.copyto(copy, words), words),
        "elpd decode": (lambda: feed(Evt3Decoder(geometry), pieces), words),
        "elpd fused scalar": (fused, words),
        "elpd fused scalar, 400x400": (lambda: fused(inside=square), words),
        "elpd fused scalar, rate cap": (lambda: fused(rate_cap=True), words),
    }
    missing = {}
    try:
        evt3 = importlib.import_module("evt3")
    except ImportError:
        missing["evt3"] = "the evt3 package is not installed"
    else:
        beginning = _beginning(words, geometry)
        size = (geometry.width, geometry.height)
        contenders["evt3 decode"] = (lambda: feed(evt3.Decoder(*size), as_bytes), words)
        contenders["evt3 + numpy event frame"] = (
            lambda: lambda: _event_frames(evt3.Decoder(*size), beginning.tobytes(), weights),
            beginning,
        )
    try:
        faery = importlib.import_module("faery.extension")
    except ImportError:
        missing["faery"] = "the faery package is not installed"
    else:

        def file_peer() -> None:
            with faery.evt.Decoder(tiled, (geometry.width, geometry.height), "evt3") as decoder:
                for _ in decoder:
                    pass

        contenders["faery decode"] = (lambda: file_peer, words)
    return contenders, missing


def _ratios(speeds: dict[str, list[float]], missing: dict[str, str]) -> tuple[dict[str, float | None], dict[str, str]]:
    """Return the median over rounds of each ratio, and a reason for each that has none."""
    peers = [speeds[f"{name} decode"] for name in PEERS if f"{name} decode" in speeds]
    best_peer = [max(values) for values in zip(*peers, strict=True)] if peers else None
    evt3, frame = speeds.get("evt3 decode"), speeds.get("evt3 + numpy event frame")
    fused = speeds["elpd fused scalar"]
    no_peer = "; ".join(missing.values())
    wanted = {
        "fused_simd_vs_best_peer_decode": (None, best_peer, NO_SIMD),
        "fused_scalar_vs_best_peer_decode": (fused, best_peer, no_peer),
        "fused_simd_vs_numpy_event_frame": (None, frame, NO_SIMD),
        "decode_vs_best_peer": (speeds["elpd decode"], best_peer, no_peer),
        "fused_scalar_vs_evt3_decode": (fused, evt3, no_peer),
        "fused_scalar_vs_numpy_event_frame": (fused, frame, no_peer),
    }
    ratios: dict[str, float | None] = {}
    reasons = {}
    for name, (ours, theirs, reason) in wanted.items():
        if ours is None or theirs is None:
            ratios[name] = None
            reasons[name] = reason
        else:
            ratios[name] = round(median(a / b for a, b in zip(ours, theirs, strict=True)), 3)
    return ratios, reasons


def _payload(path: Path) -> tuple[Geometry, NDArray[np.uint16]]:
    reader = open_recording(path)
    try:
        packets = [packet.data.copy() for packet in reader.packets() if packet.encoding is Encoding.EVT3]
        if not packets:
            raise UsageError(f"{path} holds no EVT3 words; the peers read nothing else")
        return reader.geometry or Geometry(1280, 720), np.concatenate(packets)
    finally:
        reader.close()


def _tiled(words: NDArray[np.uint16], geometry: Geometry, n_words: int) -> NDArray[np.uint16]:
    """Repeat the payload, whole times, with time going on from one copy to the next."""
    high = words >> 12 == 0x8
    highs = (words[high] & 0xFFF).astype(np.int64)
    decoder = Evt3Decoder(geometry)
    decoder.feed(words)
    last_us = decoder.time_us
    if last_us is None:
        raise UsageError("the recording holds no time at all")
    span = (last_us >> 12) - int(highs[0]) + 1
    copies = []
    for copy in range(max(-(-n_words // words.size), 1)):
        shifted = words.copy()
        shifted[high] = 0x8000 | (highs + copy * span) & 0xFFF
        copies.append(shifted)
    return np.concatenate(copies)


def _count(words: NDArray[np.uint16], geometry: Geometry) -> int:
    decoder = Evt3Decoder(geometry)
    return sum(decoder.feed(piece).t.size for piece in np.split(words, range(PIECE_WORDS, words.size, PIECE_WORDS)))


def _beginning(words: NDArray[np.uint16], geometry: Geometry) -> NDArray[np.uint16]:
    """Return the words of the first ``FRAME_WINDOWS`` windows."""
    decoder = Evt3Decoder(geometry)
    begin_us = None
    for end in range(1024, words.size, 1024):
        t = decoder.feed(words[end - 1024 : end]).t
        begin_us = int(t[0]) if begin_us is None and t.size else begin_us
        if begin_us is not None and t.size and t[-1] >= begin_us + FRAME_WINDOWS * WINDOW_US:
            return words[:end]
    return words


def _event_frames(decoder: Any, data: bytes, weights: NDArray[np.int64]) -> list[float]:
    """Compute ELP as scripts do: a signed event frame per window, times the weights."""
    events = decoder.feed(data)
    t = np.asarray(events.t)
    pixel = np.asarray(events.y).astype(np.int64) * weights.shape[1] + np.asarray(events.x)
    sign = np.where(np.asarray(events.p) == 1, 1.0, -1.0)
    edges = np.searchsorted(t, np.arange(t[0], t[-1] + WINDOW_US, WINDOW_US))
    elp = []
    for begin, end in pairwise(edges.tolist()):
        frame = np.bincount(pixel[begin:end], sign[begin:end], minlength=weights.size)
        elp.append(-float(np.dot(frame, weights.reshape(-1))))
    return elp


if __name__ == "__main__":
    sys.exit(main())
