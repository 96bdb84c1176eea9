"""One decorator for every kernel: eager, ``nogil``, cached where a cache can be had.

Kernels compile when their module is imported, never while a motor moves. The on-disk cache is an optimisation: where
no cache directory is writable (a hardened service without one) numba refuses at decoration time, and the kernel is
compiled without a cache instead (``kernel_cache``).

Kernels borrow their arrays from Python, so they are compiled without reference counting: its atomic increments around
each helper made half the cost of a word (EVT3 at 3.9 instead of 3.1 ns a word). The price is that they cannot allocate;
the few that must say so.

Who compiles what no cache has, and when, is ``division``'s to say: this process as it imports, unless somebody has
others do it, or puts it off. Compiling is mostly inferring types, again for each way in which a helper is called; so
that whole numbers are numbers, whether or not their value was written there, is what saves most of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar, cast

import numba
from numba.core import types

from elpd.events.kernel_cache import KernelCache, full_name


class PutOff(NamedTuple):
    """A kernel that was imported and not compiled."""

    name: str
    """Its full name, which variants of one function share as they share a cache file."""

    serves: str
    """What it is for, where not everybody needs it; else empty."""

    compile: Callable[[], None]


@dataclass(slots=True)
class Division:
    """Who compiles what no cache has. One per process, since kernels compile as their modules are imported."""

    others: Callable[[], None] | None = None
    """Called once, at the first kernel that no cache has; what it leaves in the cache need not be compiled here."""

    put_off: list[PutOff] | None = None
    """Where it is a list, kernels are not compiled as they are imported but put there, to be compiled or not. One that
    another takes in is compiled with that; one that is called all the same is compiled then."""


division = Division()

F = TypeVar("F", bound=Callable[..., Any])


def kernel(*signatures: str, allocates: bool = False, serves: str = "") -> Callable[[F], F]:
    """Compile a function eagerly for *signatures* (numba's notation), without the GIL while it runs.

    With no signature the function is compiled on first use by another kernel: for helpers that kernels call. A kernel
    that makes arrays says that it *allocates*; without that word numba refuses it. One that only some need says whom it
    *serves*: an encoding's value, for one.
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

        _take_numbers_as_numbers(dispatcher)

        def compile_all() -> None:
            for signature in signatures:
                dispatcher.compile(signature)
            dispatcher.disable_compile()

        if signatures and division.put_off is None:
            compile_all()
        elif signatures and division.put_off is not None:
            division.put_off.append(PutOff(full_name(function), serves, compile_all))
        return cast("F", dispatcher)

    return compile_now


def _take_numbers_as_numbers(dispatcher: Any) -> None:
    """Let kernels that call this one with a number that stands in the source share what those with a variable have.

    numba would compile it once more for each such number, and for each that a variable begins with. Truth values are
    left as they are: a branch on one is gone from the code.
    """
    ask = dispatcher.get_call_template

    def plain(kind: Any) -> Any:
        return kind.literal_type if isinstance(kind, types.IntegerLiteral) else kind

    dispatcher.get_call_template = lambda args, kws: ask(
        tuple(plain(kind) for kind in args), {name: plain(kind) for name, kind in kws.items()}
    )


def _by_others() -> bool:
    """Have others compile what no cache has, the first time that something is missing; ``False`` if nobody did."""
    others, division.others = division.others, None
    if others is None:
        return False
    others()
    return True
