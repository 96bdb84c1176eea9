"""Bit operations that numba has no word for.

Vector words name their pixels by set bits, mostly one to three of twelve; jumping from one set bit to the next is what
keeps them cheap.
"""

from __future__ import annotations

from typing import Any

from numba.core import types
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
