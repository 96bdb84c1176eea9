"""Whether the light flickers, at what frequency, and whether it leaves anything behind.

A lamp that flickers makes all lit pixels fire ON together and OFF together, so the difference of ON and OFF events
swings with the lamp, while a lens or an edge that moves makes about as many of one kind as of the other. The test is a
periodogram of that difference in bins of a quarter of a millisecond. If the signs of events were independent, its
ordinates, over the number of events, would be exponential with mean one; motion makes them larger, so they are judged
against their own median. With M independent frequencies a line is found by chance with a probability below
``M·exp(-P)``; a line counts where that is below ``FALSE_ALARM`` *and* it carries a good share of all events, because
a lamp that moves few pixels harms nobody.

An object that goes by makes a line as well: its edge lies along the pixels' columns and enters a new one every 1/300 of
a second. But it is over with a pixel when it takes the next, and what it does to a pixel that it comes back to (with
another edge) is up or down as may be, while a lamp does in every period to every pixel what it did before. So the
pixels of the first half of the record are compared with themselves in the second: the mean product of an event's phase
in one and another's in the other, over pairs of the same pixel, is for a lamp what it is for pairs of any pixels, and
zero for edges. Half of that is asked for, by as many standard deviations as ``FALSE_ALARM`` takes.

Stamps that lie on a grid (a camera's coarse clock, a sensor that was simulated picture by picture) are samples, and
show no frequency above half the grid's: beyond it, what the sweep itself does slowly is seen again, as a line of the
grid's own frequency less its own. So the bins are whole steps of the grid, and faster lines are not looked for. Where
only some of the stamps lie on a grid, a line must be more than twice as high as that share of them (the grid's own line
in the count of all events, whatever their sign) of the slow swing that it may be the mirror image of.

What a lamp does to a pixel's level is undone after a whole period, whatever its depth, as long as the pixel can follow.
So sums over whole periods are free of it; ``residue`` says how well that holds for this sensor and this lamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BIN_US = 250
"""Lamps of up to 1 kHz have four bins a period; a faster one is averaged away by the photoreceptors."""

HIGHEST_HZ = 1_000.0
LOWEST_HZ = 45.0
FEWEST_PERIODS = 2.0

FALSE_ALARM = 1e-6
"""How often light that does not flicker may be taken for light that does."""

LEAST_SHARE = 0.3
"""Amplitude of the swing over the rate of events: one where all events are the lamp's, a few hundredths in scenes that
move."""

LEAST_RECURRENCE = 0.5
"""How well pixels agree with themselves a while later, over how well all agree with all: one under a lamp, zero where
things go by."""

RECURRENCE_SIGMAS = 4.8
"""One-sided normal quantile of ``FALSE_ALARM``."""

NEARLY = 0.5
"""Power of a line over that of the highest from which on the lower frequency is believed."""

MIRRORED = 0.5
"""Share of a line that is explained by slower swings, mirrored at a frequency at which events of either sign come."""

STEPS_PER_RESOLUTION = 8


@dataclass(frozen=True, slots=True)
class Flicker:
    """A lamp's frequency, the share of events that swing with it, and the probability to see as much by chance."""

    frequency_hz: float
    share: float
    false_alarm: float

    @property
    def period_us(self) -> float:
        """How long one period lasts."""
        return 1e6 / self.frequency_hz


