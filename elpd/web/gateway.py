"""The HTTP side: a few routes, one judgement before each, one set of headers after each.

==============================  =================================================================================
``GET /`` and the page's files  open to whoever reaches the port; they hold no secret
``GET /api/METHOD?name=value``  a question; ``map`` answers with the picture itself, ``metrics`` with text; ``map``
                                also knows ``kind=auto``
``GET /api/events``             server-sent events: ``link reset status sample phase result fault state position
                                dropped``; resumes after ``Last-Event-ID``
``POST /api/METHOD``            a command; the body holds its parameters
==============================  =================================================================================

An error is ``{"error": {"kind", "message"}}`` with the status that ``commands`` has for its kind. There is no access
log: what was commanded is logged here, without headers, so no token can end up in a file.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
from typing import TYPE_CHECKING, Any

import structlog
from aiohttp import web

from elpd.errors import ElpdError
from elpd.web import pages
from elpd.web.commands import COMMANDS, QUESTIONS, STATUS_OF, Desk, kind_of
from elpd.web.door import has_asked, listening_on
from elpd.web.relay import Relay
from elpd.web.security import HEADERS, Gate

if TYPE_CHECKING:
    import socket
    from collections.abc import AsyncIterator, Awaitable, Callable
    from pathlib import Path

BODY_LIMIT_BYTES = 16 << 10
MAX_TABS = 24
BATCH_EVERY_S = 1 / 30
STILL_HERE_S = 10.0
STALLED_S = 30.0
"""A tab that takes nothing for so long loses its place; it comes back by itself."""
BODY_WITHIN_S = 5.0
PATH_LETTERS = 200
PICTURE_TYPES = {"jpeg": "image/jpeg", "png": "image/png", "png16": "image/png"}
TAB_HEADER, TAB_LETTERS = "X-Elpd-Tab", 64
"""Which tab asks, a word of its own choice: the lease is one tab's."""
NUMBERS = frozenset({"limit", "max_width"})
"""Query fields that are whole numbers; the others are words."""

GATE = web.AppKey("gate", Gate)
DESK = web.AppKey("desk", Desk)
RELAY = web.AppKey("relay", Relay)
STREAMS = web.AppKey("streams", set[asyncio.Task[Any]])

log = structlog.get_logger(__name__)


def build_app(daemon: Path, gate: Gate) -> web.Application:
    """Return the application: a *daemon*'s socket behind a *gate*."""
    app = web.Application(middlewares=[_judge], client_max_size=BODY_LIMIT_BYTES)
    app[GATE], app[DESK], app[RELAY], app[STREAMS] = gate, Desk(daemon), Relay(daemon), set()
    for path, page in pages.read_pages().items():
        app.router.add_get(path, _page_handler(page))
    app.router.add_get("/api/events", _events)
    app.router.add_get("/api/{method}", _question)
    app.router.add_post("/api/{method}", _command)
    app.on_response_prepare.append(_add_headers)
    app.cleanup_ctx.append(_relaying)
    app.on_shutdown.append(_end_streams)
    return app


async def serve(app: web.Application, listening: socket.socket) -> None:
    """Serve on an open socket until cancelled."""
    async with listening_on(app, listening):
        await asyncio.Event().wait()


@web.middleware
async def _judge(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """Let in or refuse; give every error one form."""
    has_asked(request)
    refusal = request.app[GATE].judge(request.method, request.path, request.headers)
    if refusal is not None:
        asked = request.raw_path.partition("?")[0][:PATH_LETTERS]  # raw: no letter that a terminal would obey
        log.warning("refused", status=refusal.status, method=request.method, path=asked)
        return _error(refusal.status, "Refused", refusal.message)
    try:
        return await handler(request)
    except ElpdError as error:
        kind = kind_of(error)
        return _error(STATUS_OF.get(kind, 500), kind, str(error))
    except web.HTTPException as error:
        return _error(error.status, "UsageError", error.text or error.reason)


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)
    if request.path.startswith("/api/"):
        response.headers["Cache-Control"] = "no-store"
    response.headers["Server"] = "elpd"


def _page_handler(page: pages.Page) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
    async def handler(request: web.Request) -> web.StreamResponse:
        return pages.answer(page, request)

    return handler


