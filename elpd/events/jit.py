"""One decorator for every kernel: eager, ``nogil``, cached where a cache can be had.

Kernels compile when their module is imported, never while a motor moves. The on-disk cache is an optimisation: where
no cache directory is writable (a hardened service without one) numba refuses at decoration time, and the kernel is
compiled without a cache instead. numba's cache knows a kernel by its own file and the processor; what a kernel takes
in from other files (helpers that are compiled into it, constants that are frozen into it) is added to that here.

Kernels borrow their arrays from Python, so they are compiled without reference counting: its atomic increments around
each helper made half the cost of a word (EVT3 at 3.9 instead of 3.1 ns a word). The price is that they cannot allocate;
the few that must say so.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numba
import numpy as np
import structlog
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.extending import intrinsic

F = TypeVar("F", bound=Callable[..., Any])
_Intrinsic = type(intrinsic(lambda typing_context: None))  # noqa: ARG005  (numba does not export it)


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
            dispatcher._cache = _Cache(function)  # noqa: SLF001  (where numba's own enable_caching() puts it)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
        for signature in signatures:
            dispatcher.compile(signature)
        if signatures:
            dispatcher.disable_compile()
        return cast("F", dispatcher)

    return compile_now


class _Cache(FunctionCache):  # type: ignore[misc]  # numba ships no types
    """numba's cache of one function, stale also when something that is compiled into the function has changed."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=(self._impl.locator.get_source_stamp(), _taken_in(function)),
        )
        self._kernel = f"{function.__module__}.{function.__name__}"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what is kept for a signature; a torn or foreign file is forgotten, said, and written anew."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # noqa: BLE001  (a damaged pickle raises anything)
            with suppress(OSError):  # a cache that cannot be written is not used at all
                self.flush()
            structlog.get_logger().warning("damaged kernel made anew", kernel=self._kernel, reason=repr(error))
            return None


def _taken_in(function: Any) -> str:
    """Return a digest of the constants that a function freezes and of the files that its helpers come from."""
    digest = sha256()
    waiting, seen = [function], set()
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        digest.update(_content(one.__code__.co_filename))
        # What a function closes over is in numba's own key; here it would tell variants apart that share an index.
        for name, value in sorted(inspect.getclosurevars(one).globals.items()):
            if isinstance(value, int | float | np.generic):
                digest.update(f"{name}={value!r}".encode())
            elif isinstance(value, _Intrinsic):
                waiting.append(value._defn)  # noqa: SLF001
                waiting += [value._defn.emit] if hasattr(value._defn, "emit") else []  # noqa: SLF001
            elif isinstance(getattr(value, "py_func", None), FunctionType):
                waiting.append(value.py_func)
    return digest.hexdigest()


@cache
def _content(file: str) -> bytes:
    try:
        return sha256(Path(file).read_bytes()).digest()
    except OSError:  # a zipped or frozen package: its version is its file's stamp
        return file.encode()
