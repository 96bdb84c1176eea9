"""The newest pictures of each kind, ready to be asked for: the temporal map, a frame, the last events.

The focus thread leaves them here as they are; whoever asks pays for turning them into an image, on another thread.
"""

from __future__ import annotations

import base64
import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

from elpd.errors import UsageError
from elpd.service.messages import MapAnswer
from elpd.vision.pictures import display

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from elpd.events.decoder import EventArrays
    from elpd.record.session import Session
    from elpd.records import Frame, Geometry
    from elpd.service.messages import MapParams

WATCHED_S = 3.0
"""Whoever watches asks for a picture more often than this."""

EVENTS_S = 0.05
"""A picture of events shows the last so many seconds of listening,"""

MOST_EVENTS = 1 << 19
"""and so many of them at the most."""

Kind = Literal["map", "frame", "events"]


@dataclass(frozen=True, slots=True)
class _Shown:
    at_s: float
    position_um: float | None
    pixels: NDArray[Any]
    """(height, width): natural log intensity (float32), or grey of 8 or 16 bit."""
    valid: NDArray[np.bool_] | None = None


class Album:
    """Keeps one picture of each kind. Thread-safe; what it is given it copies.

    Parameters
    ----------
    now_s
        The engine's time.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._shown: dict[Kind, _Shown] = {}
        self._geometry: Geometry | None = None
        self._pieces: deque[tuple[float, NDArray[np.int32], NDArray[np.uint8]]] = deque()
        self._held = 0
        self._events_um: float | None = None
        self._asked_s = float("-inf")

    @property
    def watched(self) -> bool:
        """Whether somebody has asked for a picture lately."""
        return self._now_s() - self._asked_s < WATCHED_S

    def keep_map(self, session: Session | None, position_um: float | None) -> None:
        """Keep a cycle's temporal map, if it made one."""
        if session is None or session.map is None:
            return
        image = session.map
        with self._lock:
            self._shown["map"] = _Shown(self._now_s(), position_um, image.log_intensity, image.valid)

    def keep_frame(self, frame: Frame, position_um: float | None) -> None:
        """Keep the newest frame."""
        shown = _Shown(self._now_s(), position_um, np.array(frame.pixels))
        with self._lock:
            self._shown["frame"] = shown

    def keep_events(self, events: EventArrays, geometry: Geometry, position_um: float | None) -> None:
        """Keep the events of a packet for a while."""
        now_s = self._now_s()
        pixel = events.y.astype(np.int32) * geometry.width + events.x
        with self._lock:
            self._geometry, self._events_um = geometry, position_um
            self._pieces.append((now_s, pixel, np.array(events.p)))
            self._held += pixel.size
            while len(self._pieces) > 1 and (self._held > MOST_EVENTS or now_s - self._pieces[0][0] > EVENTS_S):
                self._held -= self._pieces.popleft()[1].size

    def picture(self, params: MapParams) -> MapAnswer:
        """Return a picture as it was asked for. Raises ``UsageError`` if there is none of that kind."""
        self._asked_s = self._now_s()
        kind, shown = self._choose(params.kind)
        grey = _grey(shown, sixteen=params.format == "png16")
        height, width = grey.shape
        if params.max_width is not None and params.max_width < width:
            size = (params.max_width, max(1, round(height * params.max_width / width)))
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))
        suffix = ".jpg" if params.format == "jpeg" else ".png"
        flags = [cv2.IMWRITE_JPEG_QUALITY, 85] if suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 3]
        _, encoded = cv2.imencode(suffix, grey, flags)
        return MapAnswer(
            kind=kind,
            format=params.format,
            width=grey.shape[1],
            height=grey.shape[0],
            sensor={"width": width, "height": height},
            image=base64.b64encode(encoded.tobytes()).decode("ascii"),
            age_s=self._now_s() - shown.at_s,
            position_um=shown.position_um,
        )

    def _choose(self, asked: str) -> tuple[Kind, _Shown]:
        with self._lock:
            shown = dict(self._shown)
            if self._pieces and self._geometry is not None:
                shown["events"] = self._event_picture(self._geometry)
        if not shown:
            raise UsageError("there is no picture yet; focus once (a dry run will do), or wait for the camera's events")
        if asked == "latest":
            return max(shown.items(), key=lambda item: item[1].at_s)
        for kind, one in shown.items():
            if kind == asked:
                return kind, one
        raise UsageError(f"there is no picture of kind {asked!r} yet; there is: {', '.join(sorted(shown))}")

    def _event_picture(self, geometry: Geometry) -> _Shown:
        """Count ON up and OFF down from the middle grey."""
        size = geometry.width * geometry.height
        net = np.zeros(size, np.int32)
        for _, pixel, on in self._pieces:
            net += np.bincount(pixel, weights=2.0 * on - 1.0, minlength=size).astype(np.int32)
        grey = np.clip(128 + 42 * net, 0, 255).astype(np.uint8).reshape(geometry.height, geometry.width)
        return _Shown(self._pieces[-1][0], self._events_um, grey)


def _grey(shown: _Shown, *, sixteen: bool) -> NDArray[Any]:
    """Return 8 bit for eyes, or 16 bit that keep what the picture has (log intensity over its own range)."""
    pixels = shown.pixels
    if pixels.dtype.kind == "f":
        if not sixteen:
            return display(pixels, shown.valid)
        low, high = float(pixels.min()), float(pixels.max())
        return np.rint((pixels - low) * (65535.0 / max(high - low, 1e-6))).astype(np.uint16)
    if sixteen:
        return pixels.astype(np.uint16) * (257 if pixels.dtype == np.uint8 else 1)
    return np.asarray(pixels if pixels.dtype == np.uint8 else pixels >> 8, np.uint8)
