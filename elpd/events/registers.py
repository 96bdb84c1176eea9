"""The registers of a word decoder: one int64 array that the caller owns.

Prophesee's encodings are programs for a small machine with registers for time, row, vector base and polarity: most
words set a register, few are events. Keeping the machine's registers and its tally of oddities in one flat array lets
a stream be cut between any two words, lets decoding kernels and fused kernels share helpers, and costs a single
argument. EVT2 and EVT2.1 use the time registers and the tallies alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import UsageError
from elpd.events.jit import kernel
from elpd.records import Trigger
from elpd.units import SensorUs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.records import Geometry

Integer = int | np.integer[Any]
"""What integers are inside a kernel, as far as a type checker can tell."""

LOOP, HIGH, LOW, ROW, VECTOR_X, VECTOR_ON = 0, 1, 2, 3, 4, 5
OTHERS_SUBTYPE, CONTINUED_SEEN, CONTINUED_VALUE = 6, 7, 8
TRIGGERS_HELD = 9
EVENTS, BEFORE_TIME, Y_OUT_OF_RANGE, X_OUT_OF_RANGE = 10, 11, 12, 13
PADDING, RESERVED, STRAY_CONTINUED, OTHERS = 14, 15, 16, 17
RATE_BEFORE, RATE_AFTER, RATE_COUNTS = 18, 19, 20
TRIGGERS, TRIGGERS_LOST = 21, 22
STATE_SIZE = 24

COUNTERS = {
    "before_time": BEFORE_TIME,
    "y_out_of_range": Y_OUT_OF_RANGE,
    "x_out_of_range": X_OUT_OF_RANGE,
    "padding": PADDING,
    "reserved": RESERVED,
    "stray_continued": STRAY_CONTINUED,
    "others": OTHERS,
    "triggers_lost": TRIGGERS_LOST,
}

NO_ROW = 4096  # no 12-bit row word says this
NO_VECTOR = 2048  # outside every sensor, until a VECT_BASE_X came
NO_SUBTYPE = -1
COUNT_BEFORE_CONTROLLER, COUNT_AFTER_CONTROLLER = 0x014, 0x016
MAX_SIDE = 2048  # addresses have 11 bits
TRIGGER_CAPACITY = 4096


def new_state() -> NDArray[np.int64]:
    """Return the registers as they are before the first word."""
    state = np.zeros(STATE_SIZE, np.int64)
    state[HIGH] = -1
    state[OTHERS_SUBTYPE] = NO_SUBTYPE
    forget_addresses(state)
    return state


def forget_addresses(state: NDArray[np.int64]) -> None:
    """Forget row and vector base, as after a loss: events until the next ADDR_Y belong to no known row."""
    state[ROW] = NO_ROW
    state[VECTOR_X] = NO_VECTOR


def new_triggers() -> NDArray[np.int64]:
    """Return room for the trigger edges of one piece of stream: rows of t, id, rising."""
    return np.zeros((TRIGGER_CAPACITY, 3), np.int64)


def take_triggers(state: NDArray[np.int64], triggers: NDArray[np.int64]) -> tuple[Trigger, ...]:
    """Return the trigger edges held since the last call, oldest first, and forget them."""
    held = int(state[TRIGGERS_HELD])
    if held == 0:
        return ()
    state[TRIGGERS_HELD] = 0
    return tuple(Trigger(SensorUs(t), channel, bool(rising)) for t, channel, rising in triggers[:held].tolist())


@kernel()
def hold_trigger(
    t: Integer, channel: Integer, rising: Integer, state: NDArray[np.int64], triggers: NDArray[np.int64]
) -> None:
    """Keep a trigger edge until ``take_triggers``, or count it as lost."""
    state[TRIGGERS] += 1
    held = state[TRIGGERS_HELD]
    if held < triggers.shape[0]:
        triggers[held, 0] = t
        triggers[held, 1] = channel
        triggers[held, 2] = rising
        state[TRIGGERS_HELD] = held + 1
    else:
        state[TRIGGERS_LOST] += 1


def time_of(state: NDArray[np.int64], low_bits: int, high_bits: int) -> SensorUs:
    """Return the time that the registers stand at, for an encoding with so many bits below and in TIME_HIGH."""
    return SensorUs((((int(state[LOOP]) << high_bits) + int(state[HIGH])) << low_bits) + int(state[LOW]))


def counters(state: NDArray[np.int64]) -> dict[str, int]:
    """Return how often each odd thing was met, by the names of ``COUNTERS``."""
    return {name: int(state[index]) for name, index in COUNTERS.items()}


def rate_controller(state: NDArray[np.int64]) -> tuple[int, int] | None:
    """Return events before and after the camera's rate controller; ``None`` if the stream never said."""
    if state[RATE_COUNTS] == 0:
        return None
    return int(state[RATE_BEFORE]), int(state[RATE_AFTER])


def check_geometry(geometry: Geometry) -> None:
    """Raise ``UsageError`` for a sensor whose addresses do not fit 11 bits."""
    if not (0 < geometry.width <= MAX_SIDE and 0 < geometry.height <= MAX_SIDE):
        raise UsageError(
            f"a sensor of {geometry.width}x{geometry.height} pixels does not fit 11-bit addresses (1 to {MAX_SIDE}); "
            "check the geometry in the file's header or the camera's settings"
        )
