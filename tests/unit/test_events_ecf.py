"""ECF: chunks that the original wrote, our own there and back, and damage."""

from typing import Any

import naive_ecf
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from elpd.errors import FormatError
from elpd.events.ecf import pack_chunk, unpack_chunk

# Chunks as hdf5_ecf's own encoder writes them, one of each layout, and the events that were put in.
ALL_PACKED = "16000000e80300000000000002e1fef1f101fcf2fdf3ff01780b90000300350060190032000100000000000000000000"
COLUMNS_PACKED = "1d000000320000000000000003f8f204a7098570a065ed548543d0380020"
MASKS = "a000000000000000020000000f2800bf0928000400c400840144020403c403840444050406c4061f41df419f4250439e0a"
THEIRS = {
    ALL_PACKED: [(1000, 5, 9, 1), (1000, 700, 3, 0), (1014, 1, 800, 1), (1300, 1200, 1, 0), (1_000_000, 0, 0, 1)],
    COLUMNS_PACKED: [(50 + (k > 2) * 40, 900 - 90 * k, 77, k % 2) for k in range(7)],
    MASKS: [(2**33, 3 * k if k < 20 else 500 + k, 77, int(k < 30)) for k in range(40)],
}


def rows(events: Any) -> list[tuple[int, ...]]:
    return [tuple(int(event[name]) for name in "txyp") for event in events]


@pytest.mark.parametrize("chunk", THEIRS)
def test_what_the_original_writes_is_read(chunk: str) -> None:
    assert rows(unpack_chunk(bytes.fromhex(chunk))) == THEIRS[chunk]
    assert naive_ecf.unpack_chunk(bytes.fromhex(chunk)) == THEIRS[chunk]


@given(
    first=st.integers(-(2**40), 2**60),
    events=st.lists(
        st.tuples(
            st.one_of(st.sampled_from([0, 0, 0, 14, 15, 16, -1, -300]), st.integers(-(2**50), 2**50)),
            st.integers(0, 2047),
            st.integers(0, 2047),
            st.integers(0, 1),
        ),
        min_size=1,
        max_size=60,
    ),
)
def test_packing_is_undone_by_unpacking(first: int, events: list[tuple[int, int, int, int]]) -> None:
    steps, x, y, p = (np.array(column) for column in zip(*events, strict=True))
    t = first + np.cumsum(steps)
    chunk = pack_chunk(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))
    assert rows(unpack_chunk(chunk)) == list(zip(t.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True))
    assert naive_ecf.unpack_chunk(chunk) == rows(unpack_chunk(chunk))


def test_many_events_of_one_time_are_one_run() -> None:
    t = np.full(60_000, 5)
    chunk = pack_chunk(t, *(np.zeros(60_000, kind) for kind in (np.uint16, np.uint16, np.uint8)))
    assert len(chunk) == 12 + 3 + 3 * 60_000
    assert (unpack_chunk(chunk)["t"] == 5).all()


def _layout(draw: Any, count: int) -> bytes:
    """Return a sound chunk of runs, of any layout, whose runs need not be the longest."""

    def runs(longest: int) -> list[int]:
        left, lengths = count, []
        while left:
            lengths.append(draw(st.integers(1, min(left, longest))))
            left -= lengths[-1]
        return lengths

    packed_x = draw(st.booleans())
    out = (count << 2 | packed_x).to_bytes(4, "little") + draw(st.integers(0, 2**40)).to_bytes(8, "little")
    for run in runs(70):
        out += bytes(0xF0 | nibble for nibble in draw(st.lists(st.integers(0, 15), max_size=4)))
        step = draw(st.integers(0, 14)) << 4
        out += bytes([step | run]) if run < 15 else bytes([step | 15]) + run.to_bytes(2, "little")
    for run in runs(70):
        row = draw(st.integers(0, 2047)) << 5
        out += (row | min(run, 31)).to_bytes(2, "little") + (run.to_bytes(2, "little") if run >= 31 else b"")
    if packed_x:
        return out + draw(st.binary(min_size=(count + 3) // 4 * 6, max_size=(count + 3) // 4 * 6))
    left = count
    while left > 0:
        mask = draw(st.integers(0, 31))
        if mask.bit_count() + 1 > left:
            mask = 0
        out += (draw(st.integers(0, 2000)) << 5 | mask).to_bytes(2, "little")
        left -= mask.bit_count() + 1
    for run in runs(200):
        on = draw(st.integers(0, 1)) << 7
        out += bytes([on | min(run, 127)]) + (run.to_bytes(2, "little") if run >= 127 else b"")
    return out


@given(data=st.data(), count=st.integers(1, 150))
def test_every_layout_is_read_as_its_twin_reads_it(data: Any, count: int) -> None:
    chunk = _layout(data.draw, count)
    assert rows(unpack_chunk(chunk)) == naive_ecf.unpack_chunk(chunk)


@given(data=st.data(), chunk=st.sampled_from([ALL_PACKED, COLUMNS_PACKED, MASKS]))
def test_damage_is_told_or_gives_as_many_events_as_the_chunk_says(data: Any, chunk: str) -> None:
    whole = bytearray.fromhex(chunk)
    for _ in range(data.draw(st.integers(0, 3))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(whole[: data.draw(st.integers(0, len(whole)))])
    try:
        events = unpack_chunk(cut)
    except FormatError:
        return
    assert events.size == int.from_bytes(cut[:4], "little") >> 2
