"""For what is found out again by every part of a program that looks: it is logged only once."""

from __future__ import annotations


class Once:
    """Knows what was told."""

    def __init__(self) -> None:
        self._told: set[tuple[str, ...]] = set()

    def new(self, *words: str) -> bool:
        """Say whether that was not told yet; from now on it was."""
        new = words not in self._told
        self._told.add(words)
        return new
