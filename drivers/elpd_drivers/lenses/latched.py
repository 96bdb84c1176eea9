"""A line that remembers its fault: what broke once is not tried again until somebody opens it anew."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import LensError

if TYPE_CHECKING:
    from elpd.ports import BytePort


class LatchedPort:
    """A ``BytePort`` in front of another one, with a latch. Drivers own one each."""

    def __init__(self, port: BytePort) -> None:
        self._port = port
        self._fault: str | None = None

    def write(self, data: bytes) -> None:
        """Write, or latch that the line is dead."""
        try:
            self._port.write(data)
        except LensError as error:
            self._latch(str(error))
            raise

    def read_available(self) -> bytes:
        """Read what has come, or latch that the line is dead."""
        try:
            return self._port.read_available()
        except LensError as error:
            self._latch(str(error))
            raise

    def close(self) -> None:
        """Give the line back. Idempotent."""
        self._port.close()

    def check(self) -> None:
        """Raise the latched fault, if there is one."""
        if self._fault is not None:
            raise LensError(self._fault)

    def trouble(self, what: str, strongest: bytes, name: str) -> LensError:
        """Send the strongest stop (called *name*), latch *what* went wrong, and return what to raise."""
        try:
            self._port.write(strongest)
        except LensError as error:
            what = f"{what} (and the {name} could not be written: {error})"
        self._latch(f"lens: {what}")
        return LensError(self._fault)

    def _latch(self, fault: str) -> None:
        self._fault = self._fault or fault
