"""Ten million random words, and recordings damaged in every way, through every kernel that reads a camera's words.

    tools/fuzz_words.py [RECORDING ...] [--words N] [--seed S]

Nothing may crash, nothing may be written outside the arrays that a kernel was given (each lies between guards of a
known value), and all kernels of an encoding must agree to the bit: sums, windows, counters, decoder registers, buckets
of the rate cap, decoded columns and, of EVT3, first ON times. Random words reach every branch; damaged recordings (bits
flipped, words lost, doubled, moved, overwritten with zeros, ones or padding) reach the long runs that random words
never make. Prints one line per kind of stream; exits 1 at the first difference, with the seed that shows it again.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events import registers
from elpd.events.evt2 import decode_evt2, decode_evt21
from elpd.events.evt3 import decode
from elpd.events.evt3_lists import EVENTS, LISTS
from elpd.events.simd import available
from elpd.events.stream import open_recording
from elpd.records import Encoding
from elpd.vision import elp_addresses, elp_lanes, elp_words
from elpd.vision.elp_weights import STRIDE, weight_table
from elpd.vision.elp_windows import NEVER, new_window
from elpd.vision.latch import EMPTY, new_latch
from elpd.vision.latch_lanes import latch_kernel, scratch
from elpd.vision.latch_words import evt3_to_latch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

GUARD = 64
GUARD_VALUE = 77
PIECE = 40_000
WIDTH, HEIGHT = 1280, 720
WINDOWS_US = np.arange(4096) * 5000
INTERVAL_US = (5_000_000, 1 << 30)
DTYPES = {Encoding.EVT3: np.uint16, Encoding.EVT2: np.uint32, Encoding.EVT21: np.uint64}
KERNELS: dict[Encoding, list[tuple[Callable[..., int], Callable[..., int]]]] = {
    Encoding.EVT3: [(elp_words.evt3_to_windows, elp_words.evt3_to_windows_capped), elp_lanes.kernels()],
    Encoding.EVT2: [(elp_addresses.evt2_to_windows, elp_addresses.evt2_to_windows_capped)],
    Encoding.EVT21: [(elp_addresses.evt21_to_windows, elp_addresses.evt21_to_windows_capped)],
}
DECODERS: dict[Encoding, list[Callable[..., tuple[int, int]]]] = {
    Encoding.EVT3: [decode],
    Encoding.EVT2: [decode_evt2],
    Encoding.EVT21: [decode_evt21],
}
if available():
    from elpd.events.evt3_fast import decode_blocks

    DECODERS[Encoding.EVT3].append(decode_blocks)


class Broken(Exception):  # noqa: N818  (a finding)
    """Two kernels differ, or a guard was overwritten."""


@dataclass(frozen=True)
class Guarded:
    """An array between guards."""

    inner: NDArray[Any]
    around: NDArray[Any]

    @classmethod
    def of(cls, values: NDArray[Any]) -> Guarded:
        """Copy *values* to between two guards."""
        around = np.full(values.size + 2 * GUARD, GUARD_VALUE, values.dtype)
        inner = around[GUARD : GUARD + values.size].reshape(values.shape)
        inner[...] = values
        return cls(inner, around)

    def check(self, name: str) -> None:
        """Raise ``Broken`` if a guard has changed."""
        if (self.around[:GUARD] != GUARD_VALUE).any() or (self.around[-GUARD:] != GUARD_VALUE).any():
            raise Broken(f"{name}: a guard was overwritten")


def main() -> int:
    """Run all kinds of stream."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--words", type=int, default=10_000_000, help="random words, of each encoding")
    parser.add_argument("--damaged", type=int, default=20, help="damaged stretches of each recording")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for name, encoding, streams in kinds(arguments):
        n_words = n_events = 0
        for seed, words in streams:
            try:
                n_events += run(words, encoding, np.random.default_rng(seed))
            except Broken as broken:
                print(f"{name}: {broken} (seed {seed}, {words.size} words)")
                return 1
            n_words += words.size
        print(f"{name}: {n_words} words, {n_events} events, every kernel agrees and no guard was touched", flush=True)
    return 0


