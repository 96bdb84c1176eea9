"""Foreign recordings of a focus sweep, read as one plain thing: events, frames, a region.

The ELP authors keep a sweep in a folder: ``event.npy`` (a structured array, or an integer matrix whose columns are
t, x, y, p), frames named by their time stamp, and ``info.txt`` in free ``key = value`` text. That file also holds the
true focus time. **It is never read here**: a detector that could see the answer proves nothing, so this module picks
the region out of the text and leaves every other line alone.

An event file of any format that is installed (entry points ``elpd.formats``) and an ``.npz`` with t, x, y, p are read
too. Frames are loaded when their time comes, not before.
"""

from __future__ import annotations

import math
import re
import zipfile
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError, UsageError
from elpd.events.epoch import EPOCH_STEP_US
from elpd.events.stream import EventStream, open_recording
from elpd.records import Geometry, Roi
from elpd.vision.reference import load_image

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray


EVENTS_NAME = "event.npy"
INFO_NAME = "info.txt"
FRAME_FOLDERS = ("davis_frames_50", "frames", "davis_frames_20", "davis_frames_1", "davis_frames")
"""Where the authors keep frames, best first."""

_FRAME_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".pgm", ".bmp"}
_REGION = re.compile(r"^[^\n]*\broi\b[^:=\n]*[:=]([^\n]*)$", re.IGNORECASE | re.MULTILINE)
_NUMPY_TYPE = re.compile(r"\b(?:np\.|numpy\.)?u?(?:int|float)\d*\b")
_NUMBER = re.compile(r"-?\d+(?:\.\d*)?(?:e[+-]?\d+)?", re.IGNORECASE)
_STAMP = re.compile(r"\d+(?:\.\d+)?(?:e\+?\d+)?", re.IGNORECASE)
"""A frame's name: microseconds, whole ones or as a program prints them. It is used from the next whole one on."""
_BIN = re.compile(r"^\s*delta_t\s*[:=]\s*(\d+(?:\.\d+)?)", re.IGNORECASE | re.MULTILINE)
_SENSOR_SIZES = ((128, 128), (240, 180), (346, 260), (304, 240), (640, 480), (1280, 720))

_RARELY = 1_000
"""One event in so many at the most steps back far where a clock was set back; more often, events are out of order."""
_MANY = 100
_LEAST_GAP_US = 1e-3
"""No sensor sends a thousand events in a microsecond."""


@dataclass(frozen=True, slots=True)
class FrameFile:
    """A frame that lies on disk: usable from ``t_us`` on."""

    t_us: int
    path: Path

    def load(self) -> NDArray[np.generic]:
        """Read the pixels. Raises ``FormatError``."""
        return load_image(self.path)


@dataclass(frozen=True, slots=True)
class RecordedSweep:
    """A sweep on disk: events in time order, frames, and the region its makers chose.

    ``t_us`` ``int64``, ``x`` and ``y`` ``uint16``, ``on`` ``uint8`` (1 brighter, 0 darker), all of one length.
    ``bin_us`` is the bin that the authors chose for this scene; only their own method uses it. ``frame_age_us`` is how
    long before a frame was there the middle of its exposure lay, where frames are stamped with when they were there.
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    on: NDArray[np.uint8]
    geometry: Geometry
    roi: Roi
    frames: tuple[FrameFile, ...] = ()
    bin_us: int | None = None
    warnings: tuple[str, ...] = field(default=())
    frame_age_us: int = 0


def read_sweep(path: Path, *, frames: str | None = None, size: Geometry | None = None) -> RecordedSweep:
    """Read a sweep from a folder, an ``.npz``, or an event file.

    *frames* names a folder relative to *path*, or is ``"none"``; by default the authors' folders are tried. *size* is
    the sensor's, where the caller knows it and the file may not.
    Raises ``FormatError`` for what is not a sweep, ``UsageError`` for what does not exist.
    """
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    if path.is_dir():
        return _read_folder(path, frames, size)
    columns, geometry, warnings = _read_events(path)
    found = _frames_in(path.parent / frames) if frames not in (None, "none") else ()
    return _assemble(path, columns, geometry or size, _Info(), found, warnings)


def _read_folder(folder: Path, frames: str | None, size: Geometry | None) -> RecordedSweep:
    events = folder / EVENTS_NAME
    if not events.is_file():
        inside = ", ".join(sorted(entry.name for entry in folder.iterdir())[:6]) or "nothing"
        raise FormatError(f"{folder}: no {EVENTS_NAME} in this folder (it holds {inside}); give a sweep's folder")
    usual = next((name for name in FRAME_FOLDERS if (folder / name).is_dir()), None)
    chosen = usual if frames is None else frames
    found = () if chosen in (None, "none") else _frames_in(folder / chosen)
    columns, geometry, warnings = _read_events(events)
    # The size of a frame is a fact of the camera; it may be known where the frames themselves are not to be used.
    geometry = geometry or size or _frame_size(found or (_frames_in(folder / usual) if usual else ()))
    return _assemble(folder, columns, geometry, _read_info(folder / INFO_NAME), found, warnings)


def _frame_size(frames: Sequence[FrameFile]) -> Geometry | None:
    if not frames:
        return None
    height, width = frames[0].load().shape[:2]
    return Geometry(width, height)


@dataclass(frozen=True, slots=True)
class _Info:
    """What is taken from ``info.txt``, and nothing else of it: (y1, y2, x1, x2), and the authors' bin."""

    region: tuple[int, int, int, int] | None = None
    bin_us: int | None = None
    warnings: tuple[str, ...] = ()


