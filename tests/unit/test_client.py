from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from sockets import press_ctrl_c, serving

from elpd.client import AsyncClient, Client, socket_path, wire
from elpd.errors import BusyError, UnreachableError, UsageError
from elpd.service.messages import FaultEvent, PhaseEvent, SampleEvent, StateEvent

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator

    from fake_engine import FakeEngine


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "elpd.sock"


@pytest.fixture
def engine(path: Path) -> Iterator[FakeEngine]:
    with serving(path) as engine:
        yield engine


@pytest.fixture
def rig(path: Path, engine: FakeEngine) -> Iterator[Client]:
    with Client(path) as client:
        yield client


@pytest.fixture
def aside() -> Iterator[Callable[..., Future[Any]]]:
    with ThreadPoolExecutor() as pool:
        yield pool.submit


def sample(t_us: int) -> SampleEvent:
    return SampleEvent(t_us=t_us, position_um=1.0, elp=5, score=2.0, events=9)


def test_the_client_needs_nothing_but_the_standard_library() -> None:
    heavy = "{'numpy', 'numba', 'pydantic', 'structlog', 'click', 'cv2', 'asyncio'}"
    for what, found in (("elpd.client", "[]\n"), ("elpd.client.aio", "['asyncio']\n")):
        code = f"import {what}, sys; print(sorted({heavy} & set(sys.modules)))"
        told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert told.stdout == found


