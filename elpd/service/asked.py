"""What may be asked on the socket: the parameters of each method.

They refuse keys that they do not know: a misspelt ``dry_run`` must not move a lens.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[\w.-]+( [\w.-]+)*$")]
"""A preset's or region's name: words of letters, digits, ``_.-``."""

Finite = Annotated[float, Field(allow_inf_nan=False)]


class Params(BaseModel):
    """What a method takes: nothing, unless a subclass says more."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RoiBox(Params):
    """A rectangle of sensor pixels, as JSON has it; as an answer, cut to the sensor."""

    x: int
    y: int
    width: int
    height: int


class FocusParams(Params):
    """``focus``. A *preset* is where the lens starts from, and its region, unless *roi* is given."""

    roi: RoiBox | None = None
    reference: str | None = None
    preset: Name | None = None
    dry_run: bool = False
    on_disconnect: Literal["finish", "cancel"] = "finish"


class MoveParams(Params):
    """``move``: to a place, or to a fraction of the travel."""

    to_um: Finite | None = None
    fraction: Annotated[float, Field(ge=0, le=1)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> MoveParams:
        if (self.to_um is None) == (self.fraction is None):
            raise ValueError("give to_um or fraction, one of both")
        return self


class JogParams(Params):
    """``jog``."""

    by_um: Finite


class RoiParams(Params):
    """``roi``: nothing given reads; *set* (``null``: proposed from then on) writes the default or the one of *name*."""

    set: RoiBox | None = None
    name: Name | None = None
    delete: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> RoiParams:
        if self.delete and (self.name is None or "set" in self.model_fields_set):
            raise ValueError("delete takes a name and nothing else")
        return self


class PresetParams(Params):
    """``preset``."""

    action: Literal["list", "save", "apply", "delete"]
    name: Name | None = None

    @model_validator(mode="after")
    def _named(self) -> PresetParams:
        if (self.action == "list") != (self.name is None):
            raise ValueError("save, apply and delete take a name, list takes none")
        return self


ModeName = Literal["one-shot", "continuous", "manual", "scheduled"]


class ModeParams(Params):
    """``mode``: nothing given reads. *period_s* is the scheduled mode's."""

    mode: ModeName | None = None
    period_s: Annotated[float, Field(ge=1, le=604_800)] | None = None


class TemperatureParams(Params):
    """``temperature``: what a sensor near the lens reads."""

    celsius: Annotated[float, Field(ge=-80, le=200)]


class LeaseParams(Params):
    """``lease``: *seconds* from now, for acquire and renew."""

    action: Literal["acquire", "renew", "release"]
    seconds: Annotated[float, Field(gt=0, le=3600)] = 30.0


class MapParams(Params):
    """``map``: a picture. ``latest`` is the newest of all kinds."""

    kind: Literal["latest", "map", "frame", "events"] = "latest"
    format: Literal["jpeg", "png", "png16"] = "jpeg"
    max_width: Annotated[int, Field(ge=16, le=8192)] | None = None


EventName = Literal["sample", "phase", "result", "fault", "state", "position"]


class SubscribeParams(Params):
    """``subscribe``. *rate_hz* bounds the samples alone."""

    events: tuple[EventName, ...] = ("sample", "phase", "result", "fault", "state", "position")
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 60.0


class RecordParams(Params):
    """``record``: events from the camera, the lens at rest."""

    seconds: Annotated[float, Field(gt=0, le=3600)]
    name: Name | None = None


class RunsParams(Params):
    """``runs``."""

    limit: Annotated[int, Field(ge=1, le=1000)] = 20


class RunParams(Params):
    """``run``."""

    name: Annotated[str, Field(pattern=r"^[\w-]{1,64}$")]
