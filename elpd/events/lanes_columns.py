"""From lists of columns, rows and times to the columns that a decoder gives, sixteen events at a time."""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types

from elpd.events.lanes import BEYOND
from elpd.events.simd import (
    HALF,
    I8,
    I16,
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
)
from elpd.events.simd_lanes import store_packed

SIXTEEN = ir.VectorType(I16, 16)


def column_and_polarity(builder: Builder, entry: Value) -> tuple[Value, Value]:
    """Take entries of a list of columns apart: columns of 32 bits, 2048 for those beyond, and bits, 1 for ON."""
    wide = builder.zext(entry, HALF)
    column = builder.and_(wide, constant(HALF, BEYOND | 0x7FF))
    limit = constant(HALF, 2048)
    column = builder.select(builder.icmp_unsigned("<", column, limit), column, limit)
    on = builder.icmp_unsigned("!=", builder.and_(wide, constant(HALF, 0x800)), constant(HALF, 0))
    return column, on


@operation(
    UniTuple(types.int64, 3),
    [types.uint32], types.int64, types.int64, types.int64, types.int64, types.int64, types.int64, types.int64,
    [types.int64], [types.uint16], [types.uint16], [types.uint8],
)  # fmt: skip
def unpack(
    builder: Builder,
    lists: Value,
    columns: Value,
    rows: Value,
    lows: Value,
    n: Value,
    base: Value,
    width: Value,
    height: Value,
    out_t: Value,
    out_x: Value,
    out_y: Value,
    out_p: Value,
) -> list[Value]:
    """Write the first *n* events of the lists that begin at *columns*, *rows* and *lows*, sixteen at a time.

    Returns how many were inside the sensor and written, how many had no row there, and how many only no column. Up to
    16 places beyond are touched.
    """
    inside_count, no_row_count, no_column_count = (running(builder, I64) for _ in range(3))
    lists = as_words(builder, lists)
    first_column, first_row = (splat(builder, side, HALF) for side in (width, height))

    def since(low: Value) -> Value:
        longs = ir.VectorType(I64, low.type.count)
        return builder.add(builder.zext(low, longs), splat(builder, base, longs))

    def narrow(lanes: Value) -> Value:
        return builder.trunc(lanes, ir.VectorType(I8, lanes.type.count))

    with cgutils.for_range_slice(builder, I64(0), n, I64(16)) as (begin, _):
        there = lanes_left(builder, begin, n, HALF)
        x, on = column_and_polarity(builder, load(builder, lists, builder.add(columns, begin), SIXTEEN))
        y = builder.zext(load(builder, lists, builder.add(rows, begin), SIXTEEN), HALF)
        in_row = builder.and_(builder.icmp_unsigned("<", y, first_row), there)
        inside = builder.and_(builder.icmp_unsigned("<", x, first_column), in_row)
        at = builder.load(inside_count)
        low = load(builder, lists, builder.add(lows, begin), SIXTEEN)
        store_packed(builder, low, inside, out_t, at, since)
        store_packed(builder, builder.trunc(x, SIXTEEN), inside, out_x, at)
        store_packed(builder, builder.trunc(y, SIXTEEN), inside, out_y, at)
        store_packed(builder, builder.zext(on, SIXTEEN), inside, out_p, at, narrow)
        add(builder, inside_count, population(builder, inside))
        add(builder, no_row_count, population(builder, builder.and_(builder.not_(in_row), there)))
        add(builder, no_column_count, population(builder, builder.and_(builder.not_(inside), in_row)))
    return [builder.load(total) for total in (inside_count, no_row_count, no_column_count)]
