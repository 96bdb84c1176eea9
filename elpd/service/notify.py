"""What systemd is told: ready, reloading, alive, stopping. Ten lines instead of a dependency.

(``sd_notify(3)``: one datagram of ``KEY=VALUE`` lines to the socket that ``NOTIFY_SOCKET`` names; ``@`` stands for the
abstract namespace.) Without that variable nothing is sent.
"""

from __future__ import annotations

import os
import socket
import time
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


class Notifier:
    """Tells the supervisor of this process.

    Parameters
    ----------
    environ
        The process's environment.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        self._address = environ.get("NOTIFY_SOCKET", "")
        meant_for_us = environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(environ.get("WATCHDOG_USEC", "0")) / 1e6 if meant_for_us else 0.0
        """How often ``alive`` must be said at the least; 0 where nobody listens for it."""

    def tell(self, **what: str) -> None:
        """Send ``KEY=VALUE`` lines; a supervisor that is not there is no error."""
        if not self._address:
            return
        lines = "\n".join(f"{key.upper()}={value}" for key, value in what.items())
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out, suppress(OSError):
            out.setblocking(False)
            out.sendto(lines.encode("utf-8"), address)

    def ready(self, status: str) -> None:
        """Say that requests are taken."""
        self.tell(ready="1", status=status)

    def reloading(self) -> None:
        """Say that another configuration is being taken; ``ready`` ends it."""
        self.tell(reloading="1", monotonic_usec=str(time.monotonic_ns() // 1000))

    def alive(self) -> None:
        """Feed the watchdog."""
        self.tell(watchdog="1")

    def stopping(self) -> None:
        """Say that this is the end."""
        self.tell(stopping="1")
