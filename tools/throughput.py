"""How fast are our kernels beside others', on a real recording: ``tools/throughput.py FILE [--json]``.

Absolute speeds on a shared machine mean little, so what counts here are ratios within a round: every contender runs
once per round, interleaved, over the same bytes, timed by CPU time; a ratio is the median over rounds, and how far the
rounds lay apart is said beside it. The recording's payload is tiled to 100 MB, with TIME_HIGH rewritten so that time
goes on. A memcpy of the same bytes runs along, as the measure of the machine. What is fed piece by piece gets 128 KiB
at a time, as a camera's USB transfers would bring it.

The best peer of a round is the fastest that decodes correctly. expelliarmus is shown and left out: it invents times.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

from elpd_drivers.formats.raw_write import write_raw
from speed import stream
from speed.contender import Contender, Missing, race, ratio
from speed.ours import ours
from speed.peers import DECODERS, FRAME, LOOP, SIGNED, peers

from elpd.errors import ElpdError
from elpd.events.simd import instructions

WRONG = ("expelliarmus",)

RATIOS = {
    "fused_simd_vs_best_peer_decode": ("elpd fused simd", "best peer"),
    "fused_scalar_vs_best_peer_decode": ("elpd fused scalar", "best peer"),
    "fused_simd_vs_numpy_event_frame": ("elpd fused simd", FRAME),
    "decode_vs_best_peer": ("elpd decode", "best peer"),
    "fused_scalar_vs_numpy_event_frame": ("elpd fused scalar", FRAME),
    "fused_simd_vs_signed_frame": ("elpd fused simd", SIGNED),
    "fused_simd_vs_paper_loop": ("elpd fused simd", LOOP),
    "fused_simd_vs_fused_scalar": ("elpd fused simd", "elpd fused scalar"),
    "fused_simd_vs_memcpy": ("elpd fused simd", "memcpy"),
    "first_events_vs_decoded": ("elpd first events", "elpd first events, decoded"),
}
PER_EVENT = {"arrays_vs_best_peer_decode": ("elpd arrays to ELP", "best peer")}
"""Ratios of events, not of bytes, per second: the contenders read different encodings."""


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="an EVT3 recording")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--mb", type=float, default=100.0, help="size to tile the payload to")
    arguments = parser.parse_args()
    try:
        answer = measure(arguments.file, arguments.rounds, arguments.mb)
    except ElpdError as error:
        if arguments.json:
            print(json.dumps({"error": {"kind": error.kind, "message": str(error)}}))
        print(f"throughput: {error}", file=sys.stderr)
        return error.exit_code
    if arguments.json:
        print(json.dumps(answer))
    else:
        tell(answer)
    return 0


def measure(path: Path, rounds: int, megabytes: float) -> dict[str, Any]:
    """Run every contender *rounds* times, interleaved; return rows, ratios and the reasons for missing ones."""
    geometry, payload = stream.payload(path)
    words = stream.tiled(payload, geometry, round(megabytes * 1e6 / 2))
    n_events = stream.count(words, geometry)
    with tempfile.TemporaryDirectory() as folder:
        tiled = Path(folder) / "tiled.raw"
        write_raw(tiled, geometry, [words], {})
        rows = [*ours(words, n_events, geometry), *peers(words, n_events, tiled, geometry)]
        contenders = [row for row in rows if isinstance(row, Contender)]
        speeds = race(contenders, rounds)
    per_megabyte = {one.name: one.events / one.megabytes / 1e6 for one in contenders}
    absent = {row.name: row.reason for row in rows if isinstance(row, Missing)}
    ratios, spreads, reasons = compare(speeds, per_megabyte, absent)
    return {
        "file": path.name,
        "simd": instructions(),
        "bytes": words.nbytes,
        "events": n_events,
        "rounds": rounds,
        "rows": [of_row(row, path.name, speeds, per_megabyte) for row in rows],
        "ratios": ratios,
        "spreads": spreads,
        "reasons": {**absent, **reasons},
    }


def of_row(
    row: Contender | Missing, file: str, speeds: dict[str, list[float]], per_megabyte: dict[str, float]
) -> dict[str, Any]:
    """Return what is told of a contender: the median over rounds, of CPU time."""
    if isinstance(row, Missing):
        return {"name": row.name, "file": file, "mb_s": None, "mev_s": None, "reason": row.reason}
    mb_s = median(speeds[row.name])
    return {"name": row.name, "file": file, "mb_s": round(mb_s, 1), "mev_s": round(mb_s * per_megabyte[row.name], 2)}


def compare(
    speeds: dict[str, list[float]], per_megabyte: dict[str, float], absent: dict[str, str]
) -> tuple[dict[str, float | None], dict[str, list[float]], dict[str, str]]:
    """Return the median over rounds of each ratio, its range, and a reason for each that has none."""
    decoders = [f"{name} decode" for name in DECODERS if name not in WRONG]
    there = [speeds[name] for name in decoders if name in speeds]
    fastest = "elpd decode simd" if "elpd decode simd" in speeds else "elpd decode scalar"
    known = {**speeds, "elpd decode": speeds[fastest]}
    if there:
        known["best peer"] = [max(values) for values in zip(*there, strict=True)]
    no_peer = "; ".join(f"{name}: {absent[name]}" for name in decoders if name in absent)
    ratios: dict[str, float | None] = {}
    spreads, reasons = {}, {}
    for name, (mine, theirs) in {**RATIOS, **PER_EVENT}.items():
        lacking = [one for one in (mine, theirs) if one not in known]
        if lacking:
            ratios[name] = None
            reasons[name] = "; ".join(absent.get(one, no_peer) for one in lacking)
            continue
        scale = per_megabyte[mine] / per_megabyte["memcpy"] if name in PER_EVENT else 1.0
        middle, least, most = (scale * value for value in ratio(known[mine], known[theirs]))
        ratios[name] = round(middle, 3)
        spreads[name] = [round(least, 3), round(most, 3)]
    return ratios, spreads, reasons


def tell(answer: dict[str, Any]) -> None:
    """Print a table."""
    size = f"tiled to {answer['bytes'] / 1e6:.0f} MB"
    print(f"{answer['file']}, {size}, {answer['rounds']} rounds, CPU time, {answer['simd'] or 'no SIMD'}")
    for row in answer["rows"]:
        if row["mb_s"] is None:
            print(f"{row['name']:<47}  none: {row['reason']}")
        else:
            print(f"{row['name']:<47}{row['mb_s']:>9.0f} MB/s{row['mev_s']:>9.1f} Mev/s")
    for name, value in answer["ratios"].items():
        if value is None:
            print(f"{name:<47}  none: {answer['reasons'][name]}")
        else:
            least, most = answer["spreads"][name]
            print(f"{name:<47}{value:>9.2f}   ({least:.2f} to {most:.2f})")


if __name__ == "__main__":
    sys.exit(main())
