"""Listed events times the weights of their pixels, sixteen at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from llvmlite import ir
from numba.core import cgutils, types

from elpd.events.lanes_columns import SIXTEEN, column_and_polarity
from elpd.events.simd import (
    HALF,
    I1,
    I32,
    I64,
    LONGS,
    Builder,
    UniTuple,
    Value,
    add,
    as_words,
    call,
    constant,
    lanes_left,
    load,
    operation,
    running,
    splat,
    store,
)
from elpd.events.simd_lanes import fetch

if TYPE_CHECKING:
    from collections.abc import Callable


def _sum(
    builder: Builder,
    events: Callable[[Value], tuple[Value, Value]],
    n: Value,
    table: Value,
    outside: Value,
    nowhere: Value,
) -> list[Value]:
    """Emit the loop: *events* says table index and polarity of the sixteen events from one on."""
    elp = running(builder, HALF)
    energy = running(builder, LONGS)
    counts = [running(builder, SIXTEEN) for _ in range(3)]
    largest, lost = splat(builder, outside, SIXTEEN), splat(builder, nowhere, SIXTEEN)
    zero = constant(SIXTEEN, 0)
    with cgutils.for_range_slice(builder, I64(0), n, I64(16)) as (begin, _):
        there = lanes_left(builder, begin, n, HALF)
        index, is_on = events(begin)
        entry = fetch(builder, table, index, there, SIXTEEN)
        inside = builder.and_(builder.icmp_signed(">", entry, largest), there)
        weight = builder.select(inside, entry, zero)
        wide = builder.sext(weight, HALF)
        add(builder, elp, builder.select(is_on, builder.sub(constant(HALF, 0), wide), wide))
        squares = call(builder, "llvm.x86.avx2.pmadd.wd", ir.VectorType(I32, 8), [weight, weight])
        add(builder, energy, builder.zext(squares, LONGS))
        out_of_sensor = builder.and_(builder.icmp_signed("==", entry, lost), there)
        for bits, total in zip((inside, builder.and_(inside, is_on), out_of_sensor), counts, strict=True):
            add(builder, total, builder.zext(bits, SIXTEEN))
    sums = [
        (elp, builder.sext, ir.VectorType(I64, 16)),
        (energy, builder.zext, LONGS),
        *((total, builder.zext, ir.VectorType(I64, 16)) for total in counts),
    ]
    return [
        call(builder, f"llvm.vector.reduce.add.v{wide.count}i64", I64, [widen(builder.load(total), wide)])
        for total, widen, wide in sums
    ]


@operation(UniTuple(types.int64, 5), [types.uint32], types.int64, [types.int16], types.int64, types.int64)
def weigh(builder: Builder, addresses: Value, n: Value, table: Value, outside: Value, nowhere: Value) -> list[Value]:
    """Look up *n* events, each its table index times two plus its polarity.

    Returns ELP, energy, events inside, ON events inside, events whose entry is *nowhere*. Entries up to *outside* are
    no weights. Needs places for 16 events more than *n*, and *n* below 2^16.
    """

    def events(begin: Value) -> tuple[Value, Value]:
        event = load(builder, addresses, begin, HALF)
        return builder.lshr(event, constant(HALF, 1)), builder.trunc(event, ir.VectorType(I1, 16))

    return _sum(builder, events, n, table, outside, nowhere)


@operation(
    UniTuple(types.int64, 5),
    [types.uint32], types.int64, types.int64, types.int64, types.int64, types.int64,
    [types.int16], types.int64, types.int64,
)  # fmt: skip
def weigh_pixels(
    builder: Builder,
    lists: Value,
    columns: Value,
    rows: Value,
    n: Value,
    last_row: Value,
    stride: Value,
    table: Value,
    outside: Value,
    nowhere: Value,
) -> list[Value]:
    """Look up *n* events of the lists of 16 bits that begin at *columns* and *rows*; else as ``weigh``."""
    pixels = _pixels(builder, lists, columns, rows, last_row, stride)
    return _sum(builder, pixels, n, table, outside, nowhere)


@operation(
    types.void,
    [types.uint32], types.int64, types.int64, types.int64, types.int64, types.int64, types.int64,
)  # fmt: skip
def to_addresses(
    builder: Builder,
    lists: Value,
    columns: Value,
    rows: Value,
    n: Value,
    last_row: Value,
    stride: Value,
    out: Value,
) -> None:
    """Write *n* events of the lists that begin at *columns* and *rows* from *out* on, as ``weigh`` takes them."""
    pixels = _pixels(builder, lists, columns, rows, last_row, stride)
    with cgutils.for_range_slice(builder, I64(0), n, I64(16)) as (begin, _):
        index, is_on = pixels(begin)
        address = builder.or_(builder.shl(index, constant(HALF, 1)), builder.zext(is_on, HALF))
        store(builder, address, lists, builder.add(out, begin))


@operation(types.void, [types.uint32], types.int64, types.int64, types.int64)
def widen(builder: Builder, lists: Value, begin: Value, n: Value, out: Value) -> None:
    """Write *n* numbers of a list of 16 bits from *begin* on as numbers of 32, from *out* on."""
    with cgutils.for_range_slice(builder, I64(0), n, I64(16)) as (done, _):
        some = load(builder, as_words(builder, lists), builder.add(begin, done), SIXTEEN)
        store(builder, builder.zext(some, HALF), lists, builder.add(out, done))


def _pixels(
    builder: Builder, lists: Value, columns: Value, rows: Value, last_row: Value, stride: Value
) -> Callable[[Value], tuple[Value, Value]]:
    """Return what says table index and polarity of the sixteen events from one on."""
    words = as_words(builder, lists)
    last, length = splat(builder, last_row, SIXTEEN), splat(builder, stride, HALF)

    def events(begin: Value) -> tuple[Value, Value]:
        x, is_on = column_and_polarity(builder, load(builder, words, builder.add(columns, begin), SIXTEEN))
        y = load(builder, words, builder.add(rows, begin), SIXTEEN)
        y = builder.select(builder.icmp_unsigned("<", y, last), y, last)
        return builder.add(builder.mul(builder.zext(y, HALF), length), x), is_on

    return events
