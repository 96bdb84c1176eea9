"""The published method over a recorded sweep: the released code's outer loop.

Which of the authors' constants apply follows from what the recording has: many frames (their synthetic set at 20 and
50 fps), one frame (their "1 fps", whose single frame is used from 100 ms on even where it was taken later, so it may
lie in the future), or none and a picture from the aperture (their EVK4 set).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.errors import UsageError
from elpd.record.sweep_file import Detection
from elpd.records import Direction, Outcome
from elpd.vision.paper import (
    EVK4,
    SYNTHETIC_MANY_FRAMES,
    SYNTHETIC_ONE_FRAME,
    Constants,
    PaperDetector,
    elp_of_bin,
    paper_laplacian,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from elpd.record.layouts import RecordedSweep
    from elpd.records import Roi


def detect_as_published(
    sweep: RecordedSweep, roi: Roi, picture: NDArray[np.generic] | None, begin_us: int | None
) -> Detection:
    """Run the published method. *picture* is used when there are no frames. Raises ``UsageError`` without either."""
    first_us = int(sweep.t_us[0]) if begin_us is None else begin_us
    end_us = int(sweep.t_us[-1])
    if len(sweep.frames) > 1:
        constants = SYNTHETIC_MANY_FRAMES
        starts = [frame.t_us for frame in sweep.frames if frame.t_us >= first_us or begin_us is None]
        tables = [(frame.t_us, frame.load) for frame in sweep.frames if frame.t_us in set(starts)]
    elif sweep.frames:
        constants = SYNTHETIC_ONE_FRAME
        tables = [(first_us // 1000 * 1000 + constants.skip_us, sweep.frames[0].load)]
    elif picture is not None:
        constants = EVK4
        tables = [(first_us, lambda: picture)]
    else:
        raise UsageError("the paper's method needs a picture; give --frames, --reference or --aperture-us")
    detector = PaperDetector(constants, sweep.bin_us)
    for number, (start_us, load) in enumerate(tables):
        stop_us = tables[number + 1][0] if number + 1 < len(tables) else end_us
        _interval(detector, sweep, roi, paper_laplacian(load(), roi), start_us, stop_us, constants)
        if detector.found and constants is not EVK4:
            break
    return _detection(detector, constants, sweep)


def _interval(
    detector: PaperDetector,
    sweep: RecordedSweep,
    roi: Roi,
    table: NDArray[np.float32],
    start_us: int,
    stop_us: int,
    constants: Constants,
) -> None:
    begin_us = start_us
    while begin_us < stop_us:
        last_us = min(begin_us + detector.bin_us, stop_us)
        part = slice(
            int(np.searchsorted(sweep.t_us, begin_us, side="left")),
            int(np.searchsorted(sweep.t_us, last_us, side="right")),
        )
        value = elp_of_bin(sweep.x[part], sweep.y[part], sweep.on[part], table, constants, roi)
        if value is not None:
            detector.feed(begin_us, value)
            if detector.found and constants is SYNTHETIC_ONE_FRAME:
                return
        begin_us += detector.bin_us


def _detection(detector: PaperDetector, constants: Constants, sweep: RecordedSweep) -> Detection:
    said = detector.result()
    direction = {1.0: Direction.APPROACHING, -1.0: Direction.RECEDING}.get(said.first_sign, Direction.UNKNOWN)
    how = (
        f"the published rule with its constants for {constants.name}; its answer may be overwritten until "
        f"{constants.overwrites_until} and is moved {constants.back_bins} bins and {constants.back_us} us back"
    )
    if constants is SYNTHETIC_ONE_FRAME and sweep.frames[0].t_us > constants.skip_us:
        how += f"; its one frame was taken at {sweep.frames[0].t_us} us and is used before that time"
    outcome = Outcome.NO_CROSSING if said.focus_us is None else Outcome.FOCUSED
    reason = how if said.focus_us is not None else f"not triggered: {how}"
    return Detection(
        outcome,
        reason,
        direction,
        said.first_us if direction is not Direction.UNKNOWN else None,
        said.crossing_us,
        said.focus_us,
        None,
        said.decided_us,
        "crossing",
        int(sweep.t_us.size),
        said.bins,
    )