def find_flicker(
    t_us: NDArray[np.int64], pixel: NDArray[np.int64], on: NDArray[np.uint8], begin_us: int, end_us: int
) -> Flicker | None:
    """Return the lamp that the events of ``[begin_us, end_us)`` show, or ``None`` if there is none.

    Parameters
    ----------
    t_us, pixel, on:
        Times, pixels' numbers and polarities (1 or 0); order does not matter.

    """
    line = find_line(t_us, on, begin_us, end_us)
    if line is None or not _recurs(t_us, pixel, on, 1e-6 * line.frequency_hz, (begin_us + end_us) // 2):
        return None
    return line


def find_line(t_us: NDArray[np.int64], on: NDArray[np.uint8], begin_us: int, end_us: int) -> Flicker | None:
    """Return the strongest line in the difference of ON and OFF events, whatever makes it; else as ``find_flicker``."""
    grid_us = stamp_grid_us(t_us)
    bin_us = -(-BIN_US // grid_us) * grid_us
    bins = (end_us - begin_us) // bin_us
    if bins < 8:
        return None
    span_s = 1e-6 * bin_us * bins
    inside = (t_us >= begin_us) & (t_us < begin_us + bins * bin_us)
    which, sign = (t_us[inside] - begin_us) // bin_us, 2.0 * on[inside] - 1.0
    count = np.bincount(which, minlength=bins).astype(np.float64)
    if count.sum() < 2.0 / LEAST_SHARE**2:
        return None
    mean = float(sign.mean())
    swing = np.bincount(which, weights=sign, minlength=bins) - mean * count
    taper = np.sin(np.pi * (np.arange(bins) + 0.5) / bins) ** 2
    lowest = max(LOWEST_HZ, FEWEST_PERIODS / span_s)
    highest = min(HIGHEST_HZ, 0.5e6 / bin_us)
    if lowest >= highest:
        return None
    independent = max(1.0, (highest - lowest) * span_s)
    finer = STEPS_PER_RESOLUTION * bins
    every = np.fft.rfftfreq(finer, 1e-6 * bin_us).astype(np.float64)
    swings = np.abs(np.fft.rfft(taper * swing, finer))
    within = (every >= lowest) & (every <= highest)
    frequencies, amplitude = every[within], swings[within]
    variance = float(np.square(taper) @ count) * max(1.0 - mean**2, 1e-3)
    power = amplitude**2 / max(variance, 1e-12)
    power /= max(1.0, float(np.median(power)) / np.log(2.0))
    top = _lowest_line(power)
    false_alarm = float(min(1.0, independent * np.exp(-power[top])))
    share = float(2.0 * amplitude[top] / max(float(taper @ count), 1e-12))
    if false_alarm > FALSE_ALARM or share < LEAST_SHARE:
        return None
    here = top + int(np.argmax(within))
    comb = np.abs(np.fft.rfft(taper * count, finer))[here : here + int(np.searchsorted(every, LOWEST_HZ))]
    mirrored = float((comb * swings[: comb.size]).max()) / max(float(taper @ count), 1e-12)
    if mirrored > MIRRORED * float(amplitude[top]):
        return None
    return Flicker(_refined(frequencies, power, top), min(share, 1.0), false_alarm)


def stamp_grid_us(t_us: NDArray[np.int64]) -> int:
    """Return the step of the grid on which most stamps lie, in any order: their usual interval.

    Some may lie between: simulators share out what is too much for one step. Stamps of a fine clock are as far apart as
    events are scarce, and of so few none would show a faster line.
    """
    intervals = np.diff(np.sort(t_us, kind="stable"))
    intervals = intervals[intervals > 0]
    return max(1, int(np.median(intervals))) if intervals.size else 1


def _recurs(
    t_us: NDArray[np.int64],
    pixel: NDArray[np.int64],
    on: NDArray[np.uint8],
    frequency_per_us: float,
    middle_us: int,
) -> bool:
    """Say whether pixels do after *middle_us* what they did before it."""
    turned = (2.0 * on - 1.0) * np.exp(-2j * np.pi * frequency_per_us * (t_us - middle_us))
    before = t_us < middle_us
    size = int(pixel.max()) + 1
    swing, count = [], []
    for half in (before, ~before):
        where, what = pixel[half], turned[half]
        swing.append(np.bincount(where, what.real, size) + 1j * np.bincount(where, what.imag, size))
        count.append(np.bincount(where, minlength=size))
    pairs, all_pairs = float(count[0] @ count[1]), float(count[0].sum()) * float(count[1].sum())
    if pairs == 0.0:
        return False
    by_itself = float((swing[0] * swing[1].conj()).real.sum())
    by_any = float((swing[0].sum() * swing[1].sum().conj()).real)
    chance = float(np.sqrt(0.5 * np.square(np.abs(swing[0] * swing[1])).sum()))
    if by_itself < RECURRENCE_SIGMAS * chance:
        return False
    return by_itself / pairs >= LEAST_RECURRENCE * by_any / all_pairs


def _lowest_line(power: NDArray[np.float64]) -> int:
    """Return the top of the lowest line nearly as high as the highest.

    A lamp has harmonics, and where events are stamped by a coarse clock, mirror images of its line.
    """
    first = int(np.flatnonzero(power >= NEARLY * power.max())[0])
    while first + 1 < power.size and power[first + 1] > power[first]:
        first += 1
    return first


def _refined(frequencies: NDArray[np.float64], power: NDArray[np.float64], top: int) -> float:
    """Return where the parabola through the highest ordinate and its neighbours peaks."""
    if not 0 < top < power.size - 1:
        return float(frequencies[top])
    before, here, after = (float(one) for one in power[top - 1 : top + 2])
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return float(frequencies[top] + shift * (frequencies[1] - frequencies[0]))


def residue(
    t_us: NDArray[np.int64], pixel: NDArray[np.int64], on: NDArray[np.uint8], flicker: Flicker, end_us: int
) -> float:
    """Return what whole periods leave behind: the mean square, in thresholds², of a pixel's level change over them.

    As many whole periods as the events before *end_us* (in time order) hold, over pixels that fired in that time. What
    a pixel's comparator holds back alone makes up to about one.
    """
    if t_us.size == 0:
        return 0.0
    periods = int((end_us - int(t_us[0])) / flicker.period_us)
    within = t_us >= end_us - periods * flicker.period_us
    if periods == 0 or not within.any():
        return 0.0
    fired, index = np.unique(pixel[within], return_inverse=True)
    net = np.bincount(index, weights=2.0 * on[within] - 1.0, minlength=fired.size)
    return float(np.square(net).mean())
