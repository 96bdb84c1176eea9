"""How long things take: the newest durations of each stage, told as quantiles."""

from __future__ import annotations

import threading
from collections import deque

from elpd.service.messages import Latency

REMEMBERED = 512
"""Durations per stage: a few minutes of use, and the 99th percentile of it."""


class Stages:
    """Durations by stage, bounded. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._durations: dict[str, deque[float]] = {}

    def add(self, stage: str, duration_us: float) -> None:
        """Take one duration."""
        with self._lock:
            self._durations.setdefault(stage, deque(maxlen=REMEMBERED)).append(duration_us)

    def summary(self) -> dict[str, Latency]:
        """Return what is known of each stage."""
        with self._lock:
            kept = {stage: sorted(values) for stage, values in self._durations.items()}
        return {
            stage: Latency(p50_us=_quantile(values, 0.5), p99_us=_quantile(values, 0.99), max_us=values[-1])
            for stage, values in kept.items()
        }


def _quantile(ascending: list[float], share: float) -> float:
    return ascending[min(len(ascending) - 1, int(share * len(ascending)))]