def kinds(arguments: argparse.Namespace) -> Iterator[tuple[str, Encoding, Iterator[tuple[int, NDArray[Any]]]]]:
    """Yield each kind of stream with its name: seeds and words."""
    for encoding in DTYPES:
        yield f"random {encoding.value}", encoding, random_streams(encoding, arguments.words, arguments.seed)
    for path in arguments.recordings:
        reader = open_recording(path)
        packet = next(iter(reader.packets(1 << 26)))
        words = packet.data.copy()
        reader.close()
        if packet.encoding in DTYPES:
            yield f"damaged {path.name}", packet.encoding, damaged(words, arguments.damaged, arguments.seed)


def random_streams(encoding: Encoding, n_words: int, seed: int) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield random words: all bits, and in turn with times rare, so that something is summed before time jumps."""
    for done, begin in enumerate(range(0, n_words, PIECE)):
        rng = np.random.default_rng(seed + done)
        dtype = DTYPES[encoding]
        words = rng.integers(0, np.iinfo(dtype).max, min(PIECE, n_words - begin), dtype, endpoint=True)
        if done % 2:
            top = dtype(8 * words.dtype.itemsize - 4)
            rare = (words >> top == 0x8) & (rng.random(words.size) < 0.995)
            event = dtype(0x2 if encoding is Encoding.EVT3 else 1) << top
            words[rare] = words[rare] & dtype((1 << int(top)) - 1) | event
        yield seed + done, words


def damaged(words: NDArray[Any], times: int, seed: int) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield stretches of a recording, each damaged in several ways."""
    for done in range(times):
        rng = np.random.default_rng(seed + done)
        begin = int(rng.integers(0, max(words.size - PIECE, 1)))
        yield seed + done, damage(words[begin : begin + PIECE].copy(), rng)


