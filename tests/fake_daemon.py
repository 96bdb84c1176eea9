"""A daemon on a unix socket that has no rig: it speaks the contract, and does what a test tells it.

Every request is checked against ``elpd.service.messages``, as the real one checks it, and every answer and event is
made from its models, so that the page is never tried on messages that do not exist. A cycle goes on only when the test
says so; nothing here waits for a clock.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import math
import os
import socket
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np
from pydantic import ValidationError

from elpd.service import messages

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from pathlib import Path

WIDTH, HEIGHT = 1280, 720
FOCUS_UM = 1560.9
PHASES = ("settle_before", "expose", "choose", "probe", "sweep", "stop", "return", "verify")


class FakeDaemon:
    """The daemon's side of the socket. ``asked`` holds every request; answers may be replaced in ``answers``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.answers: dict[str, Callable[[dict[str, Any]], Any]] = {}
        self.role = "operate"
        self.state = "READY"
        self.mode = "one-shot"
        self.moving = False
        self.position_um = 1358.75
        self.fault: dict[str, Any] | None = None
        self.warnings: list[dict[str, str]] = []
        self.roi: dict[str, int] | None = None
        self.named: dict[str, dict[str, int]] = {}
        self.presets: dict[str, dict[str, Any]] = {}
        self.runs: list[dict[str, Any]] = []
        self.samples: list[tuple[float, int, float, int]] = []
        self.last: dict[str, Any] | None = None
        self.focusing: asyncio.Future[dict[str, Any]] | None = None
        self.silent: set[str] = set()
        self.holder: dict[str, Any] | None = None
        """Who has the lease; the gateway runs in this process."""
        self._listeners: dict[asyncio.StreamWriter, int] = {}
        self._listening: socket.socket | None = None
        self._served: dict[asyncio.Task[None], socket.socket] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self.changed = asyncio.Condition()

    async def start(self) -> Self:
        """Listen."""
        self.path.unlink(missing_ok=True)
        self._listening = socket.socket(socket.AF_UNIX)
        self._listening.setblocking(False)
        self._listening.bind(str(self.path))
        self._listening.listen()
        asyncio.get_running_loop().add_reader(self._listening, self._accept)
        return self

    async def stop(self) -> None:
        """Go away as a killed process does: every connection ends, a new one as well; the socket is gone."""
        assert self._listening is not None
        asyncio.get_running_loop().remove_reader(self._listening)
        self._listening.close()
        served = dict(self._served)
        for task in [*served, *self._tasks]:
            task.cancel()
        await asyncio.gather(*served, return_exceptions=True)
        for connection in served.values():
            connection.close()
        self.path.unlink(missing_ok=True)

    async def until(self, true: Callable[[], bool]) -> None:
        """Wait until something was asked that makes this true."""
        async with self.changed:
            await self.changed.wait_for(true)

    async def asked_for(self, method: str, times: int = 1) -> dict[str, Any]:
        """Wait until *method* was asked so often; return the last one's parameters."""
        await self.until(lambda: sum(name == method for name, _ in self.asked) >= times)
        return [params for name, params in self.asked if name == method][-1]

    async def heard(self) -> None:
        """Wait until somebody listens: what was told before is lost."""
        await self.until(lambda: bool(self._listeners))

    @property
    def listeners(self) -> int:
        return len(self._listeners)

    def tell(self, event: messages.Result) -> None:
        """Send one event to whoever subscribed."""
        for writer, seq in list(self._listeners.items()):
            self._listeners[writer] = seq + 1
            writer.write(json.dumps(json.loads(event.model_dump_json()) | {"seq": seq + 1}).encode() + b"\n")

    # --- what a test plays -------------------------------------------------------------------------------------

    def set_state(self, state: str) -> None:
        self.state = state
        self.tell(messages.StateEvent(state=state, mode=self.mode))

    def set_fault(self, kind: str | None, message: str | None = None) -> None:
        self.fault = None if kind is None else {"kind": kind, "message": message, "at_s": 1.79e9}
        self.tell(messages.FaultEvent(kind=kind, message=message))
        self.set_state("READY" if kind is None else "FAULT")

    def phase(self, name: str, progress: float | None = None) -> None:
        self.tell(messages.PhaseEvent(phase=name, progress=progress))

    def sweep(self, begin_um: float, end_um: float, count: int = 60) -> None:
        """Move the lens past *count* windows, with an ELP that has its crossing at the fake world's focus."""
        sign = 1 if end_um > begin_um else -1
        for nth in range(count):
            um = begin_um + (end_um - begin_um) * nth / (count - 1)
            away = (um - FOCUS_UM) / 60.0
            elp = round(-sign * 9e4 * away * math.exp(-away * away / 2) + 2500 * math.sin(7.0 * nth))
            t_us = 2_000_000 + 300 * len(self.samples)
            self.samples.append((um, elp, elp / 2e4, t_us))
            self.tell(messages.SampleEvent(t_us=t_us, position_um=um, elp=elp, score=elp / 2e4, events=180))
        self.move_to(end_um, moving=True)

    def move_to(self, um: float, *, moving: bool = False) -> None:
        self.position_um, self.moving = um, moving
        self.tell(messages.PositionEvent(position_um=um, moving=moving))

    def end_cycle(self, outcome: str = "FOCUSED", **fields: Any) -> dict[str, Any]:
        """End the running cycle with one terminal result."""
        focused = outcome == "FOCUSED"
        name = f"20261122T2243{len(self.runs):02d}Z-001"
        result = messages.FocusAnswer(
            **{
                "outcome": outcome,
                "reason": f"in focus at {FOCUS_UM} um, known to 0.95 um by pairs" if focused else "stopped on request",
                "reversals": 1, "focus_um": FOCUS_UM if focused else None, "sigma_um": 0.95 if focused else None,
                "stop_um": 1610.3, "final_um": self.position_um, "stop_latency_us": 286, "duration_ms": 241.2,
                "phases": [{"name": phase, "ms": 30.0} for phase in PHASES], "events": 90081, "lost": 0,
                "details": {"roi": [245, 52, 288, 288], "method": "pairs"}, "run": name,
            }
            | fields
        ).model_dump(mode="json")  # fmt: skip
        kept = {key: result[key] for key in ("outcome", "reason", "focus_um", "sigma_um", "final_um", "duration_ms")}
        self.runs.insert(0, {"name": name, "at": "2026-11-22T22:43:06Z", "kept": False, **kept})
        self.last = result
        self.moving = False
        self.move_to(result["final_um"])
        self.tell(messages.ResultEvent(**result))
        self.set_state("READY")
        if self.focusing is not None and not self.focusing.done():
            self.focusing.set_result(result)
        return result

    # --- the socket --------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        assert self._listening is not None
        try:
            connection, _ = self._listening.accept()
        except BlockingIOError:
            return  # whoever it was is gone again
        connection.setblocking(False)
        task = asyncio.create_task(self._serve(connection))
        self._served[task] = connection
        task.add_done_callback(self._served.pop)

    async def _serve(self, connection: socket.socket) -> None:
        reader, writer = await asyncio.open_unix_connection(sock=connection)
        try:
            while line := await reader.readline():
                request = json.loads(line)
                task = asyncio.create_task(self._answer(request, writer))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        except OSError:
            pass
        finally:
            self._listeners.pop(writer, None)
            writer.transport.abort()

    async def _answer(self, request: dict[str, Any], writer: asyncio.StreamWriter) -> None:
        method = request["method"]
        try:
            params = messages.METHODS[method].model_validate(request.get("params") or {})
            given = params.model_dump(mode="json", exclude_unset=True)
            if messages.operates(method, params) and self.role != "operate":
                raise Refused("Forbidden", "user 1234 is not in group elpd-operators")
            kept = self.holder is not None and self.holder["pid"] != os.getpid()
            if kept and messages.operates(method, params) and method not in {"cancel", "stop"}:
                raise Refused("Busy", "somebody holds the lease for another 12 s; wait, or ask them")
            result = await self._do(method, given, writer)
            answer: dict[str, Any] = {"result": result}
        except Refused as refused:
            answer = {"error": {"kind": refused.kind, "message": refused.message}}
        except (ValidationError, KeyError) as error:
            answer = {"error": {"kind": "UsageError", "message": str(error).splitlines()[-1]}}
        if method not in self.silent:
            writer.write(json.dumps({"id": request["id"], **answer}).encode() + b"\n")

    async def _do(self, method: str, params: dict[str, Any], writer: asyncio.StreamWriter) -> Any:
        async with self.changed:
            self.asked.append((method, params))
            self.changed.notify_all()
        if method in self.answers:
            result = self.answers[method](params)
        elif method == "focus":
            result = await self._focus()
        elif method == "subscribe":
            self._listeners[writer] = 0
            result = {"subscribed": params.get("events", ["sample"])}
            async with self.changed:
                self.changed.notify_all()
        else:
            result = getattr(self, f"_{method}")(**params)
        model = messages.ANSWERS[method]
        return (
            json.loads(model.model_validate(result).model_dump_json())
            if model is not messages.SubscribeAnswer
            else result
        )

    async def _focus(self) -> dict[str, Any]:
        if self.fault is not None:
            raise Refused("Fault", f"{self.fault['message']}; clear it first")
        if self.focusing is not None and not self.focusing.done():
            raise Refused("Busy", "a focus cycle runs already")
        self.samples = []
        self.focusing = asyncio.get_running_loop().create_future()
        self.set_state("FOCUSING")
        return await self.focusing

    def _hello(self) -> dict[str, Any]:
        return {"version": "0.1.0", "role": self.role, "methods": sorted(messages.METHODS), "schema_digest": "0"}

    def _status(self) -> dict[str, Any]:
        return {
            "state": self.state, "mode": self.mode, "phase": None, "fault": self.fault,
            "lens": {
                "driver": "tic", "position_um": self.position_um, "sigma_um": 0.3, "moving": self.moving,
                "referenced": True, "limits_um": [0.0, 3000.0], "connected": True,
            },
            "camera": {
                "driver": "sim", "width": WIDTH, "height": HEIGHT, "has_frames": False, "connected": True,
                "events": 1_234_567, "events_per_s": 812_000.0,
            },
            "aperture": {"driver": "sim"}, "roi": self.roi, "lease": self._leased(),
            "last": self.last, "warnings": self.warnings, "counters": {"requests": 3, "focused": 2},
            "latency": {"decide": {"p50_us": 90.0, "p99_us": 310.0, "max_us": 900.0}}, "ticks": {"loop": 0.01},
            "uptime_s": 4210.0, "rss_mb": 131.0, "version": "0.1.0", "rig": "sim",
        }  # fmt: skip

    def _leased(self) -> dict[str, Any]:
        return {"holder": self.holder, "until_s": 0.0 if self.holder is None else 12.0}

    def _lease(self, action: str = "acquire", seconds: float = 10.0) -> dict[str, Any]:
        if action == "renew" and self.holder is None:
            raise Refused("Busy", f"the lease of {seconds:g} s has ended and cannot be renewed; acquire it again")
        self.holder = None if action == "release" else {"pid": os.getpid(), "uid": 0, "name": "elpd web"}
        return self._leased()

    def _stop(self) -> dict[str, Any]:
        moving, self.moving = self.moving, False
        if self.focusing is not None and not self.focusing.done():
            self.end_cycle("CANCELLED", final_um=self.position_um)
        return {"stopped": True, "was_moving": moving}

    def _cancel(self) -> dict[str, Any]:
        return {"cancelled": self._stop()["was_moving"]}

    def _home(self) -> dict[str, Any]:
        self.move_to(0.0)
        return {"position_um": 0.0}

    def _move(self, to_um: float | None = None, fraction: float | None = None) -> dict[str, Any]:
        target = 3000.0 * fraction if fraction is not None else to_um
        assert target is not None
        if not 0 <= target <= 3000:
            raise Refused("UsageError", f"{target:.1f} um is outside the limits 0 .. 3000 um")
        self.move_to(target)
        return {"position_um": target, "sigma_um": 0.3}

    def _jog(self, by_um: float) -> dict[str, Any]:
        return self._move(self.position_um + by_um)

    def _clear(self) -> dict[str, Any]:
        cleared = self.fault
        self.set_fault(None)
        return {"cleared": cleared, "state": self.state}

    def _roi(self, name: str | None = None, delete: bool = False, **given: Any) -> dict[str, Any]:  # noqa: FBT001, FBT002
        if delete and name is not None:
            self.named.pop(name, None)
        elif "set" in given:
            roi = given["set"] and clamped(given["set"])
            if name is None:
                self.roi = roi
            else:
                self.named[name] = roi
        return {"roi": self.roi, "named": self.named}

    def _preset(self, action: str, name: str | None = None) -> dict[str, Any]:
        answer: dict[str, Any] = {}
        if action == "save" and name is not None:
            self.presets[name] = {"position_um": self.position_um, "roi": self.roi, "saved_at": "2026-11-22T22:43:06Z"}
        elif action == "delete" and name is not None:
            del self.presets[name]
        elif action == "apply" and name is not None:
            self.move_to(self.presets[name]["position_um"])
            answer["position_um"] = self.position_um
        return answer | {"presets": [{"name": key, **value} for key, value in self.presets.items()]}

    def _mode(self, mode: str | None = None, period_s: float | None = None) -> dict[str, Any]:
        self.mode = mode or self.mode
        if mode is not None:
            self.set_state(self.state)
        return {"mode": self.mode, "period_s": period_s, "hold": {}}

    def _temperature(self, celsius: float) -> dict[str, Any]:
        return {"celsius": celsius, "offset_um": 1.5}

    def _record(self, seconds: float, name: str | None = None) -> dict[str, Any]:
        return {"path": f"recordings/{name or 'unnamed'}.raw", "bytes": round(4e6 * seconds), "events": 1000}

    def _runs(self, limit: int = 20) -> dict[str, Any]:
        return {"runs": self.runs[:limit]}

    def _run(self, name: str) -> dict[str, Any]:
        if not any(run["name"] == name for run in self.runs):
            raise Refused("UsageError", f"there is no run {name!r}")
        return {"name": name, "result": self.last, "samples": self.samples, "config": {}, "files": ["run.json"]}

    def _metrics(self) -> dict[str, Any]:
        return {"text": "# TYPE elpd_focused_total counter\nelpd_focused_total 2\n"}

    def _map(self, kind: str = "latest", format: str = "jpeg", max_width: int | None = None) -> dict[str, Any]:  # noqa: A002
        image = scene()
        if max_width is not None and max_width < WIDTH:
            image = cv2.resize(image, (max_width, round(HEIGHT * max_width / WIDTH)))
        deep = image.astype(np.uint16) * 257 if format == "png16" else image
        coded = cv2.imencode(".jpg" if format == "jpeg" else ".png", deep)[1].tobytes()
        return {
            "kind": "map" if kind == "latest" else kind, "format": format, "width": image.shape[1],
            "height": image.shape[0], "sensor": {"width": WIDTH, "height": HEIGHT},
            "image": base64.b64encode(coded).decode(), "age_s": 2.0, "position_um": self.position_um,
        }  # fmt: skip


