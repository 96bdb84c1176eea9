"""The page's files: read once, listed by name, sent as they are.

What is not in the list does not exist, so there is no path to escape from. Text is compressed beforehand; a browser
that has a file asks with its tag and gets 304.
"""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING

from aiohttp import web

if TYPE_CHECKING:
    from collections.abc import Iterator
    from importlib.resources.abc import Traversable

TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
    ".LICENSE": "text/plain",
    ".webmanifest": "application/manifest+json",
}
"""Suffixes that are sent; others (such as package.json, for node's tests) stay here."""


@dataclass(frozen=True, slots=True)
class Page:
    """One file in both forms."""

    content_type: str
    plain: bytes
    compressed: bytes
    tag: str


def read_pages() -> dict[str, Page]:
    """Return every file of the page by its path; ``/`` is the index."""
    pages = {f"/{name}": _page(name, file.read_bytes()) for name, file in _walk(files("elpd.web") / "static")}
    pages["/"] = pages.pop("/index.html")
    return pages


def answer(page: Page, request: web.Request) -> web.Response:
    """Return the file, or 304 if the browser has it."""
    headers = {"ETag": f'"{page.tag}"', "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    if page.tag in {tag.value for tag in request.if_none_match or ()}:
        return web.Response(status=304, headers=headers)
    body = page.plain
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        body, headers["Content-Encoding"] = page.compressed, "gzip"
    return web.Response(body=body, content_type=page.content_type, charset="utf-8", headers=headers)


def _page(name: str, content: bytes) -> Page:
    kind = TYPES["." + name.rsplit(".", 1)[1]]
    return Page(kind, content, gzip.compress(content, mtime=0), hashlib.sha3_224(content).hexdigest()[:20])


def _walk(folder: Traversable, before: str = "") -> Iterator[tuple[str, Traversable]]:
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.is_dir():
            yield from _walk(entry, f"{before}{entry.name}/")
        elif any(entry.name.endswith(suffix) for suffix in TYPES):
            yield before + entry.name, entry
