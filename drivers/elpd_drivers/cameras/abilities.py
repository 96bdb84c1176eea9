"""What only some cameras can do, each a small class that a captured camera is made of beside its own.

Who asks for an ability asks with ``isinstance``, so a camera has the methods of what it can do and no others. Each is a
question to the capture process, answered between two packets.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from elpd.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from elpd.records import BiasSet, Geometry, Roi


class _Asked:
    """What the abilities need of the camera that they belong to."""

    if TYPE_CHECKING:

        @property
        def geometry(self) -> Geometry: ...

        def call(self, name: str, *arguments: Any) -> Any: ...


class _Window(_Asked):
    def set_window(self, window: Roi | None) -> None:
        """Deliver only *window*, or everything again with ``None``. Raises ``UsageError`` if it does not fit."""
        if window is not None and not window.fits(self.geometry):
            raise UsageError(
                f"camera: window {window.x},{window.y},{window.width},{window.height} does not fit the sensor of "
                f"{self.geometry.width}x{self.geometry.height}; choose one inside it"
            )
        self.call("set_window", None if window is None else [window.x, window.y, window.width, window.height])


class _Biases(_Asked):
    def apply_biases(self, biases: BiasSet) -> None:
        """Switch to a set of biases; a few milliseconds of disorder follow."""
        self.call("apply_biases", biases.value)


class _Mask(_Asked):
    def set_mask(self, pixels: Sequence[tuple[int, int]]) -> int:
        """Switch off the first of *pixels*, as many as there are slots; return how many."""
        return int(self.call("set_mask", [[int(x), int(y)] for x, y in pixels]))


class _TriggerInput(_Asked):
    def enable_trigger(self, *, on: bool) -> None:
        """Listen to the trigger input, or do not."""
        self.call("enable_trigger", on)


class _Inertial(_Asked):
    def enable_imu(self, *, on: bool) -> None:
        """Deliver the inertial sensor's samples, or do not."""
        self.call("enable_imu", on)


class _RateLimit(_Asked):
    def limit_rate(self, mev_s: float | None) -> None:
        """Let the sensor send that many million events a second at most, or all with ``None``."""
        self.call("limit_rate", mev_s)


class _Temperature(_Asked):
    def temperature_c(self) -> float:
        """Return the sensor's temperature."""
        return float(self.call("temperature_c"))


ABILITIES: dict[str, type[_Asked]] = {
    "window": _Window,
    "biases": _Biases,
    "mask": _Mask,
    "trigger": _TriggerInput,
    "imu": _Inertial,
    "rate_limit": _RateLimit,
    "temperature": _Temperature,
}
