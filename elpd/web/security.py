"""Who may ask: a pure judgement over a request's head, and the headers of every answer.

A browser on the rig's own machine is the enemy's tool: any page it shows can send requests to the loopback. So the
host that was asked for must be one of ours, exactly (DNS rebinding), no foreign page may be behind the request (its
``Origin`` or ``Sec-Fetch-Site``), the token must be there (other users of the machine), and whatever changes something
must be a POST with JSON and a header that no form can send. Each has its own status, so that a wrong set-up can be
told from an attack.
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from multidict import CIMultiDictProxy

PROTECTED = "/api/"
CUSTOM_HEADER = "X-Elpd"

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",  # for browsers that do not know frame-ancestors
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=(), usb=(), serial=()",
}


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is not answered: an HTTP status and a sentence."""

    status: int
    message: str


@dataclass(frozen=True, slots=True)
class Gate:
    """What is let in: *hosts* as they stand in a ``Host`` header (lower case, port included)."""

    hosts: frozenset[str]
    token: str

    def judge(self, method: str, path: str, headers: CIMultiDictProxy[str]) -> Refusal | None:
        """Return why this request is refused, or ``None``."""
        return (
            self._strange_host(headers) or _foreign_page(self.hosts, headers) or self._stranger(method, path, headers)
        )

    def _strange_host(self, headers: CIMultiDictProxy[str]) -> Refusal | None:
        asked = headers.getall("Host", [])
        if len(asked) == 1 and asked[0].lower() in self.hosts:
            return None
        return Refusal(421, "this is not a host that elpd serves; add it to web.allowed_hosts if it should be")

    def _stranger(self, method: str, path: str, headers: CIMultiDictProxy[str]) -> Refusal | None:
        reading = method in {"GET", "HEAD"}
        if not path.startswith(PROTECTED):
            return None if reading else Refusal(405, "pages can only be read")
        if not self._token_is_right(headers.getall("Authorization", [])):
            return Refusal(401, "the token is missing or wrong; `elpd web --link` prints the address with the token")
        if reading:
            return None
        if method != "POST":
            return Refusal(405, "commands are sent with POST")
        if CUSTOM_HEADER not in headers:
            return Refusal(403, f"a command needs the header {CUSTOM_HEADER}: 1")
        kind = headers.get("Content-Type", "").partition(";")[0].strip().lower()
        return None if kind == "application/json" else Refusal(415, "a command is JSON: Content-Type: application/json")

    def _token_is_right(self, given: Sequence[str]) -> bool:
        """Compare in constant time: bytes, because strings with other letters would raise."""
        if len(given) != 1:
            return False
        scheme, _, token = given[0].partition(" ")
        same = hmac.compare_digest(token.strip().encode("utf-8", "surrogateescape"), self.token.encode("ascii"))
        return same and scheme.lower() == "bearer"


def _foreign_page(hosts: frozenset[str], headers: CIMultiDictProxy[str]) -> Refusal | None:
    """Refuse what another site's page sent. ``same-site`` is another port of the same machine, hence foreign too."""
    ours = {f"{scheme}://{host}" for host in hosts for scheme in ("http", "https")}
    if any(origin.lower() not in ours for origin in headers.getall("Origin", [])):
        return Refusal(403, "the request comes from another page; open elpd's own")
    if any(site not in {"same-origin", "none"} for site in headers.getall("Sec-Fetch-Site", [])):
        return Refusal(403, "the request comes from another site; enter elpd's address by hand")
    return None


def own_hosts(host: str, port: int, allowed: Sequence[str]) -> frozenset[str]:
    """Return the hosts that a gateway on *host* and *port* goes by, beside those *allowed*."""
    names = {"127.0.0.1", "localhost", "[::1]"} if is_loopback(host) else set()
    named = {f"{name}:{port}" for name in names}
    if port == 80:
        named |= names
    return frozenset(named | {name.lower() for name in allowed})


def is_loopback(host: str) -> bool:
    """Say whether only this machine reaches *host*."""
    return host in {"localhost", "::1"} or host.startswith("127.")
