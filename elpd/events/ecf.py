"""ECF, the compression of Prophesee's HDF5 files: a chunk of events to bytes and back.

A chunk is ``u32 count << 2 | packed_all << 1 | packed_x``, the first time in 64 bits, then times, then addresses.
Times are runs of events of one time, a byte each: four bits of step and four of count (15: two bytes of count follow);
longer steps come before, four bits a byte behind 0xF. Addresses are 24 bits an event, four in three words
(``packed_all``), or runs of rows and then columns with polarities in twelve bits (``packed_x``) or columns by a mask of
five neighbours and runs of polarities. All of it is read; what is written is ``packed_all``, the simplest.

Described by github.com/prophesee-ai/hdf5_ecf, whose own library need not be there. A step back in time is written as
the 64-bit complement that adds up to it, where the original writes the time before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError
from elpd.events.jit import kernel
from elpd.events.layout import packed

if TYPE_CHECKING:
    from numpy.typing import NDArray

MOST_EVENTS = 65_535
HEAD_BYTES = 12
SPARE_BYTES = 16
"""The last group of addresses is read as if whole; what lies beyond the end is zero."""
_BYTES = 'Array(uint8, 1, "C", readonly=True)'


def unpack_chunk(data: bytes) -> NDArray[Any]:
    """Return a chunk's events (``EVENT``). Raises ``FormatError`` if it is damaged."""
    if len(data) < HEAD_BYTES:
        raise FormatError(f"an ECF chunk of {len(data)} bytes; {HEAD_BYTES} are its head")
    count = int.from_bytes(data[:4], "little") >> 2
    if count > MOST_EVENTS:
        raise FormatError(f"an ECF chunk says that it holds {count} events; {MOST_EVENTS} are the most")
    out = (np.empty(count, np.int64), np.empty(count, np.uint16), np.empty(count, np.uint16), np.empty(count, np.uint8))
    padded = np.zeros(len(data) + SPARE_BYTES, np.uint8)
    padded[: len(data)] = np.frombuffer(data, np.uint8)
    if not decode(padded, len(data), *out):
        raise FormatError("an ECF chunk is damaged: its runs do not add up to its events")
    return packed(*out)