def damage(words: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    """Return words with bits flipped, stretches overwritten, words lost, doubled and moved."""
    dtype = words.dtype.type
    hit = rng.integers(0, words.size, int(rng.integers(1, 400)))
    words[hit] ^= dtype(1) << rng.integers(0, 8 * words.dtype.itemsize, hit.size).astype(words.dtype)
    for _ in range(int(rng.integers(0, 6))):
        at, length = int(rng.integers(0, words.size)), int(rng.integers(1, 300))
        words[at : at + length] = rng.choice([0, np.iinfo(words.dtype).max, 0x9999]).astype(words.dtype)
    order = np.sort(rng.integers(0, words.size, words.size - int(rng.integers(0, 200))))
    if rng.random() < 0.5:
        words = words[order]
    at = int(rng.integers(0, words.size))
    return np.concatenate((words[at:], words[:at])) if rng.random() < 0.3 else words


def run(words: NDArray[Any], encoding: Encoding, rng: np.random.Generator) -> int:
    """Put a stream through every kernel of its encoding, cut at random; return how many events it holds."""
    cuts = np.sort(rng.integers(0, words.size, int(rng.integers(0, 20))))
    weights = rng.integers(-32766, 32767, (HEIGHT, WIDTH))
    table = weight_table(weights, rng.random((HEIGHT, WIDTH)) < 0.6)
    for capped in (False, True):
        seen = [windows(pair[capped], words, cuts, table, capped=capped) for pair in KERNELS[encoding]]
        agree("windows" + " with the rate cap" * capped, seen)
    columns = [decoded(kernel, words, cuts) for kernel in DECODERS[encoding]]
    agree("columns", columns)
    if encoding is Encoding.EVT3:
        agree("first ON times", [first_times(kernel, words, cuts) for kernel in (evt3_to_latch, latch_kernel())])
    return int(columns[0][0].size)


def agree(what: str, seen: list[list[NDArray[Any]]]) -> None:
    """Raise ``Broken`` unless all are the same."""
    for other in seen[1:]:
        for one, two in zip(seen[0], other, strict=True):
            if not np.array_equal(one, two):
                raise Broken(f"{what} differ")


def windows(
    kernel: Callable[..., int], words: NDArray[Any], cuts: NDArray[np.int64], table: NDArray[np.int16], *, capped: bool
) -> list[NDArray[Any]]:
    """Sum a stream; return everything that the kernel leaves behind."""
    table = Guarded.of(table)
    own = {
        "state": Guarded.of(registers.new_state()),
        "triggers": Guarded.of(np.zeros((16, 3), np.int64)),
        "window": Guarded.of(new_window()),
        "rows": Guarded.of(np.zeros((WINDOWS_US.size, 7), np.int64)),
        "bucket": Guarded.of(np.full((HEIGHT + 1) * STRIDE if capped else 1, NEVER, np.int64)),
    }
    scratch = {"lists": Guarded.of(np.zeros(LISTS, np.uint32)), "ledger": Guarded.of(elp_lanes.scratch()[1])}
    window = own["window"].inner
    window[6], window[15] = WINDOWS_US.size, 1
    for piece in np.split(words, cuts):
        kernel(
            piece, 0, own["state"].inner, own["triggers"].inner, table.inner, window, WINDOWS_US, own["rows"].inner,
            NEVER, own["bucket"].inner, scratch["lists"].inner, scratch["ledger"].inner,
        )  # fmt: skip
    for name, array in {**own, **scratch, "table": table}.items():
        array.check(name)
    return [array.inner.copy() for array in own.values()]


def decoded(kernel: Callable[..., tuple[int, int]], words: NDArray[Any], cuts: NDArray[np.int64]) -> list[NDArray[Any]]:
    """Decode a stream; return its columns and registers."""
    state, triggers = Guarded.of(registers.new_state()), Guarded.of(np.zeros((16, 3), np.int64))
    room = EVENTS + 64
    out = [Guarded.of(np.zeros(room, dtype)) for dtype in (np.int64, np.uint16, np.uint16, np.uint8)]
    is_blocks = available() and kernel is decode_blocks
    scratch = [Guarded.of(np.zeros(LISTS, np.uint32)), Guarded.of(elp_lanes.scratch()[1])] if is_blocks else []
    columns: list[list[NDArray[Any]]] = [[] for _ in out]
    for piece in np.split(words, cuts):
        position = 0
        while position < piece.size:
            position, n = kernel(
                piece, position, state.inner, WIDTH, HEIGHT, *(one.inner for one in out), triggers.inner,
                *(one.inner for one in scratch),
            )  # fmt: skip
            for column, one in zip(columns, out, strict=True):
                column.append(one.inner[:n].copy())
    for one in (state, triggers, *out, *scratch):
        one.check("decoder")
    empty = [np.zeros(0, np.int64)]
    return [*(np.concatenate(column or empty) for column in columns), state.inner.copy(), triggers.inner.copy()]


def first_times(kernel: Callable[..., None], words: NDArray[Any], cuts: NDArray[np.int64]) -> list[NDArray[Any]]:
    """Latch a stream, some of it outside the interval; return everything that the kernel leaves behind."""
    latch = [Guarded.of(one) for one in new_latch(WIDTH, HEIGHT)]
    memory = [Guarded.of(one) for one in scratch()]
    state, triggers = Guarded.of(registers.new_state()), Guarded.of(np.zeros((16, 3), np.int64))
    for piece in np.split(words, cuts):
        kernel(
            piece, 0, state.inner, triggers.inner, *INTERVAL_US, WIDTH, HEIGHT, *(one.inner for one in latch),
            *(one.inner for one in memory),
        )  # fmt: skip
    for one in (state, triggers, *latch, *memory):
        one.check("first ON times")
    slots, full, *counted = (one.inner for one in latch)
    has_all = (slots.reshape(3, -1) != EMPTY).all(axis=0).reshape(-1, 32)
    if ((full[:, None] >> np.arange(32, dtype=np.uint32) & 1).astype(bool) & ~has_all).any():
        raise Broken("a pixel that has room is said to be full")
    not_ours = [registers.EVENTS, registers.X_OUT_OF_RANGE, registers.Y_OUT_OF_RANGE]  # the latch counts by itself
    return [slots, *counted, np.delete(state.inner, not_ours)]


if __name__ == "__main__":
    sys.exit(main())
