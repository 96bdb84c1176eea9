"""Where the lists of a fast EVT3 kernel lie in its scratch memory.

It is one array of ``uint32``, because a kernel pays for each that it cuts. Its first numbers are for who wants
addresses and times of 32 bits (from 0 and from ``TIMES`` on); behind them come lists of 16 bits, whose places count in
those.
"""

from __future__ import annotations

from elpd.events.simd import LANES

BLOCKS = 32
"""Blocks taken at a time."""

EVENTS = 12 * (LANES * BLOCKS + 3) + LANES
"""Room for a list of events: all that so many blocks can hold, and what a vector store touches beyond."""

TIMES = EVENTS

COLUMNS = 4 * EVENTS
ROWS, LOWS = COLUMNS + EVENTS, COLUMNS + 2 * EVENTS
"""Of the events: columns with polarity (see ``lanes.BEYOND``), rows, low parts of their times."""

LANE_WORDS = LANES * (BLOCKS + 2)
X_COLUMNS = COLUMNS + 3 * EVENTS
X_ROWS, X_LOWS = X_COLUMNS + LANE_WORDS, X_COLUMNS + 2 * LANE_WORDS
"""The same of ADDR_X words alone, where both kinds of event must be merged in order."""

LANE_ROWS, LANE_LOWS = X_COLUMNS + 3 * LANE_WORDS, X_COLUMNS + 4 * LANE_WORDS
"""Row and time of each lane."""

PLACES = X_COLUMNS + 5 * LANE_WORDS
"""Lanes whose words need a look."""

LISTS = (PLACES + LANE_WORDS) // 2
"""The size of the array."""

X_MASK, RANK, LEDGER = 0, 1, 2
STOPPED, COPIED, SETTLED, N_RUNS = (BLOCKS * LEDGER + k for k in range(4))
LEDGER_SIZE = BLOCKS * LEDGER + 4
"""A second array, of int64: of each block its ADDR_X words and how many came before; then what kernels tell others."""

RUN_X, RUN_ON, RUN_MASK, RUN_ROW, RUN_LOW, RUN_RANK, RUN = range(7)
RUNS = LEDGER_SIZE
LEDGER_OF_RUNS = RUNS + RUN * LANE_WORDS
"""Behind those, where vectors are kept whole: of each its first column, polarity, mask, row, low part of its time, and
how many ADDR_X words came before it."""
