"""Vector operations that numba has no word for, as LLVM intrinsics: how to make them, and their common pieces.

Everything made of this selects instructions of AVX-512 (F, BW, VL, DQ, VBMI2: Intel since 2019, AMD since 2022) where
there are any, or of AVX2 (Intel since 2013, AMD since 2015). ``available()`` says whether kernels that use it may be
*compiled* at all, ``wide()`` for which. Both ask what numba compiles for, which is also what numba keys its cache on:
code cached by one processor is not found by another.
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
AVX512 = frozenset({"+avx512f", "+avx512bw", "+avx512vl", "+avx512dq", "+avx512vbmi2"})
AVX2 = frozenset({"+avx2", "+popcnt"})

LANES = 32
I1, I8, I16, I32, I64 = (ir.IntType(bits) for bits in (1, 8, 16, 32, 64))
WORDS, BITS = ir.VectorType(I16, LANES), ir.VectorType(I1, LANES)
HALF = ir.VectorType(I32, 16)
LONGS = ir.VectorType(I64, 8)
Builder = Any
Value = Any


@cache
def _features() -> frozenset[str]:
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    return frozenset(features.split(","))


def instructions() -> str | None:
    """Return the name of the instructions that numba compiles these operations to; ``None`` if there are none."""
    return "AVX-512" if wide() else "AVX2" if _features() >= AVX2 else None


def available() -> bool:
    """Say whether numba compiles for a processor that has such instructions, of either kind."""
    return instructions() is not None


def wide() -> bool:
    """Say whether it has those of AVX-512."""
    return _features() >= AVX512


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
        typed.emit = emit  # type: ignore[attr-defined]  # for the digest of what a cached kernel is made of
        return intrinsic(typed)

    return decorate


def constant(vector: Any, value: int) -> Value:
    """Return a vector of one value."""
    return ir.Constant(vector, [value] * vector.count)


def iota(vector: Any, begin: int = 0) -> Value:
    """Return a vector that counts from *begin*."""
    return ir.Constant(vector, list(range(begin, begin + vector.count)))


def splat(builder: Builder, scalar: Value, vector: Any) -> Value:
    """Return a vector of a scalar, cut to its lanes' width."""
    if scalar.type.width > vector.element.width:
        scalar = builder.trunc(scalar, vector.element)
    single = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, I32(0))
    return builder.shuffle_vector(single, single, constant(ir.VectorType(I32, vector.count), 0))


def call(builder: Builder, name: str, result: Any, arguments: list[Value]) -> Value:
    """Call an intrinsic of LLVM's."""
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), arguments)


def as_words(builder: Builder, data: Value) -> Value:
    """Return a pointer as one to 16 bits: lists of those lie in memory that others use for larger numbers."""
    return builder.bitcast(data, I16.as_pointer())


def load(builder: Builder, data: Value, index: Value, vector: Any) -> Value:
    """Load a vector from an element on, aligned to elements."""
    loaded = builder.load(builder.bitcast(builder.gep(data, [index]), vector.as_pointer()))
    loaded.align = vector.element.width // 8
    return loaded


def store(builder: Builder, value: Value, data: Value, index: Value) -> None:
    """Store a vector from an element on, aligned to elements."""
    pointer = builder.bitcast(builder.gep(data, [index]), value.type.as_pointer())
    builder.store(value, pointer).align = value.type.element.width // 8


def population(builder: Builder, bits: Value) -> Value:
    """Return how many bits of a vector of them are set, as I64."""
    number = bits if isinstance(bits.type, ir.IntType) else builder.bitcast(bits, ir.IntType(bits.type.count))
    return builder.zext(call(builder, f"llvm.ctpop.i{number.type.width}", number.type, [number]), I64)


def part(builder: Builder, values: Value, begin: int, count: int) -> Value:
    """Return *count* lanes from *begin* on."""
    order = ir.Constant(ir.VectorType(I32, count), list(range(begin, begin + count)))
    return builder.shuffle_vector(values, values, order)


def lanes_left(builder: Builder, done: Value, n: Value, vector: Any) -> Value:
    """Return the bits of the lanes from *done* on that are below *n*."""
    return builder.icmp_unsigned("<", iota(vector), splat(builder, builder.sub(n, done), vector))


def running(builder: Builder, kind: Any) -> Value:
    """Return the place of a sum of a vector or number, zero before a loop."""
    zero = constant(kind, 0) if isinstance(kind, ir.VectorType) else kind(0)
    return cgutils.alloca_once_value(builder, zero)


def add(builder: Builder, total: Value, more: Value) -> None:
    """Add to a running sum."""
    builder.store(builder.add(builder.load(total), more), total)
