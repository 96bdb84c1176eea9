"""One decorator for every kernel: eager, ``nogil``, cached where a cache can be had.

Kernels compile when their module is imported, never while a motor moves. The on-disk cache is an optimisation: where
no cache directory is writable (a hardened service without one) numba refuses at decoration time, and the kernel is
compiled without a cache instead (``kernel_cache``).

Kernels borrow their arrays from Python, so they are compiled without reference counting: its atomic increments around
each helper made half the cost of a word (EVT3 at 3.9 instead of 3.1 ns a word). The price is that they cannot allocate;
the few that must say so.

Who compiles what no cache has is ``division``'s to say: this process, unless somebody has others do it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numba

from elpd.events.kernel_cache import KernelCache, full_name


@dataclass(slots=True)
class Division:
    """Who compiles what no cache has. One per process, since kernels compile as their modules are imported."""

    others: Callable[[], None] | None = None
    """Called once, at the first kernel that no cache has; what it leaves in the cache need not be compiled here."""

    put_off: list[tuple[str, Callable[[], None]]] | None = None
    """Where it is a list, kernels are not compiled as they are imported but put there, to be called or not: their full
    name, which variants of one function share as they share a cache file, and what compiles them. One that another
    takes in is compiled with that."""


division = Division()

F = TypeVar("F", bound=Callable[..., Any])


def kernel(*signatures: str, allocates: bool = False) -> Callable[[F], F]:
    """Compile a function eagerly for *signatures* (numba's notation), without the GIL while it runs.

    With no signature the function is compiled on first use by another kernel: for helpers that kernels call. A kernel
    that makes arrays says that it *allocates*; without that word numba refuses it.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "boundscheck": False, "_nrt": allocates}

    def compile_now(function: F) -> F:
        dispatcher = numba.njit(**options)(function)
        if numba.config.DISABLE_JIT:
            return cast("F", dispatcher)
        try:
            dispatcher._cache = KernelCache(function, _by_others)  # noqa: SLF001  (where numba's own enable_caching() puts it)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise

        def compile_all() -> None:
            for signature in signatures:
                dispatcher.compile(signature)
            dispatcher.disable_compile()

        if signatures and division.put_off is None:
            compile_all()
        elif signatures and division.put_off is not None:
            division.put_off.append((full_name(function), compile_all))
        return cast("F", dispatcher)

    return compile_now


def _by_others() -> bool:
    """Have others compile what no cache has, the first time that something is missing; ``False`` if nobody did."""
    others, division.others = division.others, None
    if others is None:
        return False
    others()
    return True
