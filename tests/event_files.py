"""Event columns to write and read back, and ways to compare files."""

from __future__ import annotations

import tracemalloc
from contextlib import closing
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from elpd_drivers.inertia import acceleration_m_s2, rotation_rad_s
from hypothesis import strategies as st

from elpd.events.layout import packed
from elpd.events.stream import EventStream, open_recording
from elpd.records import CameraPacket, Encoding, Frame, Geometry, ImuSample, Trigger
from elpd.units import HostNs, SensorUs

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.ports import RecordingWriter

GEOMETRY = Geometry(64, 48)
Columns = list[list[int]]


def event_columns(longest: int = 60, *, largest_step_us: int = 300) -> Any:
    """Strategy: t, x, y, p as lists, in time order but for steps back of some microseconds."""
    steps = st.one_of(st.integers(-11, 40), st.integers(0, largest_step_us))
    one = st.tuples(steps, st.integers(0, GEOMETRY.width - 1), st.integers(0, GEOMETRY.height - 1), st.integers(0, 1))

    def columns(rows: list[tuple[int, int, int, int]]) -> Columns:
        t, x, y, p = ([row[k] for row in rows] for k in range(4))
        times = np.maximum(np.cumsum([1000, *t])[1:], 0).tolist()
        return [times, x, y, p]

    return st.lists(one, max_size=longest).map(columns)


def packet(
    columns: Sequence[Any],
    *,
    triggers: Sequence[Trigger] = (),
    frames: Sequence[Frame] = (),
    imu: Sequence[ImuSample] = (),
) -> CameraPacket:
    """Return columns as a packet."""
    dtypes = (np.int64, np.uint16, np.uint16, np.uint8)
    arrays = [np.asarray(column, dtype) for column, dtype in zip(columns, dtypes, strict=True)]
    return CameraPacket(
        packed(*arrays), Encoding.ARRAY, HostNs(0), triggers=tuple(triggers), frames=tuple(frames), imu=tuple(imu)
    )


def in_pieces(columns: Columns, cuts: Sequence[int]) -> list[Columns]:
    """Cut columns at any places."""
    at = [0, *sorted(cut % (len(columns[0]) + 1) for cut in cuts), len(columns[0])]
    return [[column[a:b] for column in columns] for a, b in pairwise(at)]


def write_all(writer: RecordingWriter, columns: Columns, cuts: Sequence[int] = ()) -> None:
    """Write columns in pieces and finish."""
    for piece in in_pieces(columns, cuts):
        writer.write(packet(piece))
    writer.close()


def read_all(path: Path, max_bytes: int = 1 << 20) -> tuple[Columns, list[Trigger], list[Frame]]:
    """Read a recording through: columns, trigger edges, frames."""
    columns: Columns = [[], [], [], []]
    triggers: list[Trigger] = []
    frames: list[Frame] = []
    with closing(open_recording(path)) as reader:
        for chunk in EventStream(reader).chunks(max_bytes):
            for column, more in zip(columns, chunk[:4], strict=True):
                column += more.tolist()
            triggers += chunk.triggers
            frames += chunk.frames
    return columns, triggers, frames


def read_imu(path: Path) -> list[ImuSample]:
    """Read a recording's inertial samples."""
    with closing(open_recording(path)) as reader:
        return [one for chunk in EventStream(reader).chunks() for one in chunk.imu]


def sample(t_us: int, seed: int = 0) -> ImuSample:
    """Return an inertial sample of which 32-bit floats in the units of AEDAT4 hold every number."""
    g, degrees = np.random.default_rng(seed).integers(-1000, 1000, (2, 3)).tolist()
    return ImuSample(SensorUs(t_us), acceleration_m_s2(tuple(g)), rotation_rad_s(tuple(degrees)), 30.5)


def edge(t_us: int, channel: int = 0, *, rising: bool = True) -> Trigger:
    """Return a trigger edge."""
    return Trigger(SensorUs(t_us), channel, rising)


def many(n: int, seed: int = 1, *, geometry: Geometry = GEOMETRY, step_us: int = 20) -> list[NDArray[Any]]:
    """Return *n* random events in time order, as columns."""
    rng = np.random.default_rng(seed)
    t = 5000 + np.cumsum(rng.integers(0, step_us, n))
    return [t, rng.integers(0, geometry.width, n), rng.integers(0, geometry.height, n), rng.integers(0, 2, n)]


def peak_bytes(work: Callable[[], Any]) -> int:
    """Return the most memory that *work* held at a time, beyond what was held before."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
