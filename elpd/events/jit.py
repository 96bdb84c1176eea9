"""One decorator for every kernel: eager, ``nogil``, cached where a cache can be had.

Kernels compile when their module is imported, never while a motor moves. The on-disk cache is an optimisation: where
no cache directory is writable (a hardened service without one) numba refuses at decoration time, and the kernel is
compiled without a cache instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(*signatures: str) -> Callable[[F], F]:
    """Compile a function eagerly for *signatures* (numba's notation), without the GIL while it runs.

    With no signature the function is compiled on first use by another kernel: for helpers that kernels call.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "boundscheck": False}
    arguments: tuple[Any, ...] = (list(signatures),) if signatures else ()

    def compile_now(function: F) -> F:
        try:
            return cast("F", numba.njit(*arguments, cache=True, **options)(function))
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
            return cast("F", numba.njit(*arguments, **options)(function))

    return compile_now
