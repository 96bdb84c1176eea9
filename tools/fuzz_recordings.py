"""Recordings whose bytes are damaged, through all that reads a camera's words: ``tools/fuzz_recordings.py FILE ...``.

Each mutation takes a stretch of a recording's *bytes* and flips bits, cuts bytes out (an odd number shifts every word
behind), splices in bytes from elsewhere, repeats blocks and exchanges them, as often as chance will have it. Decoders
and windows live on from mutation to mutation, as they would behind a bad cable. After each:

* all kernels of the encoding (word by word, and by blocks) must have given the same windows, columns, counters and
  registers, however they were fed: in one piece here, in pieces cut at random there;
* what the windows counted must be what the decoder found: events inside and out, refused ones, and each polarity;
* the weight table lies between two pages that may not be touched, flush with the second, so that a look-up beyond its
  end is a crash and not a number; scratch memory and buckets lie between guards of a known value.

Exits 1 at the first difference, with the seed that shows it again.
"""

from __future__ import annotations

import argparse
import ctypes
import mmap
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from fuzz_words import DTYPES, KERNELS, Broken, Guarded

from elpd.events.evt2 import Evt2Decoder, Evt21Decoder
from elpd.events.evt3 import Evt3Decoder
from elpd.events.evt3_fast import evt3_decoder
from elpd.events.registers import EVENTS, X_OUT_OF_RANGE, Y_OUT_OF_RANGE
from elpd.events.stream import open_recording
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs
from elpd.vision.elp import ElpWindows
from elpd.vision.elp_windows import EARLY, N_CAPPED, N_OFF, N_ON, OUTSIDE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.events.decoder import WordDecoder

SENSOR = Geometry(1280, 720)
WINDOW_US = 10_000
STRETCH_BYTES = 12_000
MUTATIONS = 8
DECODERS: dict[Encoding, tuple[Any, ...]] = {
    Encoding.EVT3: (Evt3Decoder, evt3_decoder),
    Encoding.EVT2: (Evt2Decoder,),
    Encoding.EVT21: (Evt21Decoder,),
}


