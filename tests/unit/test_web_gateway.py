"""The page's process before a daemon that does what a test says: refusals, commands, streams, restarts."""

from __future__ import annotations

import asyncio
import json
import logging
import re
from typing import Any

import aiohttp
import pytest
from fake_daemon import PHASES, Refused
from gateways import TOKEN, gateway, run

RIGHT = {"Authorization": f"Bearer {TOKEN}"}
WRITE = {**RIGHT, "X-Elpd": "1"}


@pytest.mark.parametrize(
    ("status", "method", "path", "headers"),
    [
        (421, "GET", "/", {"Host": "evil.example"}),
        (421, "GET", "/", {"Host": "127.0.0.1"}),  # our address, another port
        (421, "GET", "/", {"Host": "127.0.0.1:HERE.evil.example"}),
        (421, "POST", "/api/stop", {**WRITE, "Host": "rebound.example:HERE"}),
        (403, "GET", "/api/status", {**RIGHT, "Origin": "https://evil.example"}),
        (403, "GET", "/api/status", {**RIGHT, "Origin": "null"}),
        (403, "POST", "/api/stop", {**WRITE, "Origin": "http://127.0.0.1:1"}),
        (403, "POST", "/api/stop", {**WRITE, "Sec-Fetch-Site": "cross-site"}),
        (403, "POST", "/api/stop", {**WRITE, "Sec-Fetch-Site": "same-site"}),
        (403, "GET", "/", {"Sec-Fetch-Site": "cross-site"}),
        (401, "GET", "/api/status", {}),
        (401, "GET", "/api/status", {"Authorization": "Bearer wrong"}),
        (401, "GET", "/api/status", {"Authorization": TOKEN}),
        (401, "GET", "/api/status", {"Authorization": "Bearer \u00e9\u00e9"}),
        (401, "GET", f"/api/status?token={TOKEN}", {}),
        (401, "GET", "/api/events", {}),
        (401, "POST", "/api/stop", {"X-Elpd": "1"}),
        (401, "GET", "/api/no-such-thing", {}),
        (403, "POST", "/api/stop", RIGHT),  # no header of ours: what a form could send
        (415, "POST", "/api/stop", {**WRITE, "Content-Type": "text/plain"}),
        (405, "GET", "/api/roi?set=1", RIGHT),
        (404, "GET", "/api/stop", RIGHT),  # commands are not questions
        (404, "GET", "/api/focus", RIGHT),
        (400, "POST", "/api/lease", WRITE),  # let in; the daemon misses what to do
        (200, "POST", "/api/stop", {**WRITE, "Content-Type": "application/json; charset=klingon"}),
        (405, "PUT", "/api/stop", WRITE),
        (405, "POST", "/", WRITE),
        (404, "GET", "/../pyproject.toml", {}),
        (404, "GET", "/%2e%2e/gateway.py", {}),
        (404, "GET", "/package.json", {}),
        (200, "GET", "/", {}),
        (200, "GET", "/", {"Sec-Fetch-Site": "none"}),
        (200, "GET", "/", {"Host": "RIG.lab"}),
        (200, "GET", "/", {"Host": "rig.lab", "Origin": "https://rig.lab"}),
        (200, "GET", "/", {"Host": "localhost:HERE"}),
        (200, "GET", "/api/status", RIGHT),
        (200, "POST", "/api/stop", {**WRITE, "Origin": "http://127.0.0.1:HERE", "Sec-Fetch-Site": "same-origin"}),
        (200, "POST", "/api/stop", {**WRITE, "Content-Type": "application/json; charset=utf-8"}),
    ],
)
def test_who_is_let_in(status: int, method: str, path: str, headers: dict[str, str]) -> None:
    async def story() -> None:
        async with gateway(hosts=("rig.lab",)) as here:
            sent = {name: value.replace("HERE", str(here.port)) for name, value in headers.items()}
            if method == "POST":
                sent.setdefault("Content-Type", "application/json")
            async with here.session.request(method, here.url(path), headers=sent, data=b"{}") as answer:
                assert answer.status == status, await answer.text()
                assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'; ")
                assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
                if status >= 400:
                    error = (await answer.json())["error"]
                    assert error["kind"]
                    assert error["message"]
                    assert [name for name, _ in here.daemon.asked if name in {"stop", "focus", "roi"}] == []

    run(story())


