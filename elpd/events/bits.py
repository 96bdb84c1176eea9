"""Single instructions that numba has no word for.

Vector words name their pixels by set bits, mostly one to three of twelve; jumping from one set bit to the next is what
keeps them cheap. A table that no cache holds is asked for ahead of time.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic


@intrinsic  # type: ignore[untyped-decorator]  # numba ships no types
def trailing_zeros(typing_context: Any, value: Any) -> Any:
    """Return the index of the lowest set bit of a ``uint32``; 32 for zero."""
    del typing_context
    if value != types.uint32:
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        del context, signature
        return builder.cttz(arguments[0], arguments[0].type.__class__(1)(0))

    return types.uint32(types.uint32), generate


@intrinsic  # type: ignore[untyped-decorator]  # numba ships no types
def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Ask for an element of an array to be brought near, to be written soon. Any index is harmless."""
    del typing_context

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        pointer = builder.bitcast(builder.gep(data, [arguments[1]]), ir.IntType(8).as_pointer())
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, word, word, word])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, word(1), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(array, index), generate
