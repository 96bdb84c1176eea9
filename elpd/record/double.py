"""What every double of a taped device is made of: the constants of its rig, and the channel that it asks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from elpd.records import Geometry, LensCapabilities, LensLimits


class Channel(Protocol):
    """What a double asks instead of a device."""

    def ask(self, call: str, /, *arguments: Any) -> Any:
        """Return the answer to *call* (``device.method``), or raise what the device raised."""
        ...

    def ask_array(self, call: str, argument: NDArray[np.float64], /) -> NDArray[np.float64]:
        """As ``ask``, for the one call that takes and returns an array."""
        ...


@dataclass(frozen=True, slots=True)
class RigFacts:
    """What is constant about a rig: its properties and which optional abilities each device has."""

    geometry: Geometry
    limits: LensLimits
    capabilities: LensCapabilities
    um_per_step: float
    steps_to_um: tuple[tuple[float, float], ...]
    opening_ms: float | None
    min_latency_us: float | None
    mark_channel: int | None
    serials: dict[str, str]
    outputs: tuple[str, ...]
    abilities: dict[str, tuple[str, ...]]


class Double:
    """What every double is made of: the constants of its rig, and whom it asks."""

    device: ClassVar[str]

    def __init__(self, facts: RigFacts, channel: Channel) -> None:
        self._facts = facts
        self._ask = channel.ask
        self._ask_array = channel.ask_array
