"""What arrives from a controller that talks in lines of ASCII."""

from __future__ import annotations

MAX_LINE = 512


class LineReader:
    """Cuts what arrives into lines; what is not ASCII or too long is not a line."""

    def __init__(self) -> None:
        self._partial = bytearray()

    def feed(self, data: bytes) -> list[tuple[str, int]]:
        """Return the lines that are complete now, without their ends, each with the number of bytes after it."""
        self._partial += data
        lines: list[tuple[str, int]] = []
        while (end := self._partial.find(b"\n")) >= 0:
            raw = bytes(self._partial[:end]).strip(b"\r\n\0 ")
            del self._partial[: end + 1]
            if raw and raw.isascii():
                lines.append((raw.decode("ascii"), len(self._partial)))
        if len(self._partial) > MAX_LINE:
            self._partial.clear()
        return lines