def test_two_hosts_or_two_tokens_are_neither() -> None:
    async def story() -> None:
        async with gateway() as here:
            for extra, status in (("Host: evil.example", 421), (f"Authorization: Bearer {TOKEN}", 401)):
                lines = ["GET /api/status HTTP/1.1", f"Host: {here.host}", f"Authorization: Bearer {TOKEN}", extra]
                reader, writer = await asyncio.open_connection("127.0.0.1", here.port)
                writer.write("\r\n".join([*lines, "Connection: close", "", ""]).encode())
                answer = await reader.read()
                writer.close()
                assert answer.split(b" ")[1] in {str(status).encode(), b"400"}, answer[:200]
                assert here.daemon.asked[-1:] != [("status", {})] or here.daemon.listeners

    run(story())


def test_the_page_and_its_files_allow_nothing_inline() -> None:
    async def story() -> None:
        async with gateway() as here, here.get("/") as page:
            text = await page.text()
            assert page.headers["Content-Type"] == "text/html; charset=utf-8"
            assert not re.search(r"<script(?![^>]*src=)|<style|\sstyle=|\son\w+=", text)
            for path in re.findall(r'(?:src|href)="([^"#]+)"', text):
                async with here.get("/" + path.removeprefix("/")) as file:
                    assert file.status == 200, path
                    tag = file.headers["ETag"]
                async with here.get("/" + path.removeprefix("/"), **{"If-None-Match": tag}) as again:
                    assert again.status == 304

    run(story())


def test_a_body_that_is_too_large_or_no_object_reaches_nobody() -> None:
    async def story() -> None:
        async with gateway() as here:
            for body, status in (
                (b'{"to_um": ' + b"1" * 20_000 + b"}", 413),
                (b"[1]", 400),
                (b"{", 400),
                (b"[" * 10_000, 400),
                (b"\xff", 400),
            ):
                headers = {**WRITE, "Content-Type": "application/json"}
                async with here.session.post(here.url("/api/move"), data=body, headers=headers) as answer:
                    assert answer.status == status
                    assert "error" in await answer.json()
            assert "move" not in [name for name, _ in here.daemon.asked]

    run(story())


def test_parameters_and_answers_pass_through() -> None:
    async def story() -> None:
        async with gateway() as here:
            async with here.post("move", {"to_um": 1500.0}) as answer:
                moved = await answer.json()
                assert (moved["position_um"], moved["sigma_um"]) == (1500.0, 0.3)
            async with here.post("roi", {"set": {"x": 1200, "y": -20, "width": 400, "height": 100}}) as answer:
                assert (await answer.json())["roi"] == {"x": 1200, "y": 0, "width": 80, "height": 80}
            async with here.get("/api/runs?limit=5") as answer:
                assert await answer.json() == {"runs": []}
            assert ("runs", {"limit": 5}) in here.daemon.asked
            async with here.get("/api/runs?limit=five") as answer:
                assert answer.status == 400
            async with here.get("/api/metrics") as answer:
                assert (await answer.text()).startswith("# TYPE elpd_focused_total")

    run(story())


@pytest.mark.parametrize(("format_", "magic"), [("jpeg", b"\xff\xd8"), ("png16", b"\x89PNG")])
def test_a_picture_is_sent_as_a_file_with_its_facts_in_a_header(format_: str, magic: bytes) -> None:
    async def story() -> None:
        async with gateway() as here, here.get(f"/api/map?kind=map&format={format_}&max_width=640") as answer:
            assert (await answer.read()).startswith(magic)
            facts = json.loads(answer.headers["X-Elpd-Picture"])
            assert facts["sensor"] == {"width": 1280, "height": 720}
            assert (facts["width"], facts["height"]) == (640, 360)
            assert "image" not in facts

    run(story())