def main() -> int:
    """Damage each recording equally often."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--mutated", type=int, default=10_000, help="damaged stretches, of all recordings together")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    each = -(-arguments.mutated // len(arguments.recordings))
    for path in arguments.recordings:
        reader = open_recording(path)
        packet = next(iter(reader.packets(1 << 26)))
        encoding, content = packet.encoding, packet.data.tobytes()
        reader.close()
        if encoding not in DTYPES:
            print(f"{path.name}: no words of a camera")
            continue
        bench = Bench(encoding)
        for seed in range(arguments.seed, arguments.seed + each):
            try:
                bench.feed(mutated(content, np.random.default_rng(seed)), np.random.default_rng(seed))
            except Broken as broken:
                print(f"{path.name}: {broken} (seed {seed})")
                return 1
        bench.check_guards()
        print(f"{path.name}: {each} mutations, {bench.words} words, {bench.events} events: all agree", flush=True)
    return 0


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a stretch of bytes, damaged."""

    def somewhere(size: int, length: int) -> int:
        return int(rng.integers(0, max(size - length, 1)))

    begin = somewhere(len(content), STRETCH_BYTES)
    stretch = bytearray(content[begin : begin + STRETCH_BYTES])
    for _ in range(int(rng.integers(1, MUTATIONS))):
        length = int(rng.integers(1, 400))
        at = somewhere(len(stretch), length)
        match int(rng.integers(0, 6)):
            case 0:
                for bit in rng.integers(0, 8 * len(stretch), int(rng.integers(1, 200))).tolist():
                    stretch[bit // 8] ^= 1 << bit % 8
            case 1:
                del stretch[at : at + length]
            case 2:
                source = somewhere(len(content), length)
                stretch[at:at] = content[source : source + length]
            case 3:
                stretch[at:at] = stretch[at : at + length] * int(rng.integers(1, 6))
            case 4:
                stretch[at : at + length] = bytes([int(rng.choice([0x00, 0xFF, 0x99]))]) * length
            case _:
                stretch = stretch[at:] + stretch[:at]
    return bytes(stretch)


class Bench:
    """Everything that reads an encoding, side by side."""

    def __init__(self, encoding: Encoding) -> None:
        rng = np.random.default_rng(0)
        weights = rng.integers(-32766, 32767, (SENSOR.height, SENSOR.width))
        inside = rng.random(weights.shape) < 0.6
        self._encoding = encoding
        self._guards: list[Guarded] = []
        self._tables: list[tuple[NDArray[np.int16], NDArray[np.int16]]] = []
        self._meters = [
            [self._meter(weights, inside, kernels[capped], capped=capped) for kernels in KERNELS[encoding]]
            for capped in (False, True)
        ]
        self._decoders: list[WordDecoder] = [decoder(SENSOR) for decoder in DECODERS[encoding]]
        self._counted = np.zeros((2, 3), np.int64)
        self._found = np.zeros(3, np.int64)
        self._inside = inside
        self.words = self.events = 0

    def _meter(self, weights: NDArray[Any], inside: NDArray[np.bool_], kernel: Any, *, capped: bool) -> ElpWindows:
        meter = ElpWindows(weights, inside, window_us=WINDOW_US, rate_cap=capped)
        meter._words[self._encoding] = kernel  # noqa: SLF001  (the tool looks inside)
        whole = meter._table  # noqa: SLF001
        meter._table = between_forbidden_pages(whole)  # noqa: SLF001
        self._tables.append((meter._table, whole))  # noqa: SLF001
        scratch = [Guarded.of(one) for one in (meter._bucket, *meter._pending)]  # noqa: SLF001
        meter._bucket, *pending = (one.inner for one in scratch)  # noqa: SLF001
        meter._pending = (pending[0], pending[1])  # noqa: SLF001
        self._guards += scratch
        return meter

    def feed(self, content: bytes, rng: np.random.Generator) -> None:
        """Let everybody read; raise ``Broken`` where they differ."""
        dtype = DTYPES[self._encoding]
        words = np.frombuffer(content[: len(content) // np.dtype(dtype).itemsize * np.dtype(dtype).itemsize], dtype)
        cuts = np.sort(rng.integers(0, words.size + 1, int(rng.integers(0, 8)))).tolist()
        columns = [read(one, words, cuts if k else []) for k, one in enumerate(self._decoders)]
        for other in columns[1:]:
            if not all(np.array_equal(a, b) for a, b in zip(columns[0], other, strict=True)):
                raise Broken("columns differ")
        self._check_states("decoders", [one._state for one in self._decoders])  # noqa: SLF001
        for capped, meters in enumerate(self._meters):
            rows = [sum_up(one, words, self._encoding, cuts if k else []) for k, one in enumerate(meters)]
            if any(not np.array_equal(rows[0], other) for other in rows[1:]):
                raise Broken(f"windows differ, rate cap {capped}")
            self._check_states("windows", [one._window[:5] for one in meters])  # noqa: SLF001
            if any(meters[0].counters != other.counters for other in meters[1:]):
                raise Broken(f"counters differ, rate cap {capped}")
            self._counted[capped] += [rows[0][name].sum() for name in ("n_on", "n_off", "n_capped")]
            self._check_count(meters[0], self._counted[capped])
        self.words += words.size
        self.events += columns[0][0].size

    def _check_count(self, meter: ElpWindows, closed: NDArray[np.int64]) -> None:
        """Raise ``Broken`` unless windows, early and outside events together are what the decoder found."""
        window, state = meter._window, self._decoders[0]._state  # noqa: SLF001
        counted = closed.sum() + window[[N_ON, N_OFF, N_CAPPED, EARLY, OUTSIDE]].sum()
        found = state[[EVENTS, X_OUT_OF_RANGE, Y_OUT_OF_RANGE]].sum()
        if counted != found:
            raise Broken(f"windows counted {counted} events, and the decoder {found}")

    def _check_states(self, what: str, states: list[NDArray[np.int64]]) -> None:
        if any(not np.array_equal(states[0], other) for other in states[1:]):
            raise Broken(f"registers of {what} differ")

    def check_guards(self) -> None:
        """Raise ``Broken`` if a guard or a table has changed."""
        for guard in self._guards:
            guard.check("scratch memory")
        if not all(np.array_equal(*pair) for pair in self._tables):
            raise Broken("a table was written to")


def read(decoder: WordDecoder, words: NDArray[Any], cuts: list[int]) -> list[NDArray[Any]]:
    """Decode pieces; return whole columns."""
    parts = [[column.copy() for column in decoder.feed(piece)] for piece in np.split(words, cuts)]
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def sum_up(meter: ElpWindows, words: NDArray[Any], encoding: Encoding, cuts: list[int]) -> NDArray[Any]:
    """Sum pieces; return all windows that closed."""
    packets = [CameraPacket(piece, encoding, HostNs(0)) for piece in np.split(words, cuts)]
    return np.concatenate([meter.feed(packet).copy() for packet in packets])


def between_forbidden_pages(table: NDArray[np.int16]) -> NDArray[np.int16]:
    """Copy a table to the very end of pages behind which, and before which, nobody may read."""
    size = -(-table.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
    memory = mmap.mmap(-1, size + 2 * mmap.PAGESIZE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    room = np.frombuffer(memory, np.uint8)
    libc = ctypes.CDLL(None, use_errno=True)
    for begin in (0, size + mmap.PAGESIZE):
        if libc.mprotect(ctypes.c_void_p(room.ctypes.data + begin), ctypes.c_size_t(mmap.PAGESIZE), 0):
            raise OSError(ctypes.get_errno(), "mprotect")
    copy = room[mmap.PAGESIZE + size - table.nbytes : mmap.PAGESIZE + size].view(np.int16)
    copy[:] = table
    return copy


if __name__ == "__main__":
    sys.exit(main())