def test_the_socket_is_looked_for_where_a_daemon_would_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("ELPD_SOCKET", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(wire, "SYSTEM_SOCKET", Path("/proc/none/elpd/elpd.sock"))
    assert socket_path() == tmp_path / "elpd" / "elpd.sock"
    (tmp_path / "run").mkdir()
    monkeypatch.setattr(wire, "SYSTEM_SOCKET", tmp_path / "run" / "elpd" / "elpd.sock")
    assert socket_path() == tmp_path / "run" / "elpd" / "elpd.sock"  # no daemon yet; this user's would be there
    (tmp_path / "elpd").mkdir()
    (tmp_path / "elpd" / "elpd.sock").touch()
    assert socket_path() == tmp_path / "elpd" / "elpd.sock"
    monkeypatch.setenv("ELPD_SOCKET", "/from/the/environment")
    assert socket_path() == Path("/from/the/environment")
    assert socket_path("/given") == Path("/given")
    with pytest.raises(UsageError, match="107 bytes"):
        socket_path(tmp_path / ("x" * 107))


def test_focus_waits_for_its_end(rig: Client, engine: FakeEngine, aside: Callable[..., Future[Any]]) -> None:
    answer = aside(rig.focus, {"x": 1, "y": 2, "width": 3, "height": 4})
    engine.heard(lambda: "focus" in engine.calls)
    asked = engine.accepted[0].request.params.model_dump(exclude_unset=True)
    assert asked == {"roi": {"x": 1, "y": 2, "width": 3, "height": 4}, "on_disconnect": "finish"}
    assert rig.status()["state"] == "READY"  # over the same connection, meanwhile
    assert not answer.done()
    engine.finish()
    assert answer.result()["outcome"] == "FOCUSED"


def test_a_region_is_read_set_and_unset(rig: Client, engine: FakeEngine) -> None:
    box = {"x": 1, "y": 2, "width": 3, "height": 4}
    for asked, params in (({}, {}), ({"set": None}, {"set": None}), ({"set": box}, {"set": box})):
        rig.roi(**asked)  # type: ignore[arg-type]
        assert engine.requests[-1].params.model_dump(exclude_unset=True) == params


def test_stop_goes_out_while_focus_waits(rig: Client, engine: FakeEngine, aside: Callable[..., Future[Any]]) -> None:
    answer = aside(rig.focus)
    engine.heard(lambda: "focus" in engine.calls)
    assert rig.stop() == {"stopped": True, "was_moving": True}
    assert answer.result()["outcome"] == "CANCELLED"


def test_a_focus_that_takes_too_long_is_cancelled(rig: Client, engine: FakeEngine) -> None:
    assert rig.focus(timeout_s=0.01)["outcome"] == "CANCELLED"
    assert engine.accepted[0].answer is not None


def test_ctrl_c_cancels_the_cycle(rig: Client, engine: FakeEngine) -> None:
    def press() -> None:
        engine.heard(lambda: "focus" in engine.calls)
        press_ctrl_c()

    presser = threading.Thread(target=press)
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        presser.start()
        with pytest.raises(KeyboardInterrupt):
            rig.focus()
        presser.join()
    finally:
        signal.signal(signal.SIGINT, previous)
    engine.heard(lambda: engine.accepted[0].answer is not None)


def test_errors_have_the_kinds_that_the_library_knows(rig: Client, engine: FakeEngine) -> None:
    pending = rig.begin("focus")
    with pytest.raises(BusyError, match="something runs"):
        rig.focus()
    with pytest.raises(UsageError, match="by_um"):
        rig.call("jog")
    with pytest.raises(UsageError, match="not JSON"):
        rig.jog(float("nan"))
    engine.finish()
    assert pending.result(5.0)["outcome"] == "FOCUSED"


def test_events_come_in_order_and_end_with_the_iterator(path: Path, engine: FakeEngine) -> None:
    with Client(path).events(["sample", "phase"], rate_hz=1000) as events:
        engine.tell(PhaseEvent(phase="sweep"))
        engine.tell(StateEvent(state="READY", mode="manual"))  # not asked for
        for t_us in (1000, 2000, 3000):
            engine.tell(sample(t_us))
        told = [next(events) for _ in range(4)]
    assert [event["event"] for event in told] == ["phase", "sample", "sample", "sample"]
    assert [event["seq"] for event in told] == [1, 2, 3, 4]
    assert list(events) == []
    engine.heard(lambda: len(engine.departed) == 1)


def test_events_of_a_cycle_arrive_before_its_answer(
    rig: Client, engine: FakeEngine, aside: Callable[..., Future[Any]]
) -> None:
    seen: list[Any] = []
    answer = aside(rig.focus, on_event=seen.append)
    engine.heard(lambda: "focus" in engine.calls)
    engine.tell(PhaseEvent(phase="sweep"))
    engine.tell(sample(5))
    engine.tell(FaultEvent(kind="LensError", message="it is gone"))
    engine.finish()
    assert answer.result()["outcome"] == "FOCUSED"
    assert [event["event"] for event in seen] == ["phase", "sample", "fault"]
    engine.tell(PhaseEvent(phase="probe"))
    assert rig.status()["state"] == "READY"
    assert len(seen) == 3  # subscribed no more


# --- a daemon that goes ------------------------------------------------------------------------------------------


def test_without_a_daemon_the_error_says_what_to_do(path: Path) -> None:
    with pytest.raises(UnreachableError, match="elpd serve"):
        Client(path).status()
    path.touch()
    with pytest.raises(UnreachableError, match="daemon is gone"):
        Client(path).status()


def test_a_daemon_that_came_back_is_found_by_the_next_call(path: Path) -> None:
    with Client(path) as rig:
        with serving(path):
            assert rig.status()["state"] == "READY"
        with serving(path):
            assert rig.stop()["stopped"]


def test_a_motion_whose_answer_is_lost_is_not_sent_again(path: Path) -> None:
    with Client(path) as rig:
        with serving(path) as engine:
            pending = rig.begin("move", {"to_um": 3.0})
            engine.heard(lambda: "move" in engine.calls)
        with pytest.raises(BusyError, match="daemon ends"):
            pending.result(5.0)
        with serving(path) as after:
            rig.status()
        assert after.accepted == []


def test_events_go_on_after_a_restart(path: Path) -> None:
    with serving(path):
        events = Client(path).events(["state"], reconnect_s=10.0)
    with events, serving(path) as engine:
        assert next(events)["event"] == "reconnected"
        engine.tell(StateEvent(state="READY", mode="manual"))
        assert next(events)["event"] == "state"
    with serving(path):
        events = Client(path).events(["state"])
    with events, pytest.raises(UnreachableError, match="closed"):
        next(events)


# --- awaiting ----------------------------------------------------------------------------------------------------


def awaited(path: Path, story: Callable[[AsyncClient], Coroutine[Any, Any, None]]) -> None:
    async def tell() -> None:
        async with AsyncClient(path) as rig:
            await story(rig)

    asyncio.run(tell())


def test_the_awaiting_client_does_the_same(path: Path, engine: FakeEngine) -> None:
    async def story(rig: AsyncClient) -> None:
        cycle = asyncio.ensure_future(rig.focus())
        await asyncio.to_thread(engine.heard, lambda: "focus" in engine.calls)
        with pytest.raises(BusyError, match="something runs"):
            await rig.home()
        assert (await rig.status())["state"] == "READY"
        assert (await rig.stop())["was_moving"]
        assert (await cycle)["outcome"] == "CANCELLED"
        assert (await rig.focus(timeout_s=0.01))["outcome"] == "CANCELLED"

    awaited(path, story)


def test_a_task_that_is_cancelled_cancels_its_cycle(path: Path, engine: FakeEngine) -> None:
    async def story(rig: AsyncClient) -> None:
        cycle = asyncio.ensure_future(rig.focus())
        await asyncio.to_thread(engine.heard, lambda: "focus" in engine.calls)
        cycle.cancel()
        with pytest.raises(asyncio.CancelledError):
            await cycle
        await asyncio.to_thread(engine.heard, lambda: engine.accepted[0].answer is not None)

    awaited(path, story)


def test_awaited_events_come_in_order(path: Path, engine: FakeEngine) -> None:
    async def story(rig: AsyncClient) -> None:
        events = rig.events(["state"])
        first = asyncio.ensure_future(anext(events))
        while not first.done():  # from whenever the subscription has come through
            engine.tell(StateEvent(state="READY", mode="manual"))
            await asyncio.sleep(0)
        engine.tell(StateEvent(state="FOCUSING", mode="manual"))
        told = [await first]
        while told[-1].get("state") != "FOCUSING":
            told.append(await anext(events))
        assert [event["seq"] for event in told] == list(range(1, len(told) + 1))
        await events.aclose()

    awaited(path, story)


def test_the_awaiting_client_finds_a_daemon_that_came_back(path: Path) -> None:
    async def story(rig: AsyncClient) -> None:
        with pytest.raises(UnreachableError, match="elpd serve"):
            await rig.status()
        with serving(path):
            assert (await rig.status())["state"] == "READY"
        with serving(path):
            assert (await rig.stop())["stopped"]

    awaited(path, story)