class Refused(Exception):  # noqa: N818
    """What the fake answers as an error."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind, self.message = kind, message


class InThread:
    """An event loop in a thread of its own, for tests that do not await."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, name="fake-daemon")
        self._thread.start()

    def run(self, what: Coroutine[Any, Any, Any], timeout_s: float = 30.0) -> Any:
        """Run a coroutine there, and wait for what it returns."""
        return asyncio.run_coroutine_threadsafe(what, self.loop).result(timeout_s)

    def call(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """Call a function there, and wait for what it returns."""
        done: Future[Any] = Future()

        def there() -> None:
            try:
                done.set_result(function(*arguments, **named))
            except BaseException as error:  # noqa: BLE001
                done.set_exception(error)

        self.loop.call_soon_threadsafe(there)
        return done.result(20.0)

    def close(self) -> None:
        async def rest() -> None:
            tasks = asyncio.all_tasks() - {asyncio.current_task()}
            for task in tasks:
                task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.gather(*tasks, return_exceptions=True)

        self.run(rest())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


def clamped(box: dict[str, int]) -> dict[str, int]:
    """Cut to the sensor, as the daemon does."""
    x, y = min(max(box["x"], 0), WIDTH - 1), min(max(box["y"], 0), HEIGHT - 1)
    right, bottom = min(box["x"] + box["width"], WIDTH), min(box["y"] + box["height"], HEIGHT)
    return {"x": x, "y": y, "width": right - x, "height": bottom - y}


def scene() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Draw something with edges, so that a picture is recognised as one."""
    image = np.full((HEIGHT, WIDTH), 40, np.uint8)
    for nth in range(24):
        cv2.circle(image, (640, 360), 15 * nth, 60 + 8 * nth, 2, cv2.LINE_AA)
    cv2.putText(image, "EvTemMap", (100, 180), cv2.FONT_HERSHEY_SIMPLEX, 3.0, 220, 6, cv2.LINE_AA)
    return image
