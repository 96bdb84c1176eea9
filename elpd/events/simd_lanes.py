"""Lanes moved together, and lanes fetched from anywhere: one instruction of AVX-512 each, and what AVX2 does instead.

AVX2 moves the lanes of a mask together eight at a time: a byte of the mask picks one of 256 orders for its byte
shuffle. It can fetch lanes from a table, too, but single loads were faster (AMD family 26: 1.3 against 1.6 ns a word of
EVT3, fused).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from llvmlite import ir

from elpd.events.simd import I8, I16, I32, I64, Builder, Value, call, constant, part, store, wide

if TYPE_CHECKING:
    from collections.abc import Callable

EIGHT, BYTES = ir.VectorType(I16, 8), ir.VectorType(I8, 16)
ORDERS = ir.ArrayType(BYTES, 256)
NO_LANE = 0x80
"""In an order of bytes: zero."""


def store_packed(
    builder: Builder,
    values: Value,
    mask: Value,
    data: Value,
    at: Value,
    finish: Callable[[Value], Value] = lambda lanes: lanes,
) -> None:
    """Store the lanes of 16 bits in *mask* (bits, or one number of them) densely from an element of *data* on.

    *finish* makes of lanes what is stored. There must be room for all lanes: behind those in the mask lies anything.
    """
    count = values.type.count
    if wide():
        if isinstance(mask.type, ir.IntType):
            mask = builder.bitcast(mask, ir.VectorType(ir.IntType(1), count))
        name = f"llvm.x86.avx512.mask.compress.v{count}i16"
        store(builder, finish(call(builder, name, values.type, [values, constant(values.type, 0), mask])), data, at)
        return
    if not isinstance(mask.type, ir.IntType):
        mask = builder.bitcast(mask, ir.IntType(count))
    orders = _orders(builder)
    for first in range(0, count, 8):
        some = mask if count == 8 else builder.trunc(builder.lshr(mask, mask.type(first)), I8)
        order = builder.load(builder.gep(orders, [I64(0), builder.zext(some, I64)]))
        lanes = builder.bitcast(part(builder, values, first, 8), BYTES)
        moved = call(builder, "llvm.x86.ssse3.pshuf.b.128", BYTES, [lanes, order])
        store(builder, finish(builder.bitcast(moved, EIGHT)), data, at)
        at = builder.add(at, builder.zext(call(builder, "llvm.ctpop.i8", I8, [some]), I64))


def fetch(builder: Builder, data: Value, places: Value, there: Value, lanes: ir.VectorType) -> Value:
    """Return a lane from each of *places*, counted in 16 bits from *data* on; zero for those that are not *there*.

    Lanes are sixteen of 16 bits, after each of which 16 more may be read, or eight of 64.
    """
    start = builder.bitcast(data, I8.as_pointer())
    if wide() and lanes.element == I64:
        arguments = [constant(lanes, 0), start, places, there, I32(2)]
        return call(builder, "llvm.x86.avx512.mask.gather.dpq.512", lanes, arguments)
    if wide():
        arguments = [constant(places.type, 0), start, places, there, I32(2)]
        return builder.trunc(call(builder, "llvm.x86.avx512.mask.gather.dpi.512", places.type, arguments), lanes)
    data = builder.bitcast(data, I16.as_pointer())
    places = builder.select(there, places, constant(places.type, 0))
    fetched = constant(lanes, 0)
    for lane in range(lanes.count):
        place = builder.zext(builder.extract_element(places, I32(lane)), I64)
        one = builder.load(builder.bitcast(builder.gep(data, [place]), lanes.element.as_pointer()))
        one.align = 2
        fetched = builder.insert_element(fetched, one, I32(lane))
    return builder.select(there, fetched, constant(lanes, 0))


def moved_up(builder: Builder, values: Value, by: int, entering: Value) -> Value:
    """Return the lanes moved up by some places; the first *by* lanes of *entering* enter."""
    count = values.type.count
    order = [count + lane for lane in range(by)] + list(range(count - by))
    return builder.shuffle_vector(values, entering, ir.Constant(ir.VectorType(I32, count), order))


def _orders(builder: Builder) -> Value:
    """Return the module's table of orders of bytes, one for each mask of eight lanes."""
    name = "elpd.orders"
    if name in builder.module.globals:
        return builder.module.globals[name]
    orders = []
    for mask in range(256):
        taken = [lane for lane in range(8) if mask >> lane & 1]
        order = [byte for lane in taken for byte in (2 * lane, 2 * lane + 1)]
        orders.append(ir.Constant(BYTES, order + [NO_LANE] * (16 - len(order))))
    table = ir.GlobalVariable(builder.module, ORDERS, name)
    table.linkage, table.global_constant, table.align = "internal", True, 16
    table.initializer = ir.Constant(ORDERS, orders)
    return table
