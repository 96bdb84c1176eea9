"""Where compiled kernels are kept: a file for each, whose name says what is in it.

numba's own cache keeps an index of numbered files beside them. A process that dies between the two, or two processes
that compile at once, can leave it pointing at another variant of the function, or at the code of an older version, and
nobody notices. Here a file is found by what it must hold: version, source, signature, processor, and what the kernel
has closed over; whoever writes it writes the same. numba knows a kernel by its own source file; what it takes in from
others (helpers that are compiled into it, constants that are frozen into it) is added to that.
"""

from __future__ import annotations

import inspect
import os
import pickle
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import structlog
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.extending import intrinsic

if TYPE_CHECKING:
    from collections.abc import Callable

_Intrinsic = type(intrinsic(lambda typing_context: None))  # noqa: ARG005  (numba does not export it)


class KernelCache(FunctionCache):  # type: ignore[misc]  # numba ships no types
    """The cache of one function. Raises ``RuntimeError`` where there is no place for one.

    Parameters
    ----------
    function
        What is compiled.
    missed
        Asked when something is not there; says whether it is worth looking again.
    """

    def __init__(self, function: Callable[..., Any], missed: Callable[[], bool] = lambda: False) -> None:
        super().__init__(function)
        stamp = (numba.__version__, self._impl.locator.get_source_stamp(), _taken_in(function))
        self._cache_file = KernelFiles(Path(self._cache_path), self._impl.filename_base, stamp)
        self._kernel = full_name(function)
        self._missed = missed

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what is kept for a signature, or has been since it was asked for; else ``None``."""
        found = self._load(sig, target_context)
        return self._load(sig, target_context) if found is None and self._missed() else found

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """Return what tells variants apart; as in a dispatcher's table a signature is its arguments."""
        args, _ = normalize_signature(sig)
        return super()._index_key(args, codegen)

    def _load(self, sig: Any, target_context: Any) -> Any:
        """Return what is kept; a torn or foreign file is forgotten, said, and written anew."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # noqa: BLE001  (a damaged pickle raises anything)
            with suppress(OSError):  # a cache that cannot be written is not used at all
                self.flush()
            structlog.get_logger().warning("damaged kernel made anew", kernel=self._kernel, reason=repr(error))
            return None


class KernelFiles:
    """The files of one function: ``<name>.<digest of the source>.<digest of the variant>.nbc``."""

    def __init__(self, folder: Path, name: str, stamp: object) -> None:
        self._folder = folder
        self._name = name
        self._source = sha256(repr(stamp).encode()).hexdigest()[:16]

    def load(self, key: object) -> Any:
        """Return what was saved for *key*, ``None`` of nothing."""
        try:
            return pickle.loads(self._path(key).read_bytes())  # noqa: S301  (written by us, in a folder of ours)
        except FileNotFoundError:
            return None

    def save(self, key: object, data: Any) -> None:
        """Keep *data*; what was made of another source goes."""
        path = self._path(key)
        beside = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            beside.write_bytes(dumps(data))
            beside.replace(path)
        except OSError:
            beside.unlink(missing_ok=True)
            raise
        for old in self._folder.glob(f"{self._name}.*"):
            if not old.name.startswith(f"{self._name}.{self._source}."):
                old.unlink(missing_ok=True)

    def flush(self) -> None:
        """Forget everything."""
        for path in self._folder.glob(f"{self._name}.*.nbc"):
            path.unlink(missing_ok=True)

    def _path(self, key: object) -> Path:
        return self._folder / f"{self._name}.{self._source}.{sha256(repr(key).encode()).hexdigest()[:16]}.nbc"


def full_name(function: Callable[..., Any]) -> str:
    """Return module and name of a function."""
    return f"{function.__module__}.{function.__qualname__}"


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
        # What a function closes over is in numba's own key; here it would part variants that share a stamp.
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
