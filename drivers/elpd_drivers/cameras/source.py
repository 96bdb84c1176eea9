"""What a camera library looks like inside its capture process, and how its settings are read.

A ``Source`` is the whole of what a backend must be: it is made by a function that takes the camera's table as plain
data, it is read from one thread, and whatever it raises ends the process. Everything else (the process, the ring,
deadlines, opening again) is the same for every camera and stands in ``capture``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from elpd.errors import CameraError, ConfigError
from elpd.records import Encoding, Geometry

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from elpd_drivers.cameras.ring import Captured

WORDS = {Encoding.EVT3: "<u2", Encoding.EVT2: "<u4", Encoding.EVT21: "<u8"}

NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Pixel = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]


@dataclass(frozen=True, slots=True)
class SourceFacts:
    """What is constant about an open camera.

    ``layout`` describes the event array's dtype (``numpy.dtype``'s dictionary of names, formats, offsets, itemsize) and
    is ``None`` for words. ``abilities`` are keys of ``abilities.ABILITIES``. ``min_latency_us`` is the shortest delay
    from an event to ``Captured.received_ns``.
    """

    geometry: Geometry
    encoding: Encoding
    model: str
    serial: str
    min_latency_us: float
    layout: dict[str, Any] | None = None
    abilities: tuple[str, ...] = ()

    def dtype(self) -> np.dtype[Any]:
        """Return how the packets' bytes are to be seen."""
        return np.dtype(WORDS[self.encoding]) if self.layout is None else np.dtype(self.layout)  # type: ignore[call-overload]

    def as_data(self) -> dict[str, Any]:
        """Return this as JSON can hold it."""
        return {**asdict(self), "encoding": self.encoding.value}

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> SourceFacts:
        """Undo ``as_data``."""
        return cls(
            **{
                **data,
                "geometry": Geometry(**data["geometry"]),
                "encoding": Encoding(data["encoding"]),
                "abilities": tuple(data["abilities"]),
            }
        )


def layout_of(dtype: np.dtype[Any]) -> dict[str, Any]:
    """Return a structured dtype as plain data, for ``SourceFacts.layout``."""
    fields: Mapping[str, Any] = dtype.fields or {}
    names = list(dtype.names or ())
    return {
        "names": names,
        "formats": [fields[name][0].str for name in names],
        "offsets": [fields[name][1] for name in names],
        "itemsize": dtype.itemsize,
    }


class Source(Protocol):
    """An open camera, inside its capture process."""

    @property
    def facts(self) -> SourceFacts:
        """What is constant about it."""
        ...

    def read(self, timeout_s: float) -> Captured | None:
        """Wait up to *timeout_s* for a packet. Raises ``CameraError`` when the camera is gone."""
        ...

    def call(self, name: str, arguments: Sequence[Any]) -> Any:
        """Use an ability; ``facts.abilities`` lists which. Raises ``UsageError`` for what the camera cannot do."""
        ...

    def notes(self) -> Mapping[str, float]:
        """Return counters of what was lost or went wrong, since it was opened."""
        ...

    def close(self) -> None:
        """Give the camera back. Idempotent."""
        ...


class CaptureSettings(BaseModel):
    """The keys of ``[camera]`` that every live camera has.

    ``serial`` chooses among several. ``ring_mb`` is the memory in which packets wait for the controller, and
    ``max_delay_ms`` how late a packet may be before everything but the newest is thrown away and counted; 0 is never.
    ``open_timeout_s`` bounds opening, for which an EVK4 takes 4.5 s. A library that gives no sign of life for
    ``hang_ms`` (it should every 5) is ended; a lens at 4 mm/s goes 200 um in the 50 of the default. ``min_latency_us``
    is the shortest time from pixel to host, where it was measured.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    serial: str | None = None
    ring_mb: Annotated[float, Field(ge=1, le=4096)] = 64.0
    max_delay_ms: NonNegative = 250.0
    open_timeout_s: Positive = 20.0
    hang_ms: Annotated[float, Field(ge=20)] = 50.0
    min_latency_us: NonNegative | None = None


S = TypeVar("S", bound=BaseModel)


def read_table(model: type[S], settings: Mapping[str, Any]) -> S:
    """Check the table ``[camera]``. Raises ``ConfigError`` with the first key that is wrong, and what is allowed."""
    try:
        return model.model_validate(dict(settings))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in ("camera", *first["loc"]))
        if first["type"] == "extra_forbidden":
            known = ", ".join(sorted(_fields_at(model, first["loc"][:-1])))
            raise ConfigError(f"{key}: unknown key; known are {known}") from None
        raise ConfigError(f"{key}: {first['msg'].lower()} (got {first['input']!r})") from None


def need(package: str, install: str) -> None:
    """Raise ``CameraError`` with what to install, unless the package can be imported; it is not imported."""
    if find_spec(package) is None:
        raise CameraError(f"camera: the package {package} is not installed; {install}")


def _fields_at(model: type[BaseModel], location: tuple[int | str, ...]) -> Sequence[str]:
    for part in location:
        inner = model.model_fields[str(part)].annotation if str(part) in model.model_fields else None
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            break
        model = inner
    return list(model.model_fields)
