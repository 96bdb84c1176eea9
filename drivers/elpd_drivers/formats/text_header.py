"""The text in front of Prophesee's files, RAW and DAT: lines ``% key value``.

Newer files close it with ``% end``, older ones just stop, so it ends at the first line that does not look like one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import FormatError

if TYPE_CHECKING:
    from pathlib import Path

MAX_HEADER_BYTES = 1 << 16
MAX_LINE_BYTES = 1024


def read_header(path: Path) -> tuple[dict[str, str], int]:
    """Return the header's fields, keys in small letters, and where the payload begins.

    Raises ``FormatError`` if the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    fields: dict[str, str] = {}
    offset = 0
    while text[offset : offset + 1] == b"%":
        end = text.find(b"\n", offset, offset + MAX_LINE_BYTES)
        line = text[offset + 1 : end].rstrip(b"\r")
        # Without `% end`, a payload that begins with 0x25 looks like a line until its other bytes are seen.
        if end < 0 or any(byte < 0x20 or byte == 0x7F for byte in line):
            break
        offset = end + 1
        key, _, value = line.decode("utf-8", "replace").strip().partition(" ")
        if key == "end":
            break
        fields[key.lower()] = value.strip()
    return fields, offset
