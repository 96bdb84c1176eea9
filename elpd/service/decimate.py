"""Samples for eyes: so many a second, and always the last one before the lens turns or a phase ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from elpd.service.messages import SampleEvent


class Decimator:
    """Let *rate_hz* samples a second of the sensor's time through.

    A curve whose last point before a reversal is missing shows the wrong turning point, so a sample that was held back
    goes out late when the direction changes, and when whoever owns this asks for it (``held``).
    """

    def __init__(self, rate_hz: float) -> None:
        self._spacing_us = 1e6 / rate_hz
        self._sent_us: int | None = None
        self._held: SampleEvent | None = None
        self._position_um: float | None = None
        self._upward: bool | None = None

    def take(self, sample: SampleEvent) -> list[SampleEvent]:
        """Return what to send now that *sample* has come."""
        out = self.held() if self._turned(sample) else []
        if (
            self._sent_us is None or not 0 <= sample.t_us - self._sent_us < self._spacing_us
        ):  # the first, or a new epoch
            self._held, self._sent_us = None, sample.t_us
            out.append(sample)
        else:
            self._held = sample
        return out

    def held(self) -> list[SampleEvent]:
        """Return the sample that was held back last, once."""
        held, self._held = self._held, None
        return [] if held is None else [held]

    def _turned(self, sample: SampleEvent) -> bool:
        before, self._position_um = self._position_um, sample.position_um
        if before is None or sample.position_um is None or sample.position_um == before:
            return False
        upward = sample.position_um > before
        turned = self._upward is not None and upward is not self._upward
        self._upward = upward
        return turned
