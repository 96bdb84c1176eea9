"""Does memory stay flat: ``tools/flatness.py FILE [--events 1e9]``. Prints; asserts nothing.

A recording's words go round and round, time going on from round to round, through everything that a focus cycle keeps
for each stream: ELP windows with and without the rate cap, a decoder, the first-event map, the detector. Memory in use
(resident, from the kernel) and the largest ever are printed at even intervals of events.
"""

from __future__ import annotations

import argparse
import os
import resource
from pathlib import Path

import numpy as np
from speed import stream

from elpd.events.evt3_fast import evt3_decoder
from elpd.records import CameraPacket, ElpSample, Encoding
from elpd.units import HostNs
from elpd.vision.detector import Detector
from elpd.vision.elp import ElpWindows
from elpd.vision.first_events import FirstEventMap

LINES = 20
TIME_HIGH = 0x8


def main() -> int:
    """Feed and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="an EVT3 recording")
    parser.add_argument("--events", type=float, default=1e9)
    arguments = parser.parse_args()
    geometry, words = stream.payload(arguments.file)
    high = np.flatnonzero(words >> 12 == TIME_HIGH)
    highs = (words[high] & 0xFFF).astype(np.int64)
    decoder = evt3_decoder(geometry)
    per_round = decoder.feed(words).t.size
    span = ((decoder.time_us or 0) >> 12) - int(highs[0]) + 1
    weights = np.random.default_rng(1).integers(-1020, 1021, (geometry.height, geometry.width))
    meters = [ElpWindows(weights, window_us=stream.WINDOW_US, rate_cap=capped) for capped in (False, True)]
    first, detector = FirstEventMap(geometry), Detector()
    rounds = -(-int(arguments.events) // per_round)
    windows = 0
    print(f"{'events':>14}{'windows':>12}{'resident MB':>14}{'largest MB':>14}")
    for turn in range(rounds):
        words[high] = 0x8000 | ((highs + turn * span) & 0xFFF).astype(np.uint16)
        for piece in stream.pieces(words):
            packet = CameraPacket(piece, Encoding.EVT3, HostNs(0))
            decoder.feed(piece)
            first.add_packet(packet)
            meters[1].feed(packet)
            for row in meters[0].feed(packet).tolist():
                detector.feed(ElpSample(*row))
                windows += 1
        if (turn + 1) * LINES // rounds > turn * LINES // rounds:
            most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{(turn + 1) * per_round:>14}{windows:>12}{resident_mb():>14.1f}{most:>14.1f}", flush=True)
    return 0


def resident_mb() -> float:
    """Return how much memory this process has in use."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    raise SystemExit(main())
