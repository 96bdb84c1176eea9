"""The socket's methods, one by one.

Written by ``tools/schema.py``; change ``elpd/service/messages.py`` and run that.
"""

# ruff: noqa: A002, D401, E501  (the names and the words are the messages')
from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from elpd.client.wire import NULL, UNSET, Unset, given

if TYPE_CHECKING:
    from elpd.client.shapes import (
        CancelAnswer,
        ClearAnswer,
        HelloAnswer,
        HomeAnswer,
        LeaseAnswer,
        MapAnswer,
        MetricsAnswer,
        ModeAnswer,
        MoveAnswer,
        PresetAnswer,
        RecordAnswer,
        RoiAnswer,
        RoiBox,
        RunAnswer,
        RunsAnswer,
        Status,
        StopAnswer,
        TemperatureAnswer,
    )


class Methods:
    """What can be asked; each waits for its answer, *timeout_s* at most."""

    def call(self, method: str, params: dict[str, Any] | None = None, timeout_s: float | None = None) -> Any:
        """Ask for any method and return its result."""
        raise NotImplementedError

    def hello(self, *, timeout_s: float | None = None) -> HelloAnswer:
        """``hello``."""
        answer: HelloAnswer = self.call("hello", given(), timeout_s)
        return answer

    def status(self, *, timeout_s: float | None = None) -> Status:
        """Everything at a glance; a snapshot, made whole."""
        answer: Status = self.call("status", given(), timeout_s)
        return answer

    def cancel(self, *, timeout_s: float | None = None) -> CancelAnswer:
        """``cancel``."""
        answer: CancelAnswer = self.call("cancel", given(), timeout_s)
        return answer

    def stop(self, *, timeout_s: float | None = None) -> StopAnswer:
        """``stop``: the bytes have left. *was_moving* is ``None`` where the lens did not know."""
        answer: StopAnswer = self.call("stop", given(), timeout_s)
        return answer

    def home(self, *, timeout_s: float | None = None) -> HomeAnswer:
        """``home``."""
        answer: HomeAnswer = self.call("home", given(), timeout_s)
        return answer

    def move(
        self, to_um: float | None = None, fraction: float | None = None, *, timeout_s: float | None = None
    ) -> MoveAnswer:
        """``move``: to a place, or to a fraction of the travel."""
        answer: MoveAnswer = self.call("move", given(to_um=to_um, fraction=fraction), timeout_s)
        return answer

    def jog(self, by_um: float, *, timeout_s: float | None = None) -> MoveAnswer:
        """``jog``."""
        answer: MoveAnswer = self.call("jog", given(by_um=by_um), timeout_s)
        return answer

    def clear(self, *, timeout_s: float | None = None) -> ClearAnswer:
        """``clear``: the fault that was latched, and the state now."""
        answer: ClearAnswer = self.call("clear", given(), timeout_s)
        return answer

    def roi(
        self,
        set: RoiBox | Unset | None = UNSET,
        name: str | None = None,
        *,
        timeout_s: float | None = None,
        delete: bool = False,
    ) -> RoiAnswer:
        """``roi``: nothing given reads; *set* (``null``: proposed from then on) writes the default or the one of *name*."""
        answer: RoiAnswer = self.call(
            "roi", given(set=NULL if set is None else set, name=name, delete=delete), timeout_s
        )
        return answer

    def preset(
        self,
        action: Literal["list", "save", "apply", "delete"],
        name: str | None = None,
        *,
        timeout_s: float | None = None,
    ) -> PresetAnswer:
        """``preset``."""
        answer: PresetAnswer = self.call("preset", given(action=action, name=name), timeout_s)
        return answer

    def mode(
        self,
        mode: Literal["one-shot", "continuous", "manual", "scheduled"] | None = None,
        period_s: float | None = None,
        *,
        timeout_s: float | None = None,
    ) -> ModeAnswer:
        """``mode``: nothing given reads. *period_s* is the scheduled mode's."""
        answer: ModeAnswer = self.call("mode", given(mode=mode, period_s=period_s), timeout_s)
        return answer

    def temperature(self, celsius: float, *, timeout_s: float | None = None) -> TemperatureAnswer:
        """``temperature``: what a sensor near the lens reads."""
        answer: TemperatureAnswer = self.call("temperature", given(celsius=celsius), timeout_s)
        return answer

    def lease(
        self, action: Literal["acquire", "renew", "release"], seconds: float = 30.0, *, timeout_s: float | None = None
    ) -> LeaseAnswer:
        """``lease``: *seconds* from now, for acquire and renew."""
        answer: LeaseAnswer = self.call("lease", given(action=action, seconds=seconds), timeout_s)
        return answer

    def map(
        self,
        kind: Literal["latest", "map", "frame", "events"] = "latest",
        format: Literal["jpeg", "png", "png16"] = "jpeg",
        max_width: int | None = None,
        *,
        timeout_s: float | None = None,
    ) -> MapAnswer:
        """``map``: a picture. ``latest`` is the newest of all kinds."""
        answer: MapAnswer = self.call("map", given(kind=kind, format=format, max_width=max_width), timeout_s)
        return answer

    def record(self, seconds: float, name: str | None = None, *, timeout_s: float | None = None) -> RecordAnswer:
        """``record``: events from the camera, the lens at rest."""
        answer: RecordAnswer = self.call("record", given(seconds=seconds, name=name), timeout_s)
        return answer

    def runs(self, limit: int = 20, *, timeout_s: float | None = None) -> RunsAnswer:
        """``runs``."""
        answer: RunsAnswer = self.call("runs", given(limit=limit), timeout_s)
        return answer

    def run(self, name: str, *, timeout_s: float | None = None) -> RunAnswer:
        """``run``."""
        answer: RunAnswer = self.call("run", given(name=name), timeout_s)
        return answer

    def metrics(self, *, timeout_s: float | None = None) -> MetricsAnswer:
        """``metrics``: Prometheus' text exposition."""
        answer: MetricsAnswer = self.call("metrics", given(), timeout_s)
        return answer