@pytest.mark.parametrize(("there", "shown"), [("frame map", "frame"), ("map events", "map"), ("events", "events")])
def test_the_picture_to_draw_on_is_a_frame_else_the_map_else_what_there_is(there: str, shown: str) -> None:
    async def story() -> None:
        async with gateway() as here:

            def picture(params: dict[str, Any]) -> dict[str, Any]:
                kind = params["kind"]
                if kind not in {"latest", *there.split()}:
                    raise Refused("UsageError", f"there is no picture of kind {kind!r} yet")
                return {**here.daemon._map(**params), "kind": shown if kind == "latest" else kind}

            here.daemon.answers["map"] = picture
            async with here.get("/api/map?kind=auto") as answer:
                assert json.loads(answer.headers["X-Elpd-Picture"])["kind"] == shown

    run(story())


@pytest.mark.parametrize(
    ("kind", "status"),
    [("Busy", 409), ("Forbidden", 403), ("Fault", 423), ("LensError", 502), ("NewInTheYear3000", 502)],
)
def test_a_refusal_of_the_daemon_keeps_its_kind_and_sentence(kind: str, status: int) -> None:
    async def story() -> None:
        async with gateway() as here:

            def refuse(_: object) -> None:
                raise Refused(kind, "what, measured, limit, next step")

            here.daemon.answers["home"] = refuse
            async with here.post("home") as answer:
                assert answer.status == status
                error = (await answer.json())["error"]
                assert error["kind"] == ("DeviceError" if kind.startswith("New") else kind)
                assert error["message"].endswith("what, measured, limit, next step")

    run(story())


def test_stop_overtakes_a_running_cycle_and_a_full_desk() -> None:
    async def story() -> None:
        async with gateway() as here:
            here.daemon.silent |= {"home"}
            waiting = [asyncio.ensure_future(here.post("home").__aenter__()) for _ in range(6)]
            await here.daemon.asked_for("home", times=6)
            async with here.post("home") as answer:
                assert answer.status == 409
                assert "unanswered" in (await answer.json())["error"]["message"]
            async with here.post("stop") as answer:
                assert await answer.json() == {"stopped": True, "was_moving": False}
            for one in waiting:
                one.cancel()

    run(story())


def test_a_cycle_is_seen_by_every_tab_over_one_subscription() -> None:
    async def story() -> None:
        async with gateway() as here, here.events() as one, here.events() as two:
            for tab in (one, two):
                assert (await tab.next("reset"))[1] == {}
                assert (await tab.next("status"))[1]["state"] == "READY"
            await here.daemon.heard()
            assert here.daemon.listeners == 1
            focusing = asyncio.ensure_future(here.post("focus", {"on_disconnect": "finish"}).__aenter__())
            await here.daemon.asked_for("focus")
            for name in PHASES:
                here.daemon.phase(name)
                if name == "sweep":
                    here.daemon.sweep(1400.0, 1600.0, 40)
            here.daemon.end_cycle()
            for tab in (one, two):
                seen = []
                while not seen or seen[-1] != "result":
                    seen.append((await tab.next("phase", "sample", "result"))[0])
                assert seen.count("phase") == len(PHASES)
                assert seen.count("sample") == 40
            answer = await focusing
            assert (await answer.json())["outcome"] == "FOCUSED"

    run(story())


def test_a_tab_that_comes_back_gets_what_it_missed_and_no_more() -> None:
    async def story() -> None:
        async with gateway() as here:
            async with here.events() as tab:
                await here.daemon.heard()
                here.daemon.phase("probe")
                await tab.next("phase")
            here.daemon.phase("sweep")
            here.daemon.phase("stop")
            async with here.events(tab.last_seen) as back:
                assert [(await back.next("phase", "reset"))[1]["phase"] for _ in range(2)] == ["sweep", "stop"]

    run(story())


