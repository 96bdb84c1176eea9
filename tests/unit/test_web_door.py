"""The page's process before callers who are slow, silent, many or rude; and the lease among its tabs."""

from __future__ import annotations

import asyncio
import gzip
from typing import TYPE_CHECKING, Any

import structlog
from gateways import TOKEN, Gateway, gateway, run

from elpd.web import door
from elpd.web import gateway as served

if TYPE_CHECKING:
    import pytest

AT_ONCE_S = 0.01


async def caller(here: Gateway, said: str = "") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect, and say this much of a request."""
    reader, writer = await asyncio.open_connection("127.0.0.1", here.port)
    writer.write(said.replace("\n", "\r\n").encode())
    await writer.drain()
    return reader, writer


def head(here: Gateway, first: str, *more: str) -> str:
    lines = [first, f"Host: {here.host}", f"Authorization: Bearer {TOKEN}", "X-Elpd: 1", *more]
    return "\n".join([*lines, "Content-Type: application/json", "", ""])


def test_who_says_nothing_or_half_a_head_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "HEAD_WITHIN_S", AT_ONCE_S)

    async def story() -> None:
        async with gateway() as here:
            for said in ("", "GET / HTTP/1.1\nHost: 127"):
                reader, writer = await caller(here, said)
                assert await reader.read() == b""
                writer.close()
            async with here.events() as tab:  # one that has asked stays, however long its answer takes
                await here.daemon.heard()
                await asyncio.sleep(3 * AT_ONCE_S)
                here.daemon.phase("probe")
                await tab.next("phase")

    run(story())


def test_more_connections_than_there_is_room_for_are_closed_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(door, "MOST_CONNECTIONS", 4)

    async def story() -> None:
        async with gateway() as here, here.get("/") as answer:
            assert answer.status == 200  # its connection is kept for the next request
            idle = [await caller(here) for _ in range(3)]
            reader, last = await caller(here)
            assert await reader.read() == b""
            async with here.post("stop") as stopped:
                assert stopped.status == 200
            for _, writer in [*idle, (reader, last)]:
                writer.close()

    run(story())


def test_a_body_that_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served, "BODY_WITHIN_S", AT_ONCE_S)

    async def story() -> None:
        async with gateway() as here:
            reader, writer = await caller(here, head(here, "POST /api/move HTTP/1.1", "Content-Length: 20"))
            assert (await reader.readline()).split()[1] == b"408"
            writer.close()
            assert "move" not in [name for name, _ in here.daemon.asked]

    run(story())


def test_a_tab_that_reads_nothing_loses_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served, "STALLED_S", 0.2)
    monkeypatch.setattr(served, "BATCH_EVERY_S", 0.0)

    async def story() -> None:
        async with gateway() as here, here.events() as other:
            await here.daemon.heard()
            reader, writer = await caller(here, head(here, "GET /api/events HTTP/1.1"))
            await reader.readline()
            assert len(here.app[served.STREAMS]) == 2
            writer.transport.pause_reading()
            while len(here.app[served.STREAMS]) == 2:  # until the kernel's buffers are full, and the patience over
                here.daemon.sweep(1000.0, 1100.0, 200)
                here.daemon.phase("sweep")
                await other.next("phase")
            writer.close()

    run(story())


def test_packed_and_broken_bodies_reach_nobody() -> None:
    async def story() -> None:
        async with gateway() as here:
            bomb = gzip.compress(b'{"to_um": ' + b"0" * 10_000_000 + b"1}")
            assert len(bomb) < served.BODY_LIMIT_BYTES  # and is not unpacked
            headers = {"Authorization": f"Bearer {TOKEN}", "X-Elpd": "1", "Content-Type": "application/json"}
            packed = headers | {"Content-Encoding": "gzip"}
            async with here.session.post(here.url("/api/move"), data=bomb, headers=packed) as answer:
                assert answer.status == 400
            reader, writer = await caller(here, head(here, "POST /api/move HTTP/1.1", "Transfer-Encoding: chunked"))
            writer.write(b"no length of a chunk\r\n")
            assert (await reader.readline()).split()[1] == b"400"
            writer.close()
            assert "move" not in [name for name, _ in here.daemon.asked]

    run(story())


def test_a_refused_path_cannot_write_to_the_terminal_that_reads_the_log() -> None:
    async def story() -> None:
        async with gateway() as here:
            reader, writer = await caller(here, f"GET /api/%1b[2J{'x' * 900}?token=secret HTTP/1.1\nHost: evil\n\n")
            assert (await reader.readline()).split()[1] == b"421"
            writer.close()

    with structlog.testing.capture_logs() as logs:
        run(story())
    paths = [entry["path"] for entry in logs if entry["event"] == "refused"]
    assert [(path.startswith("/api/%1b[2Jx"), len(path), "secret" in path) for path in paths] == [(True, 200, False)]


def test_one_tab_keeps_the_rig_from_the_others_and_gives_it_back() -> None:
    async def story() -> None:
        async with gateway() as here:
            assert await asked(here, "one", "lease", action="acquire", seconds=15) == 200
            for method in ("jog", "focus", "clear", "lease"):
                assert await asked(here, "two", method) == 409
            assert [name for name, _ in here.daemon.asked if name in {"jog", "focus", "clear"}] == []
            assert await asked(here, "two", "stop") == 200
            assert await asked(here, "one", "jog", by_um=1) == 200
            assert await asked(here, "one", "lease", action="renew", seconds=15) == 200
            assert await asked(here, "one", "lease", action="release") == 200
            assert await asked(here, "two", "jog", by_um=1) == 200

    run(story())


def test_a_tab_whom_the_daemon_refuses_the_lease_keeps_nobody_out() -> None:
    async def story() -> None:
        async with gateway() as here:
            here.daemon.holder = {"pid": 1, "uid": 0, "name": "elpd lease"}
            assert await asked(here, "one", "lease", action="acquire", seconds=15) == 409
            here.daemon.holder = None
            assert await asked(here, "two", "jog", by_um=1) == 200
            assert await asked(here, "two", "lease", action="renew", seconds=15) == 409  # there is none

    run(story())


def test_two_tabs_that_ask_for_the_lease_at_once_do_not_both_get_it() -> None:
    async def story() -> None:
        async with gateway() as here:
            both = [asked(here, tab, "lease", action="acquire", seconds=15) for tab in ("one", "two")]
            assert sorted(await asyncio.gather(*both)) == [200, 409]

    run(story())


async def asked(here: Gateway, tab: str, method: str, **params: Any) -> int:
    headers = {"Authorization": f"Bearer {TOKEN}", "X-Elpd": "1", "X-Elpd-Tab": tab}
    async with here.session.post(here.url(f"/api/{method}"), json=params, headers=headers) as answer:
        status: int = answer.status
        return status
