"""Thirty-two EVT3 words at a time: the vector operations that numba has no word for, as LLVM intrinsics.

A block is 32 words of 16 bits, one AVX-512 register; masks are ``uint32``, bit i for word i of the block. What a word
means depends on words before it (its row, its time), and that is a scan: the index of the nearest word of a kind at or
before each lane, by five steps of "take the larger of yourself and your neighbour 1, 2, 4, 8, 16 to the left", then
one permutation that fetches what those words say. Events leave by compression, so that lists stay dense and in stream
order without a branch.

Everything here selects instructions of AVX-512 F and BW: ``available()`` says whether kernels that use it may be
*compiled* at all. It asks what numba compiles for, which is also what numba keys its cache on: code cached by one
processor is not found by another.
"""

from __future__ import annotations

import inspect
from functools import cache
from typing import TYPE_CHECKING, Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.registry import cpu_target
from numba.extending import intrinsic

if TYPE_CHECKING:
    from collections.abc import Callable

UniTuple = types.UniTuple  # type: ignore[attr-defined]  # numba ships half of its types
LANES = 32
NEEDED = ("avx512f", "avx512bw", "avx512vl")

_I1, _I16, _I32, _I64 = (ir.IntType(bits) for bits in (1, 16, 32, 64))
_WORDS, _BITS = ir.VectorType(_I16, 32), ir.VectorType(_I1, 32)
_HALF, _HALF_BITS = ir.VectorType(_I32, 16), ir.VectorType(_I1, 16)
_LONGS = ir.VectorType(_I64, 8)
_SHIFTS = (1, 2, 4, 8, 16)
Builder = Any
Value = Any
Pair = tuple[Value, Value]


@cache
def available() -> bool:
    """Say whether numba compiles for a processor that has these instructions."""
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    return {f"+{name}" for name in NEEDED} <= set(features.split(","))