async def _command(request: web.Request) -> web.StreamResponse:
    method = request.match_info["method"]
    if method not in COMMANDS:
        return _error(404, "UsageError", f"there is no command {method!r}; there are {', '.join(sorted(COMMANDS))}")
    try:
        async with asyncio.timeout(BODY_WITHIN_S):
            body = await request.read()
    except TimeoutError:
        return _error(408, "UsageError", f"the body did not come within {BODY_WITHIN_S:g} s")
    except web.RequestPayloadError:
        return _error(400, "UsageError", "the body is broken")
    try:
        params = json.loads(body)  # UTF-8, whatever the head says
    except (ValueError, RecursionError):
        return _error(400, "UsageError", "the body is not JSON")
    if not isinstance(params, dict):
        return _error(400, "UsageError", "the body is not a JSON object")
    tab = request.headers.get(TAB_HEADER, "")[:TAB_LETTERS]
    answer = await request.app[DESK].command(method, params, tab)
    if params.get("action") != "renew":  # every few seconds, and nothing new
        log.info("command", method=method, params=params)
    return web.json_response(answer)


async def _question(request: web.Request) -> web.StreamResponse:
    method = request.match_info["method"]
    if method not in QUESTIONS:
        return _error(404, "UsageError", f"there is no question {method!r}; there are {', '.join(sorted(QUESTIONS))}")
    if method in COMMANDS and request.query:
        return _error(405, "UsageError", f"{method} with parameters is a command; commands are sent with POST")
    if method == "map":
        return _picture(await request.app[DESK].picture(_query(request)))
    asked = ("preset", {"action": "list"}) if method == "presets" else (method, _query(request))
    answer = await request.app[DESK].question(*asked)
    if method == "metrics":
        return web.Response(text=answer["text"], content_type="text/plain")
    return web.json_response(answer)


def _query(request: web.Request) -> dict[str, Any]:
    try:
        return {key: int(value) if key in NUMBERS else value for key, value in request.query.items()}
    except ValueError:
        raise web.HTTPBadRequest(text=f"{', '.join(sorted(NUMBERS))} are whole numbers") from None


def _picture(answer: dict[str, Any]) -> web.Response:
    """Send the picture as a file of its kind; what belongs to it goes into one header."""
    image = base64.b64decode(answer.pop("image"), validate=True)
    kind = PICTURE_TYPES.get(answer["format"], "application/octet-stream")
    return web.Response(body=image, content_type=kind, headers={"X-Elpd-Picture": json.dumps(answer)})


async def _events(request: web.Request) -> web.StreamResponse:
    """Stream to one tab: many small events go out together, thirty times a second at most."""
    relay, streams = request.app[RELAY], request.app[STREAMS]
    if relay.tabs >= MAX_TABS:
        return _error(503, "Busy", f"{MAX_TABS} pages are open already; close some")
    response = web.StreamResponse(headers={"Content-Type": "text/event-stream", "X-Accel-Buffering": "no"})
    tab = relay.join(request.headers.get("Last-Event-ID"))
    task = asyncio.current_task()
    assert task is not None
    streams.add(task)
    try:
        await response.prepare(request)
        while True:
            try:
                async with asyncio.timeout(STILL_HERE_S):
                    batch = await tab.batch()
            except TimeoutError:
                batch = b": still here\n\n"
            async with asyncio.timeout(STALLED_S):
                await response.write(batch)
            await asyncio.sleep(BATCH_EVERY_S)
    except TimeoutError:
        if request.transport is not None:
            request.transport.abort()  # whatever is said to it would wait behind what it has not taken
        return response
    except (ConnectionError, asyncio.CancelledError):  # the tab was closed, or the gateway is
        return response
    finally:
        relay.leave(tab)
        streams.discard(task)


async def _relaying(app: web.Application) -> AsyncIterator[None]:
    task = asyncio.create_task(app[RELAY].run())
    yield
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    await app[DESK].close()


async def _end_streams(app: web.Application) -> None:
    for task in app[STREAMS]:
        task.cancel()


def _error(status: int, kind: str, message: str) -> web.Response:
    return web.json_response({"error": {"kind": kind, "message": message}}, status=status)