def _read_info(info: Path) -> _Info:
    try:
        text = info.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return _Info()
    found = _BIN.search(text)
    bin_us = round(float(found.group(1))) if found else None
    line = _REGION.search(text)
    if line is None:
        return _Info(None, bin_us)
    numbers = [round(float(part)) for part in _NUMBER.findall(_NUMPY_TYPE.sub("", line.group(1)))]
    if len(numbers) != 4:
        what = f"the region {line.group(1).strip()!r} of {INFO_NAME} is not four numbers (y1, y2, x1, x2)"
        return _Info(None, bin_us, (f"{what}; the sensor is used whole",))
    y1, y2, x1, x2 = numbers
    return _Info((y1, y2, x1, x2), bin_us)


def _frames_in(folder: Path) -> tuple[FrameFile, ...]:
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder of frames; give --frames DIR relative to the sweep, or none")
    found = [
        FrameFile(math.ceil(float(entry.stem)), entry)
        for entry in folder.iterdir()
        if entry.suffix.lower() in _FRAME_SUFFIXES and _STAMP.fullmatch(entry.stem)
    ]
    if not found:
        raise FormatError(f"{folder}: no frames named <microseconds>.jpg or .png; give --frames none to do without")
    return tuple(sorted(found, key=lambda frame: frame.t_us))


def _read_events(path: Path) -> tuple[dict[str, NDArray[Any]], Geometry | None, list[str]]:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _columns_of_npz(path), None, []
    if suffix == ".npy":
        return _columns_of_npy(path), None, []
    return _columns_of_recording(path)