def operation(result: Any, *parameters: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a function that emits IR callable from kernels.

    *parameters* are numba types; an array's element type in brackets stands for an array of any layout flag, of which
    the function gets a pointer to the first element.
    """

    def decorate(emit: Callable[..., Any]) -> Any:
        def typed(typing_context: Any, *given: Any) -> Any:
            del typing_context
            fitting = [
                isinstance(one, types.Array) and one.dtype == wanted[0] if isinstance(wanted, list) else True
                for one, wanted in zip(given, parameters, strict=True)
            ]
            if not all(fitting):
                return None
            arguments = [
                one if isinstance(wanted, list) else wanted for one, wanted in zip(given, parameters, strict=True)
            ]

            def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                values = [
                    context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
                    for kind, value in zip(signature.args, values, strict=True)
                ]
                made = emit(builder, *values)
                if isinstance(result, UniTuple):
                    return context.make_tuple(builder, result, made)
                return context.get_dummy_value() if result is types.void else made

            return result(*arguments), generate

        # numba wants to see every parameter by name.
        typed.__signature__ = inspect.signature(emit)  # type: ignore[attr-defined]
        typed.__name__ = emit.__name__
        typed.__doc__ = emit.__doc__
        return intrinsic(typed)

    return decorate


# --- pieces of IR --------------------------------------------------------------------------------------------------


def _constant(vector: Any, value: int) -> Value:
    return ir.Constant(vector, [value] * vector.count)


def _iota(vector: Any, step: int = 1) -> Value:
    return ir.Constant(vector, [step * lane for lane in range(vector.count)])


def _splat(builder: Builder, scalar: Value, vector: Any) -> Value:
    single = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, _I32(0))
    return builder.shuffle_vector(single, single, _constant(ir.VectorType(_I32, vector.count), 0))


def _call(builder: Builder, name: str, result: Any, arguments: list[Value]) -> Value:
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), arguments)


def _load(builder: Builder, data: Value, index: Value, vector: Any) -> Value:
    loaded = builder.load(builder.bitcast(builder.gep(data, [index]), vector.as_pointer()))
    loaded.align = vector.element.width // 8
    return loaded


def _store(builder: Builder, value: Value, data: Value, index: Value) -> None:
    pointer = builder.bitcast(builder.gep(data, [index]), value.type.as_pointer())
    builder.store(value, pointer).align = value.type.element.width // 8


def _mask(builder: Builder, bits: Value) -> Value:
    return builder.bitcast(bits, _I32)


def _halves(builder: Builder, words: Value) -> Pair:
    """Widen 32 words to two times 16 lanes of 32 bits."""
    wide = builder.zext(words, ir.VectorType(_I32, 32))
    low, high = (
        builder.shuffle_vector(wide, wide, ir.Constant(_HALF, list(range(begin, begin + 16)))) for begin in (0, 16)
    )
    return low, high


def _nearest(builder: Builder, words: Value, mask: Value, otherwise: Value) -> Value:
    """Return for each lane the word of the nearest lane in *mask* at or before it, or the scalar *otherwise*."""
    zero = _constant(_WORDS, 0)
    index = builder.select(builder.bitcast(mask, _BITS), _iota(_WORDS), zero)
    for shift in _SHIFTS:
        order = ir.Constant(ir.VectorType(_I32, 32), [32] * shift + list(range(32 - shift)))
        moved = builder.shuffle_vector(index, zero, order)
        index = builder.select(builder.icmp_unsigned(">", moved, index), moved, index)
    found = _call(builder, "llvm.x86.avx512.permvar.hi.512", _WORDS, [words, index])
    before_first = builder.and_(builder.not_(mask), builder.sub(mask, _I32(1)))
    return builder.select(builder.bitcast(before_first, _BITS), _splat(builder, otherwise, _WORDS), found)


def _pack(builder: Builder, halves: Pair, mask: Value, out: Value, n: Value) -> None:
    """Write the lanes that are in *mask* densely to *out* from *n* on, where there must be room for 32."""
    low_mask, high_mask = builder.trunc(mask, _I16), builder.trunc(builder.lshr(mask, _I32(16)), _I16)
    count = builder.zext(_call(builder, "llvm.ctpop.i16", _I16, [low_mask]), _I64)
    for half, bits, at in ((halves[0], low_mask, n), (halves[1], high_mask, builder.add(n, count))):
        arguments = [half, _constant(_HALF, 0), builder.bitcast(bits, _HALF_BITS)]
        packed = _call(builder, "llvm.x86.avx512.mask.compress.v16i32", _HALF, arguments)
        _store(builder, packed, out, at)


# --- what kernels call: 32 words from index *at* on must exist -------------------------------------------------------


@operation(UniTuple(types.uint32, 5), [types.uint16], types.int64, types.int64, types.int64, types.int64)
def kinds(builder: Builder, words: Value, at: Value, high: Value, low_from: Value, low_until: Value) -> list[Value]:
    """Return masks of the block: ADDR_X, ADDR_Y, TIME_LOW, words that need a look, words at which to stop.

    A stop is a TIME_LOW outside ``[low_from, low_until)`` and a TIME_HIGH other than *high*.
    """
    block = _load(builder, words, at, _WORDS)
    kind = builder.and_(block, _constant(_WORDS, 0xF000))
    content = builder.and_(block, _constant(_WORDS, 0x0FFF))

    def among(value: int) -> Value:
        return _mask(builder, builder.icmp_unsigned("==", kind, _constant(_WORDS, value)))

    x, y, low, time_high = among(0x2000), among(0x0000), among(0x6000), among(0x8000)
    repeated = builder.icmp_unsigned("==", content, _splat(builder, builder.trunc(high, _I16), _WORDS))
    first = builder.trunc(low_from, _I16)
    length = builder.sub(builder.trunc(low_until, _I16), first)
    since = builder.sub(content, _splat(builder, first, _WORDS))
    leaves = _mask(builder, builder.icmp_unsigned(">=", since, _splat(builder, length, _WORDS)))
    stop = builder.or_(builder.and_(low, leaves), builder.and_(time_high, builder.not_(_mask(builder, repeated))))
    plain = builder.or_(builder.or_(x, y), builder.or_(low, time_high))
    return [x, y, low, builder.not_(plain), stop]


@operation(
    types.int64,
    [types.uint16], types.int64, types.uint32, types.int64, types.int64, types.int64, [types.uint32], types.int64,
)  # fmt: skip
def addresses(
    builder: Builder,
    words: Value,
    at: Value,
    rows: Value,
    row: Value,
    last_row: Value,
    stride: Value,
    out: Value,
    begin: Value,
) -> Value:
    """Write for each lane what an ADDR_X there would mean: ``2 * (min(row, last_row) * stride + x) + polarity``.

    *rows* is the mask of ADDR_Y, *row* holds until the first of them. Returns the row after the last.
    """
    block = _load(builder, words, at, _WORDS)
    of_lane = _nearest(builder, block, rows, builder.trunc(row, _I16))
    after = builder.zext(builder.extract_element(of_lane, _I32(31)), _I64)
    last = _splat(builder, builder.trunc(last_row, _I16), _WORDS)
    of_lane = builder.select(builder.icmp_unsigned("<", of_lane, last), of_lane, last)
    x2 = builder.and_(builder.shl(block, _constant(_WORDS, 1)), _constant(_WORDS, 0x0FFE))
    on = builder.and_(builder.lshr(block, _constant(_WORDS, 11)), _constant(_WORDS, 1))
    wide = _splat(builder, builder.shl(builder.trunc(stride, _I32), _I32(1)), _HALF)
    rows_and_columns = zip(_halves(builder, of_lane), _halves(builder, builder.or_(x2, on)), (0, 16), strict=True)
    for half, column, offset in rows_and_columns:
        _store(builder, builder.add(builder.mul(half, wide), column), out, builder.add(begin, _I64(offset)))
    return after


@operation(types.int64, [types.uint16], types.int64, types.uint32, types.int64, [types.uint32], types.int64)
def times(builder: Builder, words: Value, at: Value, lows: Value, low: Value, out: Value, begin: Value) -> Value:
    """Write for each lane the low part of time that holds there; return that after the last.

    *lows* is the mask of TIME_LOW, *low* holds until the first of them.
    """
    content = builder.and_(_load(builder, words, at, _WORDS), _constant(_WORDS, 0x0FFF))
    of_lane = _nearest(builder, content, lows, builder.trunc(low, _I16))
    for half, offset in zip(_halves(builder, of_lane), (0, 16), strict=True):
        _store(builder, half, out, builder.add(begin, _I64(offset)))
    return builder.zext(builder.extract_element(of_lane, _I32(31)), _I64)


@operation(types.void, [types.uint32], types.int64, types.uint32, [types.uint32], types.int64)
def pack(builder: Builder, lanes: Value, begin: Value, mask: Value, out: Value, n: Value) -> None:
    """Write those of 32 *lanes* that are in *mask* densely to *out* from *n* on, where there must be room for 32."""
    halves = [_load(builder, lanes, builder.add(begin, _I64(offset)), _HALF) for offset in (0, 16)]
    _pack(builder, (halves[0], halves[1]), mask, out, n)


@operation(types.void, types.int64, types.int64, types.uint32, [types.uint32], types.int64)
def pack_run(builder: Builder, first: Value, last: Value, mask: Value, out: Value, n: Value) -> None:
    """Write ``min(first + 2 i, last)`` for each bit i of *mask* densely to *out* from *n* on; room as in ``pack``."""
    begin, end = (_splat(builder, builder.trunc(one, _I32), _HALF) for one in (first, last))
    halves = []
    for offset in (0, 32):
        run = builder.add(begin, builder.add(_iota(_HALF, 2), _constant(_HALF, offset)))
        halves.append(builder.select(builder.icmp_unsigned("<", run, end), run, end))
    _pack(builder, (halves[0], halves[1]), mask, out, n)


@operation(types.void, types.int64, types.uint32, [types.uint32], types.int64)
def pack_places(builder: Builder, at: Value, mask: Value, out: Value, n: Value) -> None:
    """Write ``at + i`` for each bit i of *mask* densely to *out* from *n* on; room as in ``pack``."""
    first = _splat(builder, builder.trunc(at, _I32), _HALF)
    halves = [builder.add(first, builder.add(_iota(_HALF), _constant(_HALF, begin))) for begin in (0, 16)]
    _pack(builder, (halves[0], halves[1]), mask, out, n)


@operation(types.void, [types.uint32], types.int64, [types.uint32], types.int64, types.int64)
def copy_run(builder: Builder, source: Value, begin: Value, out: Value, n: Value, count: Value) -> None:
    """Copy *count* numbers, sixteen at a time: up to 16 places beyond are touched, one step is always made."""
    with cgutils.for_range_slice(builder, _I64(0), count, _I64(16)) as (done, _):
        _store(builder, _load(builder, source, builder.add(begin, done), _HALF), out, builder.add(n, done))


@operation(types.void, types.int64, [types.uint32], types.int64)
def fill_run(builder: Builder, value: Value, out: Value, n: Value) -> None:
    """Write *value* to the 32 places of *out* from *n* on."""
    same = _splat(builder, builder.trunc(value, _I32), _HALF)
    _store(builder, same, out, n)
    _store(builder, same, out, builder.add(n, _I64(16)))


@operation(types.uint64, [types.uint16], types.int64)
def four_words(builder: Builder, words: Value, at: Value) -> Value:
    """Return four words as one number, the first lowest."""
    loaded = builder.load(builder.bitcast(builder.gep(words, [at]), _I64.as_pointer()))
    loaded.align = 2
    return loaded


@operation(types.int64, types.uint32)
def population(builder: Builder, mask: Value) -> Value:
    """Return how many bits are set."""
    return builder.zext(_call(builder, "llvm.ctpop.i32", _I32, [mask]), _I64)


@operation(types.int64, types.uint32)
def highest(builder: Builder, mask: Value) -> Value:
    """Return the index of the highest set bit; -1 for none."""
    return builder.sub(_I64(31), builder.zext(builder.ctlz(mask, _I1(0)), _I64))


@operation(UniTuple(types.int64, 5), [types.uint32], types.int64, [types.int16], types.int64, types.int64)
def weigh(builder: Builder, events: Value, n: Value, table: Value, outside: Value, nowhere: Value) -> list[Value]:
    """Look up *n* events, each its table index times two plus its polarity, sixteen at a time.

    Returns ELP, energy, events inside, ON events inside, events whose entry is *nowhere*. Entries up to *outside* are
    no weights. Needs places for 16 events more than *n*, one table entry after the last index, and *n* below 2^20.
    """
    elp = cgutils.alloca_once_value(builder, _constant(_HALF, 0))
    energy = [cgutils.alloca_once_value(builder, _constant(_LONGS, 0)) for _ in range(2)]
    counts = [cgutils.alloca_once_value(builder, _I64(0)) for _ in range(3)]
    largest = _splat(builder, builder.trunc(outside, _I32), _HALF)
    lost = _splat(builder, builder.trunc(nowhere, _I32), _HALF)
    zero, one = _constant(_HALF, 0), _constant(_HALF, 1)
    table = builder.bitcast(table, ir.IntType(8).as_pointer())
    with cgutils.for_range_slice(builder, _I64(0), n, _I64(16)) as (begin, _):
        event = _load(builder, events, begin, _HALF)
        left = _splat(builder, builder.trunc(builder.sub(n, begin), _I32), _HALF)
        there = builder.icmp_unsigned("<", _iota(_HALF), left)
        index = builder.lshr(event, one)
        gathered = _call(builder, "llvm.x86.avx512.mask.gather.dpi.512", _HALF, [zero, table, index, there, _I32(2)])
        entry = builder.ashr(builder.shl(gathered, _constant(_HALF, 16)), _constant(_HALF, 16))
        inside = builder.and_(builder.icmp_signed(">", entry, largest), there)
        weight = builder.select(inside, entry, zero)
        is_on = builder.icmp_unsigned("!=", builder.and_(event, one), zero)
        signed = builder.select(is_on, builder.sub(zero, weight), weight)
        builder.store(builder.add(builder.load(elp), signed), elp)
        square = builder.mul(weight, weight)
        for half, total in enumerate(energy):
            part = builder.shuffle_vector(
                square, square, ir.Constant(ir.VectorType(_I32, 8), list(range(8 * half, 8 * half + 8)))
            )
            builder.store(builder.add(builder.load(total), builder.zext(part, _LONGS)), total)
        out_of_sensor = builder.and_(builder.icmp_signed("==", entry, lost), there)
        for bits, total in zip((inside, builder.and_(inside, is_on), out_of_sensor), counts, strict=True):
            more = _call(builder, "llvm.ctpop.i16", _I16, [builder.bitcast(bits, _I16)])
            builder.store(builder.add(builder.load(total), builder.zext(more, _I64)), total)
    wide = ir.VectorType(_I64, 16)
    elp_sum = _call(builder, "llvm.vector.reduce.add.v16i64", _I64, [builder.sext(builder.load(elp), wide)])
    both = builder.add(builder.load(energy[0]), builder.load(energy[1]))
    energy_sum = _call(builder, "llvm.vector.reduce.add.v8i64", _I64, [both])
    return [elp_sum, energy_sum, *(builder.load(total) for total in counts)]


@operation(
    UniTuple(types.int64, 3),
    [types.uint32], types.int64, types.int64, types.int64, types.int64, types.int64,
    [types.int64], [types.uint16], [types.uint16], [types.uint8],
)  # fmt: skip
def unpack(
    builder: Builder,
    lists: Value,
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
    """Write the first *n* events of a list, whose rows are 4096 addresses long, as columns, sixteen at a time.

    The low parts of their times lie in the same array from *lows* on. Returns how many were inside the sensor and
    written, how many had no row there, and how many only no column. Up to 16 places beyond are touched.
    """
    counts = [cgutils.alloca_once_value(builder, _I64(0)) for _ in range(3)]
    one, columns = _constant(_HALF, 1), _constant(_HALF, 0xFFF)
    first_column, first_row = (_splat(builder, builder.trunc(side, _I32), _HALF) for side in (width, height))
    since = _splat(builder, base, _LONGS)
    zero = _constant(_HALF, 0)

    def packed(values: Value, mask: Value) -> Value:
        return _call(builder, "llvm.x86.avx512.mask.compress.v16i32", _HALF, [values, zero, mask])

    with cgutils.for_range_slice(builder, _I64(0), n, _I64(16)) as (begin, _):
        event = _load(builder, lists, begin, _HALF)
        left = _splat(builder, builder.trunc(builder.sub(n, begin), _I32), _HALF)
        there = builder.icmp_unsigned("<", _iota(_HALF), left)
        x = builder.and_(builder.lshr(event, one), columns)
        y = builder.lshr(event, _constant(_HALF, 13))
        in_row = builder.and_(builder.icmp_unsigned("<", y, first_row), there)
        inside = builder.and_(builder.icmp_unsigned("<", x, first_column), in_row)
        at = builder.load(counts[0])
        low = packed(_load(builder, lists, builder.add(lows, begin), _HALF), inside)
        for half in (0, 8):
            part = builder.shuffle_vector(low, low, ir.Constant(ir.VectorType(_I32, 8), list(range(half, half + 8))))
            _store(builder, builder.add(builder.zext(part, _LONGS), since), out_t, builder.add(at, _I64(half)))
        _store(builder, builder.trunc(packed(x, inside), ir.VectorType(_I16, 16)), out_x, at)
        _store(builder, builder.trunc(packed(y, inside), ir.VectorType(_I16, 16)), out_y, at)
        on = builder.trunc(packed(builder.and_(event, one), inside), ir.VectorType(ir.IntType(8), 16))
        _store(builder, on, out_p, at)
        no_row = builder.and_(builder.not_(in_row), there)
        no_column = builder.and_(builder.not_(inside), in_row)
        for bits, total in zip((inside, no_row, no_column), counts, strict=True):
            more = _call(builder, "llvm.ctpop.i16", _I16, [builder.bitcast(bits, _I16)])
            builder.store(builder.add(builder.load(total), builder.zext(more, _I64)), total)
    return [builder.load(total) for total in counts]
