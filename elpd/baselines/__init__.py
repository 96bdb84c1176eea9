"""The peers: what others do with the same recorded sweep, implemented as strongly as their sources allow.

Each peer is a function from a ``FocusStack`` to an ``Estimate`` and knows nothing of the others. ``PEERS`` names them
all for the benchmark, with the one thing that a reader of its tables must know about each: what it was allowed to see.
"""

from __future__ import annotations

from dataclasses import dataclass

from elpd.baselines import balance, contrast, egs, elp_published, esva, event_rate, pbf, registered, search
from elpd.baselines.stack import Estimate, FocusStack, LensPath, Peer, StackFrame

__all__ = ["PEERS", "Entry", "Estimate", "FocusStack", "LensPath", "Peer", "StackFrame"]


@dataclass(frozen=True, slots=True)
class Entry:
    """A peer, what it is called in tables, what it sees, and whether it needs frames."""

    title: str
    run: Peer
    sees: str
    needs_frames: bool = False


_WHOLE = "whole stack"
_HINDSIGHT = "hindsight, tuned offset"
_FREE = "whole stack of frames"
_MOVES = "frames at rest, many moves"

PEERS: dict[str, Entry] = {
    "egs": Entry("EGS", egs.estimate, _WHOLE),
    "event-rate": Entry("event-rate maximum", event_rate.estimate, _WHOLE),
    "pbf": Entry("PBF (reconstructed)", pbf.estimate, _WHOLE),
    "balance": Entry("ON/OFF balance", balance.estimate, _WHOLE),
    "esva": Entry("ESVA", esva.estimate, _WHOLE),
    "tenengrad": Entry("Tenengrad, all frames", contrast.estimate_tenengrad, _FREE, needs_frames=True),
    "laplacian-variance": Entry(
        "Laplacian variance, all frames", contrast.estimate_laplacian_variance, _FREE, needs_frames=True
    ),
    "hill-climb": Entry("hill climbing", search.estimate_hill_climb, _MOVES, needs_frames=True),
    "fibonacci": Entry("Fibonacci search", search.estimate_fibonacci, _MOVES, needs_frames=True),
    "registered": Entry("registered regression", registered.estimate, "the past only", needs_frames=True),
    "elp-syn": Entry(
        "ELP as published (SYN)", elp_published.published(elp_published.SYN), _HINDSIGHT, needs_frames=True
    ),
    "elp-syn-1fps": Entry(
        "ELP as published (SYN, 1 fps)",
        elp_published.published(elp_published.SYN_1FPS),
        f"{_HINDSIGHT}, a future frame",
        needs_frames=True,
    ),
    "elp-davis": Entry(
        "ELP as published (DAVIS)", elp_published.published(elp_published.DAVIS), _HINDSIGHT, needs_frames=True
    ),
    "elp-evk4": Entry(
        "ELP as published (EVK4)", elp_published.published(elp_published.EVK4), _HINDSIGHT, needs_frames=True
    ),
    "elp-no-filter": Entry(
        "ELP without filter (SYN)",
        elp_published.published(elp_published.SYN_NO_FILTER),
        _HINDSIGHT,
        needs_frames=True,
    ),
    "elp-no-laplacian": Entry(
        "ELP without Laplacian (SYN)",
        elp_published.published(elp_published.SYN_NO_LAPLACIAN),
        _HINDSIGHT,
    ),
}
"""Every peer by the name that ``tools/benchmark.py --methods`` takes."""
