"""As much of FlatBuffers as AEDAT4 needs: tables of scalars, vectors and tables, size-prefixed, checked.

Every offset is checked against the buffer before it is followed, so damaged bytes end in ``FormatError`` and nothing
else. Layout: https://flatbuffers.dev/internals (little endian; a table points back to a vtable of field offsets).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from elpd.errors import FormatError

if TYPE_CHECKING:
    from collections.abc import Iterator

SIZES = {"b": 1, "B": 1, "h": 2, "H": 2, "i": 4, "I": 4, "q": 8, "f": 4}


class Table(NamedTuple):
    """A table within a buffer that begins with its size. Fields are numbered in the order of their schema."""

    data: bytes
    at: int

    def scalar(self, field: int, letter: str, default: int) -> int:
        """Return a scalar of ``struct``'s *letter*, or the *default* where it is not stored."""
        where = self._where(field)
        return default if where is None else int(_unpack(letter, self.data, where))

    def real(self, field: int) -> float:
        """Return a 32-bit float, 0 where it is not stored."""
        where = self._where(field)
        return 0.0 if where is None else float(_unpack("f", self.data, where))

    def vector(self, field: int, item_bytes: int) -> tuple[int, int]:
        """Return where a vector's items begin and how many there are; (0, 0) where it is not stored."""
        where = self._where(field)
        if where is None:
            return 0, 0
        where += _unpack("I", self.data, where)
        count = _unpack("I", self.data, where)
        if where + 4 + count * item_bytes > len(self.data):
            raise FormatError(f"a vector of {count} items of {item_bytes} bytes passes the end of its buffer")
        return where + 4, count

    def tables(self, field: int) -> Iterator[Table]:
        """Yield the tables of a vector."""
        at, count = self.vector(field, 4)
        for where in range(at, at + 4 * count, 4):
            yield Table(self.data, where + _unpack("I", self.data, where))

    def _where(self, field: int) -> int | None:
        vtable = self.at - _unpack("i", self.data, self.at)
        if 4 + 2 * field + 2 > _unpack("H", self.data, vtable):
            return None
        offset: int = _unpack("H", self.data, vtable + 4 + 2 * field)
        return self.at + offset if offset else None


def root(data: bytes, identifier: bytes) -> Table:
    """Return the root of a size-prefixed buffer. Raises ``FormatError`` if it is not one of *identifier*."""
    if data[8:12] != identifier:
        raise FormatError(f"expected a buffer of {identifier!r}; got {data[8:12]!r}")
    return Table(data, 4 + _unpack("I", data, 4))


@dataclass(frozen=True, slots=True)
class Vector:
    """A vector to write: *length* items, packed in *items*."""

    items: bytes
    length: int


Fields = dict[int, "tuple[str, float] | Vector | Tables"]
"""What to write in a table: a scalar's ``struct`` letter and value, a vector, or tables."""


class Tables(Protocol):
    """The fields of each table of a vector: a list, or what makes them as they are asked for."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Fields]: ...


def build(identifier: bytes, fields: Fields) -> bytes:
    """Return a size-prefixed buffer with a root table of *fields*."""
    out = bytearray(8) + identifier
    at = _append_table(out, fields)
    struct.pack_into("<II", out, 0, len(out) - 4, at - 4)
    return bytes(out)


def _append_table(out: bytearray, fields: Fields) -> int:
    """Append a table, then what it refers to; return where it is."""
    _pad(out, 8, 0)
    vtable_at = len(out)
    vtable_bytes = 4 + 2 * (max(fields) + 1)
    out += bytes(vtable_bytes)
    _pad(out, 8, 0)
    table_at, cursor = len(out), 8
    places: dict[int, int] = {}
    # Large ones first, so that each is aligned to its own size.
    for field, value in sorted(fields.items(), key=lambda one: -_inline_bytes(one[1])):
        places[field] = cursor
        cursor += _inline_bytes(value)
    out += bytes(cursor)
    struct.pack_into("<HH", out, vtable_at, vtable_bytes, cursor)
    struct.pack_into("<i", out, table_at, table_at - vtable_at)
    for field, value in fields.items():
        struct.pack_into("<H", out, vtable_at + 4 + 2 * field, places[field])
        where = table_at + places[field]
        if isinstance(value, tuple):
            struct.pack_into(f"<{value[0]}", out, where, value[1])
            continue
        _pad(out, 8, 4)  # a vector's items, behind their count, are aligned to eight
        struct.pack_into("<I", out, where, len(out) - where)
        if isinstance(value, Vector):
            out += struct.pack("<I", value.length) + value.items
            continue
        out += struct.pack("<I", len(value))
        offsets_at = len(out)
        out += bytes(4 * len(value))
        for k, inner in enumerate(value):
            here = offsets_at + 4 * k
            struct.pack_into("<I", out, here, _append_table(out, inner) - here)
    return table_at


def _inline_bytes(value: Any) -> int:
    return SIZES[value[0]] if isinstance(value, tuple) else 4


def _pad(out: bytearray, alignment: int, remainder: int) -> None:
    out += bytes((remainder - len(out)) % alignment)


def _unpack(letter: str, data: bytes, at: int) -> Any:
    if not 0 <= at <= len(data) - SIZES[letter]:
        raise FormatError(f"offset {at} passes the end of a buffer of {len(data)} bytes")
    return struct.unpack_from(f"<{letter}", data, at)[0]