def _columns_of_npy(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with path.open("rb") as file:
            array = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(f"{path}: not a numpy file of events ({error})") from None
    return _columns_of_array(array, path)


def _columns_of_npz(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path}: not an .npz archive of events ({error})") from None
    missing = [name for name in ("t", "x", "y", "p") if name not in found]
    if missing:
        raise FormatError(f"{path}: arrays {', '.join(missing)} are missing; t (us), x, y and p are needed")
    return {name: found[name] for name in ("t", "x", "y", "p")}


def _columns_of_array(array: NDArray[Any], path: Path) -> dict[str, NDArray[Any]]:
    names = array.dtype.names
    if names is not None:
        columns = {}
        for wanted, spellings in (
            ("t", ("t", "timestamp", "ts")),
            ("x", ("x",)),
            ("y", ("y",)),
            ("p", ("p", "on", "polarity")),
        ):
            spelling = next((one for one in spellings if one in names), None)
            if spelling is None:
                raise FormatError(f"{path}: fields {', '.join(names)}; t (us), x, y and p are needed")
            columns[wanted] = array[spelling]
        return columns
    if array.ndim != 2 or array.shape[1] != 4 or not np.issubdtype(array.dtype, np.number):
        raise FormatError(
            f"{path}: {array.dtype} of shape {array.shape}; events are a structured array with t, x, y, p, "
            "or a matrix of four columns"
        )
    return {"t": array[:, 0], "x": array[:, 1], "y": array[:, 2], "p": array[:, 3]}


def _columns_of_recording(path: Path) -> tuple[dict[str, NDArray[Any]], Geometry | None, list[str]]:
    reader = open_recording(path)
    try:
        pieces = [
            (chunk.t.copy(), chunk.x.copy(), chunk.y.copy(), chunk.p.copy()) for chunk in EventStream(reader).chunks()
        ]
        geometry = reader.geometry
        warnings = [str(one) for one in reader.notes.get("warnings", ())]
    finally:
        reader.close()
    columns = zip(("t", "x", "y", "p"), zip(*pieces, strict=True), strict=True) if pieces else ()
    return {name: np.concatenate(column) for name, column in columns}, geometry, warnings


def _assemble(
    path: Path,
    columns: dict[str, NDArray[Any]],
    geometry: Geometry | None,
    info: _Info,
    frames: Sequence[FrameFile],
    warnings: Sequence[str],
) -> RecordedSweep:
    notes = [*warnings, *info.warnings]
    region = info.region
    sizes = {name: column.size for name, column in columns.items()}
    if not columns or not all(sizes.values()):
        raise FormatError(f"{path}: no events in it; nothing can be focused from an empty recording")
    if len(set(sizes.values())) != 1 or any(column.ndim != 1 for column in columns.values()):
        raise FormatError(f"{path}: t, x, y and p differ in length ({sizes}); they must describe the same events")
    if not all(np.isfinite(column).all() for column in columns.values() if np.issubdtype(column.dtype, np.floating)):
        raise FormatError(f"{path}: values that are not finite numbers among the events")
    _refuse_seconds(path, columns["t"])
    t_us = columns["t"].astype(np.int64)
    x = columns["x"].astype(np.int64)
    y = columns["y"].astype(np.int64)
    on = (columns["p"] > 0).astype(np.uint8)
    if geometry is None:
        geometry = _frame_size(frames) or _size_of(x, y, region)
    outside = (x < 0) | (y < 0) | (x >= geometry.width) | (y >= geometry.height)
    if outside.any():
        raise FormatError(
            f"{path}: {int(outside.sum())} of {x.size} events lie outside "
            f"the sensor's {geometry.width}x{geometry.height} pixels"
        )
    if (np.diff(t_us) < 0).any():
        _refuse_other_epochs(path, t_us)
        order = np.argsort(t_us, kind="stable")
        notes.append(f"{int((np.diff(t_us) < 0).sum())} time stamps stepped back; the events were sorted")
        t_us, x, y, on = t_us[order], x[order], y[order], on[order]
    # One frame from just before the sweep is as good as any; further off than the sweep is long, clocks differ.
    begin_us, end_us = int(t_us[0]), int(t_us[-1])
    if frames and not any(2 * begin_us - end_us <= frame.t_us <= end_us for frame in frames):
        notes.append(
            f"none of the {len(frames)} frames ({frames[0].t_us} .. {frames[-1].t_us} us) was taken while events came "
            f"({begin_us} .. {end_us} us); are both in microseconds of one clock?"
        )
    roi = Roi(0, 0, geometry.width, geometry.height)
    if region is not None:
        y1, y2, x1, x2 = region
        chosen = Roi(x1, y1, x2 - x1, y2 - y1)
        if chosen.fits(geometry):
            roi = chosen
        else:
            notes.append(
                f"the region (y1, y2, x1, x2) = {region} of {INFO_NAME} does not fit the sensor, which is used whole"
            )
    return RecordedSweep(
        t_us, x.astype(np.uint16), y.astype(np.uint16), on, geometry, roi, tuple(frames), info.bin_us, tuple(notes)
    )


def _refuse_seconds(path: Path, t: NDArray[Any]) -> None:
    """Refuse stamps that fall within a few microseconds of one another and have fractions: those are seconds."""
    if not np.issubdtype(t.dtype, np.floating):
        return
    span = float(np.ptp(t))
    if t.size > _MANY and span < t.size * _LEAST_GAP_US and (t != np.rint(t)).any():
        raise FormatError(
            f"{path}: {t.size} events within {span:.6g} us, in fractions; these are probably seconds: multiply by 1e6"
        )


def _refuse_other_epochs(path: Path, t_us: NDArray[np.int64]) -> None:
    """Refuse a record whose clock was set back: sorted, events of one time would lie among those of another.

    Late packets step back by little, and of a file that is out of order every other event steps back. A clock that is
    set back does so once in a long while, and far.
    """
    back = np.flatnonzero(np.diff(t_us) < -EPOCH_STEP_US)
    if back.size == 0 or back.size * _RARELY > t_us.size:
        return
    first = int(back[0])
    raise FormatError(
        f"{path}: the clock was set back {back.size} times by more than {EPOCH_STEP_US} us, first by "
        f"{int(t_us[first] - t_us[first + 1])} us after {first + 1} of {t_us.size} events (at {int(t_us[first])} us); "
        "what came before and after belongs to two recordings: keep the events of one of them"
    )


def _size_of(x: NDArray[np.int64], y: NDArray[np.int64], region: tuple[int, int, int, int] | None) -> Geometry:
    """Return the smallest known sensor that holds the events and the region.

    Not simply the events' extent: it would depend on how long the recording is, and so would the answer.
    """
    right = max(int(x.max()) + 1, region[3] if region else 0)
    bottom = max(int(y.max()) + 1, region[1] if region else 0)
    for width, height in _SENSOR_SIZES:
        if right <= width and bottom <= height:
            return Geometry(width, height)
    return Geometry(right, bottom)