def pack_chunk(t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8]) -> bytes:
    """Return up to 65,535 events, one at least, as a chunk. Addresses have 11 bits."""
    count = t.shape[0]
    assert 0 < count <= MOST_EVENTS, "a chunk holds some events"
    head = (count << 2 | 2).to_bytes(4, "little") + int(t[0]).to_bytes(8, "little", signed=True)
    times = np.empty(19 * count, np.uint8)
    times = times[: encode_times(np.ascontiguousarray(t), times)]
    values = np.zeros((count + 3) // 4 * 4, np.uint32)
    values[:count] = y.astype(np.uint32) << 12 | x.astype(np.uint32) << 1 | p
    a, b, c, d = values.reshape(-1, 4).T
    words = np.stack((a << 8 | b & 0xFF, b >> 8 << 16 | c & 0xFFFF, c >> 16 << 24 | d), axis=1)
    return b"".join((head, times.tobytes(), words.astype("<u4").tobytes()))


@kernel("int64(int64[::1], uint8[::1])")
def encode_times(t: NDArray[np.int64], out: NDArray[np.uint8]) -> int:
    """Write the runs of times; return how many bytes they are, nineteen for each event at most."""
    n = 0
    i = 0
    now = t[0]
    while i < t.shape[0]:
        step = t[i] - now
        if step < 0 or step >= 15:
            for _ in range(16):  # a negative step takes all sixteen: it is its complement
                out[n] = 0xF0 | (step & 15)
                n += 1
                step >>= 4
                if step == 0:
                    break
            step = 0
        now = t[i]
        run = 1
        while i + run < t.shape[0] and t[i + run] == now and run < 65_535:
            run += 1
        if run >= 15:
            out[n] = (step << 4) | 15
            out[n + 1] = run & 0xFF
            out[n + 2] = run >> 8
            n += 3
        else:
            out[n] = (step << 4) | run
            n += 1
        i += run
    return n


@kernel()
def decode_times(data: NDArray[np.uint8], position: int, size: int, out: NDArray[np.int64]) -> int:
    """Read the runs of times; return the position after them, -1 if they do not add up."""
    now = (np.int64(data[11]) - (256 if data[11] >= 128 else 0)) << 56
    for k in range(7):
        now |= np.int64(data[4 + k]) << (8 * k)
    i = 0
    while i < out.shape[0]:
        shift = 0
        while position < size and data[position] >> 4 == 15:
            part = np.int64(data[position] & 15)
            if shift < 64:
                now += (part - 16 if shift == 60 and part >= 8 else part) << shift
            shift += 4
            position += 1
        if position >= size:
            return -1
        now += data[position] >> 4
        run = int(data[position] & 15)
        position += 1
        if run == 15:
            run = int(data[position]) | int(data[position + 1]) << 8
            position += 2
        if run > out.shape[0] - i:
            return -1
        for k in range(i, i + run):
            out[k] = now
        i += run
    return position


@kernel()
def decode_rows(data: NDArray[np.uint8], position: int, size: int, out: NDArray[np.uint16]) -> int:
    """Read the runs of rows; return the position after them, -1 if they do not add up."""
    i = 0
    while i < out.shape[0]:
        if position >= size:
            return -1
        word = int(data[position]) | int(data[position + 1]) << 8
        position += 2
        run = word & 31
        if run == 31:
            run = int(data[position]) | int(data[position + 1]) << 8
            position += 2
        if run > out.shape[0] - i:
            return -1
        out[i : i + run] = word >> 5
        i += run
    return position


@kernel()
def decode_masked_columns(data: NDArray[np.uint8], position: int, size: int, out: NDArray[np.uint16]) -> int:
    """Read columns that come with the mask of their five neighbours; return the position, -1 past the end."""
    i = 0
    while i < out.shape[0]:
        if position >= size:
            return -1
        word = int(data[position]) | int(data[position + 1]) << 8
        position += 2
        out[i] = word >> 5
        i += 1
        for k in range(5):
            if word >> (4 - k) & 1 and i < out.shape[0]:
                out[i] = (word >> 5) + k + 1
                i += 1
    return position


@kernel()
def decode_polarities(data: NDArray[np.uint8], position: int, size: int, out: NDArray[np.uint8]) -> int:
    """Read the runs of polarities; return the position after them, -1 if they do not add up."""
    i = 0
    while i < out.shape[0]:
        if position >= size:
            return -1
        on = data[position] >> 7
        run = int(data[position] & 127)
        position += 1
        if run == 127:
            run = int(data[position]) | int(data[position + 1]) << 8
            position += 2
        if run > out.shape[0] - i:
            return -1
        out[i : i + run] = on
        i += run
    return position


@kernel()
def decode_columns(
    data: NDArray[np.uint8], position: int, size: int, out_x: NDArray[np.uint16], out_p: NDArray[np.uint8]
) -> bool:
    """Read columns with polarities, four in six bytes; return whether they are there."""
    if position + (out_x.shape[0] * 3 + 1) // 2 > size:
        return False
    for i in range(out_x.shape[0]):
        at = position + i // 4 * 6
        a = np.int64(data[at]) | np.int64(data[at + 1]) << 8
        b = np.int64(data[at + 2]) | np.int64(data[at + 3]) << 8
        c = np.int64(data[at + 4]) | np.int64(data[at + 5]) << 8
        place = i % 4
        if place == 0:
            value = a >> 4
        elif place == 1:
            value = (a & 15) | b >> 8 << 4
        elif place == 2:
            value = (b & 255) | c >> 12 << 8
        else:
            value = c & 0xFFF
        out_x[i] = value >> 1
        out_p[i] = value & 1
    return True


@kernel()
def decode_addresses(
    data: NDArray[np.uint8],
    position: int,
    size: int,
    out_x: NDArray[np.uint16],
    out_y: NDArray[np.uint16],
    out_p: NDArray[np.uint8],
) -> bool:
    """Read rows, columns and polarities, four in twelve bytes; return whether they are there."""
    if position + out_x.shape[0] * 3 > size:
        return False
    for i in range(out_x.shape[0]):
        at = position + i // 4 * 12
        place = i % 4
        if place == 0:
            low, middle, high = data[at + 1], data[at + 2], data[at + 3]
        elif place == 1:
            low, middle, high = data[at], data[at + 6], data[at + 7]
        elif place == 2:
            low, middle, high = data[at + 4], data[at + 5], data[at + 11]
        else:
            low, middle, high = data[at + 8], data[at + 9], data[at + 10]
        value = np.int64(low) | np.int64(middle) << 8 | np.int64(high) << 16
        out_y[i] = value >> 12 & 0x7FF
        out_x[i] = value >> 1 & 0x7FF
        out_p[i] = value & 1
    return True


@kernel(f"boolean({_BYTES}, int64, int64[::1], uint16[::1], uint16[::1], uint8[::1])")
def decode(
    data: NDArray[np.uint8],
    size: int,
    out_t: NDArray[np.int64],
    out_x: NDArray[np.uint16],
    out_y: NDArray[np.uint16],
    out_p: NDArray[np.uint8],
) -> bool:
    """Decode a chunk of *size* bytes, followed by ``SPARE_BYTES`` zeros, into as many events as it says.

    Returns whether its runs add up; if not, the outputs are without meaning.
    """
    position = decode_times(data, HEAD_BYTES, size, out_t)
    if position < 0:
        return False
    if data[0] & 2:
        return decode_addresses(data, position, size, out_x, out_y, out_p)
    position = decode_rows(data, position, size, out_y)
    if position < 0:
        return False
    if data[0] & 1:
        return decode_columns(data, position, size, out_x, out_p)
    position = decode_masked_columns(data, position, size, out_x)
    return position >= 0 and decode_polarities(data, position, size, out_p) >= 0
