"""ECF as it is described, event by event: the slow twin of ``elpd.events.ecf``."""

from __future__ import annotations


def unpack_chunk(data: bytes) -> list[tuple[int, int, int, int]]:
    """Return t, x, y, p of every event of a sound chunk."""
    head = int.from_bytes(data[:4], "little")
    count = head >> 2
    position = 12

    def take(size: int) -> int:
        nonlocal position
        position += size
        return int.from_bytes(data[position - size : position], "little")

    now = int.from_bytes(data[4:12], "little")
    times: list[int] = []
    while len(times) < count:
        step, shift = 0, 0
        while (byte := take(1)) >> 4 == 15:
            step |= (byte & 15) << shift
            shift += 4
        now = (now + step + (byte >> 4)) % 2**64
        run = byte & 15
        times += [now if now < 2**63 else now - 2**64] * (take(2) if run == 15 else run)
    if head & 2:
        values: list[int] = []
        while len(values) < count:
            a, b, c = take(4), take(4), take(4)
            values += [a >> 8, (a & 0xFF) | b >> 16 << 8, (b & 0xFFFF) | c >> 24 << 16, c & 0xFFFFFF]
        return [(t, v >> 1 & 0x7FF, v >> 12 & 0x7FF, v & 1) for t, v in zip(times, values[:count], strict=True)]
    rows: list[int] = []
    while len(rows) < count:
        word = take(2)
        rows += [word >> 5] * (take(2) if word & 31 == 31 else word & 31)
    if head & 1:
        values = []
        while len(values) < count:
            a, b, c = take(2), take(2), take(2)
            values += [a >> 4, (a & 15) | b >> 8 << 4, (b & 0xFF) | c >> 12 << 8, c & 0xFFF]
        return [(t, v >> 1, y, v & 1) for t, y, v in zip(times, rows, values[:count], strict=True)]
    columns: list[int] = []
    while len(columns) < count:
        word = take(2)
        columns += [word >> 5, *((word >> 5) + k + 1 for k in range(5) if word >> (4 - k) & 1)]
    polarities: list[int] = []
    while len(polarities) < count:
        byte = take(1)
        polarities += [byte >> 7] * (take(2) if byte & 127 == 127 else byte & 127)
    return list(zip(times, columns[:count], rows, polarities, strict=True))
