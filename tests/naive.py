"""Slow, obvious twins of the kernels: one branch per rule, plain Python integers, nothing clever.

A kernel is right when it equals its twin to the last bit for any input and any cut of it.
"""

from collections import Counter, defaultdict
from typing import Any

# --- events: word streams ------------------------------------------------------------------------------------------
#
# Each decoder turns words into items: ("time", t) when the stream says that it is t, ("event", t, x, y, on) for an
# event inside the sensor, ("outside", t) for one outside of it or of no known row, ("trigger", t, id, rising).


def decode_evt3(words: Any, width: int, height: int) -> Any:
    items, odd = [], Counter()
    rate = {0x014: 0, 0x016: 0}
    loop, high, low = 0, None, 0
    row, base, base_on = None, None, 0
    subtype, continued = None, []

    def event(x: int | None, on: int) -> None:
        if row is None or row >= height:
            odd["y_out_of_range"] += 1
            items.append(("outside", t))
        elif x is None or x >= width:
            odd["x_out_of_range"] += 1
            items.append(("outside", t))
        else:
            items.append(("event", t, x, row, on))

    for word in map(int, words):
        kind, content = word >> 12, word & 0xFFF
        if high is None and kind != 0x8:
            odd["before_time"] += 1
            continue
        if kind == 0x8 and content != high:
            if high is not None and high >= 2048 + content:
                loop += 1
            high, low = content, 0
        elif kind == 0x6:
            low = content
        t = loop * 2**24 + high * 2**12 + low
        if kind in (0x8, 0x6):
            items.append(("time", t))
        elif kind == 0x0:
            row = content
        elif kind == 0x2:
            event(content & 0x7FF, content >> 11)
        elif kind == 0x3:
            base, base_on = content & 0x7FF, content >> 11
        elif kind in (0x4, 0x5):
            bits = 12 if kind == 0x4 else 8
            for bit in range(bits):
                if content & (1 << bit):
                    event(None if base is None else base + bit, base_on)
            base = None if base is None else base + bits
        elif kind == 0xA:
            items.append(("trigger", t, content >> 8, content & 1))
        elif kind == 0xE:
            subtype, continued = content, []
            if subtype not in rate:
                odd["others"] += 1
        elif kind in (0xF, 0x7):
            if subtype is None:
                odd["stray_continued"] += 1
            elif subtype in rate:
                if kind == 0xF and len(continued) < 2:
                    continued.append(content)
                elif kind == 0x7 and len(continued) == 2:
                    rate[subtype] += continued[0] + (continued[1] << 12) + ((content & 0xF) << 24)
                    subtype = None
                else:
                    odd["stray_continued"] += 1
                    subtype = None
        elif word == 0x9999:
            odd["padding"] += 1
        else:
            odd["reserved"] += 1
    return items, odd, (rate[0x014], rate[0x016])


def survey_evt3(words: Any) -> tuple[int | None, int, int]:
    """Return the time at the end, how many events, how many the rate controller held back."""
    items, _, _ = decode_evt3(words, 1 << 12, 1 << 12)
    times = [item[1] for item in items if item[0] == "time"]
    events = sum(item[0] in ("event", "outside") for item in items)
    dropped, before, words = 0, None, list(map(int, words))
    begin = next((i for i, word in enumerate(words) if word >> 12 == 0x8), len(words))
    subtype, continued = None, []
    for word in words[begin:]:
        kind, content = word >> 12, word & 0xFFF
        if kind == 0xE:
            subtype, continued = content, []
        elif kind in (0xF, 0x7) and subtype in (0x014, 0x016):
            if kind == 0xF and len(continued) < 2:
                continued.append(content)
                continue
            if kind == 0x7 and len(continued) == 2:
                count = continued[0] + (continued[1] << 12) + ((content & 0xF) << 24)
                if subtype == 0x014:
                    before = count
                elif before is not None:
                    dropped, before = dropped + max(0, before - count), None
            subtype = None
    return times[-1] if times else None, events, dropped


def decode_evt2(words: Any, width: int, height: int) -> Any:
    items, odd = [], Counter()
    loop, high = 0, None
    for word in map(int, words):
        kind = word >> 28
        if kind == 0x8:
            content = word & 0xFFFFFFF
            if high is not None and high - content >= 2**27:
                loop += 1
            if content != high:
                items.append(("time", loop * 2**34 + content * 64))
            high = content
            continue
        if high is None:
            odd["before_time"] += 1
            continue
        t = loop * 2**34 + high * 64 + ((word >> 22) & 63)
        x, y = (word >> 11) & 0x7FF, word & 0x7FF
        if kind in (0, 1):
            _address(items, odd, t, x, y, kind, width, height)
        elif kind == 0xA:
            items.append(("trigger", t, (word >> 8) & 31, word & 1))
        elif kind in (0xE, 0xF):
            odd["others"] += 1
        else:
            odd["reserved"] += 1
    return items, odd, (0, 0)


