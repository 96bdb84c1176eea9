"""Words of EVT3 that come in phrases, for kernels that take whole phrases at once: counts, triples, other OTHERS.

The registers must say afterwards what they would if the words had been taken one by one as the scalar decoder takes
them, because a continuation that comes alone belongs to whatever came last.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.events.evt3 import forget_other
from elpd.events.jit import kernel
from elpd.events.lanes import RATE, RATE_KINDS, four_words
from elpd.events.registers import CONTINUED_SEEN, CONTINUED_VALUE, OTHERS_SUBTYPE

if TYPE_CHECKING:
    from numpy.typing import NDArray

TRIPLE = np.uint64(0x5000_4000_4000_3000)
TRIPLE_KINDS = np.uint64(0xF000_F000_F000_F000)


@kernel()
def is_whole(words: NDArray[np.uint16], place: Any) -> tuple[bool, bool]:
    """Say whether a whole rate count begins at a place, and whether a whole vector triple does."""
    four = four_words(words, place)
    return four & np.uint64(RATE_KINDS) == np.uint64(RATE), four & TRIPLE_KINDS == TRIPLE


@kernel()
def begin_other(word: Any, state: NDArray[np.int64]) -> None:
    """Remember an OTHERS word that begins no rate count."""
    state[OTHERS_SUBTYPE] = np.int64(word) & 0xFFF
    state[CONTINUED_SEEN] = 0
    state[CONTINUED_VALUE] = 0


@kernel()
def settle_others(words: NDArray[np.uint16], position: int, settled: Any, lane: Any, state: NDArray[np.int64]) -> None:
    """Let the OTHERS words from lane *settled* up to *lane* say what a continuation there would belong to."""
    while settled < lane:
        word = words[position + settled]
        if word & 0xFFFD == 0xE014:
            whole, _ = is_whole(words, position + settled)
            if whole:
                forget_other(state)
        elif word >> 12 == 0xE:
            begin_other(word, state)
        settled += 1


@kernel()
def settle_last(
    words: NDArray[np.uint16], position: int, settled: Any, last_count: Any, last_other: Any, state: NDArray[np.int64]
) -> None:
    """Do what ``settle_others`` would for all lanes from *settled* on, knowing the last of each kind."""
    if last_other >= settled:
        begin_other(words[position + last_other], state)
    if last_count >= settled and last_count > last_other:
        forget_other(state)


@kernel()
def join_triple(four: Any) -> Any:
    """Return the 32 columns of a whole vector triple as a mask."""
    return np.uint32(
        ((four >> np.uint64(16)) & np.uint64(0xFFF))
        | ((four >> np.uint64(20)) & np.uint64(0xFFF000))
        | ((four >> np.uint64(24)) & np.uint64(0xFF000000))
    )
