"""The HDF5 library behind a pipe: whatever a file does to it, there is an answer or a ``FormatError``."""

from __future__ import annotations

import importlib.util
import json
import os
import select
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from elpd.errors import FormatError
from elpd_drivers.formats import hdf5_child

PATIENCE_S = 60.0
"""Longer than any sound answer takes: a megabyte or a chunk, from a slow disk."""

MOST_BYTES = 1 << 30
NO_H5PY = "HDF5 files need h5py: pip install h5py"


class Library:
    """A child process that has an HDF5 file open."""

    def __init__(self, path: Path) -> None:
        if not installed():
            raise FormatError(f"{path}: {NO_H5PY}")
        self._path = path
        self._child = subprocess.Popen(  # noqa: S603  (our own program)
            [sys.executable, "-P", str(Path(hdf5_child.__file__)), str(path.absolute())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )

    def ask(self, **question: Any) -> hdf5_child.Answer:
        """Return the answer. Raises ``FormatError`` with what the library says, or if it crashed or hangs."""
        assert self._child.stdin is not None, "it is a pipe"
        try:
            self._child.stdin.write(json.dumps(question).encode() + b"\n")
            self._child.stdin.flush()
        except OSError:
            self._fail("the HDF5 library crashed on it")
        text_bytes, data_bytes = hdf5_child.HEAD.unpack(self._read(hdf5_child.HEAD.size))
        if text_bytes + data_bytes > MOST_BYTES:
            self._fail(f"one piece of it has {data_bytes} bytes")
        header = json.loads(self._read(text_bytes))
        data = self._read(data_bytes)
        if "error" in header:
            raise FormatError(told(self._path, header["error"]))
        return header, data

    def close(self) -> None:
        """End the child. Idempotent."""
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                with suppress(OSError):  # a question that was not taken yet is of no use to anybody
                    pipe.close()

    def _read(self, size: int) -> bytes:
        assert self._child.stdout is not None, "it is a pipe"
        pipe = self._child.stdout.fileno()
        pieces = []
        while size:
            if not select.select([pipe], [], [], PATIENCE_S)[0]:
                self._fail(f"the HDF5 library was still searching it after {PATIENCE_S:g} s")
            piece = os.read(pipe, size)
            if not piece:
                self._fail("the HDF5 library crashed on it")
            pieces.append(piece)
            size -= len(piece)
        return b"".join(pieces)

    def _fail(self, what: str) -> None:
        self.close()
        raise FormatError(f"{self._path} is damaged: {what}")


def installed() -> bool:
    """Say whether h5py is there."""
    try:
        return importlib.util.find_spec("h5py") is not None
    except ValueError:  # it is marked as missing
        return False


def told(path: Path, words: str) -> str:
    """Return what the library says as a sentence that helps."""
    if "filter" in words or "plugin" in words:
        return f"{path} is compressed in a way that is not installed here; try: pip install hdf5plugin ({words})"
    return f"{path} cannot be read as events: {words}"