def decode_evt21(words: Any, width: int, height: int) -> Any:
    items, odd = [], Counter()
    rate = {0x014: 0, 0x016: 0}
    loop, high = 0, None
    for word in map(int, words):
        kind, upper, lower = word >> 60, word >> 32, word & 0xFFFFFFFF
        if kind == 0x8:
            content = upper & 0xFFFFFFF
            if high is not None and high - content >= 2**27:
                loop += 1
            if content != high:
                items.append(("time", loop * 2**34 + content * 64))
            high = content
            continue
        if high is None:
            odd["before_time"] += 1
            continue
        t = loop * 2**34 + high * 64 + ((upper >> 22) & 63)
        x, y = (upper >> 11) & 0x7FF, upper & 0x7FF
        if kind in (0, 1):
            for bit in range(32):
                if lower & (1 << bit):
                    _address(items, odd, t, x + bit, y, kind, width, height)
        elif kind == 0xA:
            items.append(("trigger", t, (upper >> 8) & 31, upper & 1))
        elif kind == 0xE and upper & 0xFFFF in rate:
            rate[upper & 0xFFFF] += lower & 0x3FFFFF
        elif kind in (0xE, 0xF):
            odd["others"] += 1
        else:
            odd["reserved"] += 1
    return items, odd, (rate[0x014], rate[0x016])


def _address(items: Any, odd: Any, t: Any, x: Any, y: Any, on: Any, width: int, height: int) -> None:
    if y >= height:
        odd["y_out_of_range"] += 1
        items.append(("outside", t))
    elif x >= width:
        odd["x_out_of_range"] += 1
        items.append(("outside", t))
    else:
        items.append(("event", t, x, y, on))


def decode_arrays(t: Any, x: Any, y: Any, p: Any, width: int, height: int) -> Any:
    items = []
    for one_t, one_x, one_y, one_p in zip(t, x, y, p, strict=True):
        one_x, one_y = int(one_x), int(one_y)
        if 0 <= one_x < width and 0 <= one_y < height:
            items.append(("event", int(one_t), one_x, one_y, int(one_p == 1)))
        else:
            items.append(("outside", int(one_t)))
    return items


# --- events: ELP windows -------------------------------------------------------------------------------------------


def alone(last_of_cell: dict[tuple[int, int], tuple[int, int, int]], t: int, x: int, y: int, support_us: int) -> bool:
    """Say whether no other pixel of a cell of 2x2 was its last to fire, at most so long ago; remember this event."""
    last = last_of_cell.get((x // 2, y // 2))
    last_of_cell[x // 2, y // 2] = (t, x, y)
    return last is None or t - last[0] > support_us or last[1:] == (x, y)


def elp_windows(
    items: Any, weights: Any, inside: Any, edges: Any, *, rate_cap: bool = False, support_us: int = 0,
    sums: Any = (0, 0, 0, 0, 0)
) -> Any:  # fmt: skip
    """Return closed rows (begin, end, elp, energy, n_on, n_off, n_capped) and what went nowhere."""
    rows, nowhere = [], Counter()
    sums = list(sums)
    cursor = -1  # the open window begins at edges[cursor]
    ready_us = defaultdict(lambda: None)
    last_of_cell: dict[tuple[int, int], tuple[int, int, int]] = {}
    for item in items:
        kind, t = item[0], item[1]
        if kind == "trigger":
            continue
        while cursor + 1 < len(edges) and t >= edges[cursor + 1]:
            if cursor >= 0:
                rows.append((edges[cursor], edges[cursor + 1], *sums))
            else:
                nowhere["early"] += sums[2] + sums[3]
            sums = [0, 0, 0, 0, 0]
            cursor += 1
        if kind == "outside":
            nowhere["outside"] += 1
            nowhere["out_of_sensor"] += 1
        if kind != "event":
            continue
        _, _, x, y, on = item
        if not inside[y, x]:
            nowhere["outside"] += 1
            continue
        if rate_cap:
            # A bucket of 8 that one event leaves each 625 us; ready_us is when it will be empty.
            ready = ready_us[x, y]
            ready = t if ready is None or ready < t else ready
            if ready - t > 7 * 625:
                sums[4] += 1
                continue
            ready_us[x, y] = ready + 625
        if support_us and alone(last_of_cell, t, x, y, support_us):
            sums[4] += 1
            continue
        weight = int(weights[y, x])
        sums[0] -= weight if on else -weight
        sums[1] += weight * weight
        sums[2 if on else 3] += 1
        if cursor >= 0 and t < edges[cursor]:
            nowhere["late"] += 1
    return rows, nowhere