class AsyncMethods:
    """What can be asked; each awaits its answer, *timeout_s* at most."""

    async def call(self, method: str, params: dict[str, Any] | None = None, timeout_s: float | None = None) -> Any:
        """Ask for any method and return its result."""
        raise NotImplementedError

    async def hello(self, *, timeout_s: float | None = None) -> HelloAnswer:
        """``hello``."""
        answer: HelloAnswer = await self.call("hello", given(), timeout_s)
        return answer

    async def status(self, *, timeout_s: float | None = None) -> Status:
        """Everything at a glance; a snapshot, made whole."""
        answer: Status = await self.call("status", given(), timeout_s)
        return answer

    async def cancel(self, *, timeout_s: float | None = None) -> CancelAnswer:
        """``cancel``."""
        answer: CancelAnswer = await self.call("cancel", given(), timeout_s)
        return answer

    async def stop(self, *, timeout_s: float | None = None) -> StopAnswer:
        """``stop``: the bytes have left. *was_moving* is ``None`` where the lens did not know."""
        answer: StopAnswer = await self.call("stop", given(), timeout_s)
        return answer

    async def home(self, *, timeout_s: float | None = None) -> HomeAnswer:
        """``home``."""
        answer: HomeAnswer = await self.call("home", given(), timeout_s)
        return answer

    async def move(
        self, to_um: float | None = None, fraction: float | None = None, *, timeout_s: float | None = None
    ) -> MoveAnswer:
        """``move``: to a place, or to a fraction of the travel."""
        answer: MoveAnswer = await self.call("move", given(to_um=to_um, fraction=fraction), timeout_s)
        return answer

    async def jog(self, by_um: float, *, timeout_s: float | None = None) -> MoveAnswer:
        """``jog``."""
        answer: MoveAnswer = await self.call("jog", given(by_um=by_um), timeout_s)
        return answer

    async def clear(self, *, timeout_s: float | None = None) -> ClearAnswer:
        """``clear``: the fault that was latched, and the state now."""
        answer: ClearAnswer = await self.call("clear", given(), timeout_s)
        return answer

    async def roi(
        self,
        set: RoiBox | Unset | None = UNSET,
        name: str | None = None,
        *,
        timeout_s: float | None = None,
        delete: bool = False,
    ) -> RoiAnswer:
        """``roi``: nothing given reads; *set* (``null``: proposed from then on) writes the default or the one of *name*."""
        answer: RoiAnswer = await self.call(
            "roi", given(set=NULL if set is None else set, name=name, delete=delete), timeout_s
        )
        return answer

    async def preset(
        self,
        action: Literal["list", "save", "apply", "delete"],
        name: str | None = None,
        *,
        timeout_s: float | None = None,
    ) -> PresetAnswer:
        """``preset``."""
        answer: PresetAnswer = await self.call("preset", given(action=action, name=name), timeout_s)
        return answer

    async def mode(
        self,
        mode: Literal["one-shot", "continuous", "manual", "scheduled"] | None = None,
        period_s: float | None = None,
        *,
        timeout_s: float | None = None,
    ) -> ModeAnswer:
        """``mode``: nothing given reads. *period_s* is the scheduled mode's."""
        answer: ModeAnswer = await self.call("mode", given(mode=mode, period_s=period_s), timeout_s)
        return answer

    async def temperature(self, celsius: float, *, timeout_s: float | None = None) -> TemperatureAnswer:
        """``temperature``: what a sensor near the lens reads."""
        answer: TemperatureAnswer = await self.call("temperature", given(celsius=celsius), timeout_s)
        return answer

    async def lease(
        self, action: Literal["acquire", "renew", "release"], seconds: float = 30.0, *, timeout_s: float | None = None
    ) -> LeaseAnswer:
        """``lease``: *seconds* from now, for acquire and renew."""
        answer: LeaseAnswer = await self.call("lease", given(action=action, seconds=seconds), timeout_s)
        return answer

    async def map(
        self,
        kind: Literal["latest", "map", "frame", "events"] = "latest",
        format: Literal["jpeg", "png", "png16"] = "jpeg",
        max_width: int | None = None,
        *,
        timeout_s: float | None = None,
    ) -> MapAnswer:
        """``map``: a picture. ``latest`` is the newest of all kinds."""
        answer: MapAnswer = await self.call("map", given(kind=kind, format=format, max_width=max_width), timeout_s)
        return answer

    async def record(self, seconds: float, name: str | None = None, *, timeout_s: float | None = None) -> RecordAnswer:
        """``record``: events from the camera, the lens at rest."""
        answer: RecordAnswer = await self.call("record", given(seconds=seconds, name=name), timeout_s)
        return answer

    async def runs(self, limit: int = 20, *, timeout_s: float | None = None) -> RunsAnswer:
        """``runs``."""
        answer: RunsAnswer = await self.call("runs", given(limit=limit), timeout_s)
        return answer

    async def run(self, name: str, *, timeout_s: float | None = None) -> RunAnswer:
        """``run``."""
        answer: RunAnswer = await self.call("run", given(name=name), timeout_s)
        return answer

    async def metrics(self, *, timeout_s: float | None = None) -> MetricsAnswer:
        """``metrics``: Prometheus' text exposition."""
        answer: MetricsAnswer = await self.call("metrics", given(), timeout_s)
        return answer
