"""Which turn of its clock a word stream is in.

EVT3's time has 24 bits and turns over every 16.78 s; EVT2's has 34 (4.8 h). A decoder counts turns from its first word
on, but a cycle may well begin its decoders when the camera has been running for a minute, and then their times and the
packet's own ``complete_until_us`` would lie whole turns apart. The packet knows better, so it says which turn it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.registers import HIGH, LOOP
from elpd.records import Encoding

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import CameraPacket

EPOCH_STEP_US = 4096
"""A TIME_LOW word has 12 bits: what steps back by more is no late word but another epoch of the clock."""

TIME_HIGH = 0x8
_LAYOUT = {Encoding.EVT3: (12, 12, 12), Encoding.EVT2: (28, 6, 28), Encoding.EVT21: (60, 6, 28)}
"""Where the word's kind begins, how many bits of time lie below a TIME_HIGH, and how many it has."""


def enter_epoch(packet: CameraPacket, state: NDArray[np.int64]) -> None:
    """Set the turn in the registers of a decoder that has not met a TIME_HIGH yet, from what the packet promises.

    Nothing happens without a promise, without a TIME_HIGH in the packet, or once the decoder knows the time.
    """
    if state[HIGH] >= 0 or packet.complete_until_us is None or packet.encoding not in _LAYOUT:
        return
    kind_at, low_bits, high_bits = _LAYOUT[packet.encoding]
    words = packet.data
    found = words[words >> words.dtype.type(kind_at) == TIME_HIGH]
    if found.size == 0:
        return
    high = (found >> found.dtype.type(kind_at - high_bits)).astype(np.int64) & ((1 << high_bits) - 1)
    turn_us = 1 << (low_bits + high_bits)
    turns_within = int((np.diff(high) <= -(1 << (high_bits - 1))).sum())
    turn = round((packet.complete_until_us - (int(high[-1]) << low_bits)) / turn_us)
    state[LOOP] = max(0, turn - turns_within)
