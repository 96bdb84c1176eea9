"""Listed events to places of the latch, and vectors laid over them, sixteen at a time."""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types

from elpd.events.evt3_lists import COLUMNS, LOWS, ROWS
from elpd.events.lanes_columns import SIXTEEN, column_and_polarity
from elpd.events.simd import (
    HALF,
    I1,
    I16,
    I32,
    I64,
    Builder,
    UniTuple,
    Value,
    add,
    as_words,
    constant,
    lanes_left,
    load,
    operation,
    population,
    running,
    splat,
    store,
)
from elpd.events.simd_lanes import store_packed
from elpd.vision.latch import EMPTY


@operation(
    UniTuple(types.int64, 2),
    [types.uint32], types.int64, types.int64, types.int64, types.int64, types.int64, types.int64,
)  # fmt: skip
def keep_on(
    builder: Builder, lists: Value, columns: Value, rows: Value, lows: Value, n: Value, width: Value, height: Value
) -> list[Value]:
    """Write those of *n* listed events that are ON and inside the sensor to the lists of all events.

    Returns how many those are, and how many are ON outside. The lists may be where they are read from: up to 16 places
    beyond *n* are touched.
    """
    n_kept, n_outside = (running(builder, I64) for _ in range(2))
    words = as_words(builder, lists)
    first_column, first_row = (splat(builder, side, HALF) for side in (width, height))
    with cgutils.for_range_slice(builder, I64(0), n, I64(16)) as (begin, _):
        x, is_on = column_and_polarity(builder, load(builder, words, builder.add(columns, begin), SIXTEEN))
        y, low = (load(builder, words, builder.add(one, begin), SIXTEEN) for one in (rows, lows))
        in_column = builder.icmp_unsigned("<", x, first_column)
        within = builder.and_(in_column, builder.icmp_unsigned("<", builder.zext(y, HALF), first_row))
        there = builder.and_(is_on, lanes_left(builder, begin, n, HALF))
        kept = builder.and_(there, within)
        at = builder.load(n_kept)
        for values, out in ((builder.trunc(x, SIXTEEN), COLUMNS), (y, ROWS), (low, LOWS)):
            store_packed(builder, values, kept, words, builder.add(I64(out), at))
        add(builder, n_kept, population(builder, kept))
        add(builder, n_outside, population(builder, builder.and_(there, builder.not_(within))))
    return [builder.load(n_kept), builder.load(n_outside)]


@operation(types.void, [types.uint32], types.int64, types.int64)
def to_places(builder: Builder, lists: Value, n: Value, stride: Value) -> None:
    """Write ``row * stride + column`` of the first *n* of all events to the beginning of the lists."""
    words = as_words(builder, lists)
    length = splat(builder, stride, HALF)
    with cgutils.for_range_slice(builder, I64(0), n, I64(16)) as (begin, _):
        x, y = (
            builder.zext(load(builder, words, builder.add(one, begin), SIXTEEN), HALF)
            for one in (I64(COLUMNS), I64(ROWS))
        )
        store(builder, builder.add(builder.mul(y, length), x), lists, begin)


@operation(types.uint32, [types.int32], types.uint64, types.uint32, types.int32)
def claim(builder: Builder, slots: Value, first: Value, mask: Value, time: Value) -> Value:
    """Write *time* to the places ``first + i``, for each bit i of *mask*, that are empty; return the other bits."""
    rest = I32(0)
    lanes = ir.VectorType(I1, 16)
    for half in (0, 16):
        at = builder.add(first, I64(half))
        wanted = builder.trunc(builder.lshr(mask, I32(half)), I16)
        empty = builder.icmp_signed("==", load(builder, slots, at, HALF), constant(HALF, int(EMPTY)))
        mine = builder.and_(builder.bitcast(wanted, lanes), empty)
        pointer = builder.bitcast(builder.gep(slots, [at]), HALF.as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [HALF, pointer.type, I32, lanes])
        store_some = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.store.v16i32.p0")
        builder.call(store_some, [splat(builder, time, HALF), pointer, I32(4), mine])
        others = builder.and_(wanted, builder.not_(builder.bitcast(empty, I16)))
        rest = builder.or_(rest, builder.shl(builder.zext(others, I32), I32(half)))
    return rest