@pytest.mark.parametrize("last_seen", [None, "nonsense", "00000000.3", "00000000.99999999999999999999"])
def test_a_stranger_gets_the_present_cycle_from_its_beginning(last_seen: str | None) -> None:
    async def story() -> None:
        async with gateway() as here, here.events() as first:
            await here.daemon.heard()
            here.daemon.phase("probe")
            here.daemon.end_cycle()  # a cycle of before
            here.daemon.phase("expose")
            here.daemon.phase("sweep")
            while (await first.next("phase"))[1]["phase"] != "sweep":
                pass
            async with here.events(last_seen) as late:
                await late.next("reset")
                assert [(await late.next("phase"))[1]["phase"] for _ in range(2)] == ["expose", "sweep"]

    run(story())


def test_the_daemon_goes_and_comes_back() -> None:
    async def story() -> None:
        async with gateway() as here, here.events() as tab:
            await tab.next("status")
            await here.daemon.stop()
            gone = (await tab.next("link"))[1]
            assert gone["connected"] is False
            assert gone["reason"]
            async with here.post("stop") as answer:
                assert answer.status == 503
                assert "elpd serve" in (await answer.json())["error"]["message"]
            await here.daemon.start()
            back = (await tab.next("link"))[1]
            while not back["connected"]:
                back = (await tab.next("link"))[1]
            assert back["role"] == "operate"
            await tab.next("status")
            async with here.post("jog", {"by_um": 10.0}) as answer:
                assert answer.status == 200
            await here.daemon.heard()
            here.daemon.phase("probe")
            assert (await tab.next("phase"))[1]["phase"] == "probe"

    run(story())


def test_no_daemon_at_all_is_told_with_the_reason() -> None:
    async def story() -> None:
        async with gateway(with_daemon=False) as here, here.events() as tab:
            link = (await tab.next("link"))[1]
            while "elpd serve" not in link["reason"]:
                link = (await tab.next("link"))[1]
            assert link["connected"] is False

    run(story())


def test_a_cycle_whose_page_was_closed_goes_on_to_its_result() -> None:
    async def story() -> None:
        async with gateway() as here:
            asking = asyncio.ensure_future(here.post("focus").__aenter__())
            await here.daemon.asked_for("focus")
            asking.cancel()
            async with here.get("/api/status") as answer:
                assert (await answer.json())["state"] == "FOCUSING"
            assert [name for name, _ in here.daemon.asked if name in {"cancel", "stop"}] == []

    run(story())


def test_the_token_is_in_no_log(caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]) -> None:
    async def story() -> None:
        with caplog.at_level(logging.DEBUG):
            async with gateway() as here:
                async with here.post("jog", {"by_um": 1.0}) as answer:
                    assert answer.status == 200
                async with here.session.get(here.url(f"/api/status?token={TOKEN}")) as answer:
                    assert answer.status == 401

    run(story())
    out, err = capsys.readouterr()
    assert TOKEN not in caplog.text + out + err


def test_too_many_tabs_are_refused_and_a_closed_one_makes_room() -> None:
    async def story() -> None:
        async with gateway() as here, aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as many:
            here.session, single = many, here.session
            tabs = [await here.events().__aenter__() for _ in range(24)]
            async with here.get("/api/events") as answer:
                assert answer.status == 503
            await here.daemon.heard()
            tabs[0].response.close()
            here.daemon.phase("probe")
            while True:  # its closing is seen when something is sent to it
                here.daemon.phase("sweep")
                async with here.get("/api/events") as answer:
                    if answer.status == 200:
                        break
            for tab in tabs[1:]:
                tab.response.close()
            here.session = single

    run(story())
