"""A capture process seen from the controller: its start, its messages, its end, none of which may take long.

Whatever ends the child, this side knows at once: the last copy of the other end of the socket is closed with it. A
child that hangs is killed: what it held, the kernel gives back. One that says itself that its camera is lost goes on to
give it back, because a camera that is left in the middle of an answer gives that answer to whoever opens it next; it is
not waited for here, but before the camera is opened again.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elpd.errors import CameraError, ConfigError, UsageError
from elpd_drivers.cameras.ring import RingMemory, RingReader
from elpd_drivers.cameras.source import SourceFacts

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

CHILD = "elpd_drivers.cameras.capture_child"
SLOTS = 4096
MESSAGE_BYTES = 1 << 17
SECOND_LOOK_MS = 5
"""A machine that stood still stops both processes: the child gets this long to show itself before it counts as hung."""

STARVED_MS = 1000.0
"""A child that would run if it were let is not hung but starved, by a machine that is too busy: it gets this long."""

CALL_S = 3.0
"""Bias and window changes are a few register writes over USB, some milliseconds each; a busy machine adds to that."""

END_S = 3.0
"""A camera that is given back stops its sensor first; an EVK4 sleeps through a second of that."""

KILLED_S = 0.5
TAIL_BYTES = 4000
WORDS = 200


class CaptureProcess:
    """A running child with its ring.

    Parameters
    ----------
    backend
        ``module:function`` that makes the ``Source``.
    settings
        What it is made with: plain data.
    ring_mb
        Memory for packets that wait.
    open_timeout_s
        How long opening may take.
    hang_ms
        A child that has not turned its loop for so long, and does not wait for a processor either, hangs.
    """

    def __init__(
        self, backend: str, settings: Mapping[str, Any], *, ring_mb: float, open_timeout_s: float, hang_ms: float
    ) -> None:
        self._open_timeout_s, self._hang_ms = open_timeout_s, hang_ms
        self._memory, memory = RingMemory.make(SLOTS, round(ring_mb * (1 << 20)))
        self._semaphore = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK | os.EFD_SEMAPHORE)
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        said, say = os.pipe()
        os.set_blocking(said, False)
        os.set_blocking(say, False)  # a library that says more than anybody reads loses words, not events
        try:
            self._child = subprocess.Popen(  # noqa: S603  (this interpreter, our own module)
                [
                    *(sys.executable, "-X", "faulthandler", "-m", CHILD, str(theirs.fileno()), str(memory)),
                    *(str(self._semaphore), str(SLOTS), str(self._memory.capacity)),
                ],
                stdin=subprocess.DEVNULL,
                stdout=say,
                stderr=say,
                pass_fds=(theirs.fileno(), memory, self._semaphore),
            )
        finally:
            theirs.close()
            os.close(memory)
            os.close(say)
        self._said, self._tail = said, b""
        self.reader = RingReader(self._memory, self._semaphore)
        self.facts: SourceFacts | None = None
        self._opened = time.monotonic()
        self._calls = 0
        self._reply: dict[str, Any] | None = None
        self._notes: dict[str, float] = {}
        self._closed, self._told_to_go = False, 0.0
        self._poll = select.poll()
        for descriptor in (self._semaphore, self._control.fileno(), self._said):
            self._poll.register(descriptor, select.POLLIN)
        self._tell(
            {
                "backend": backend,
                "settings": dict(settings),
                "path": sys.path,
                "open_timeout_s": open_timeout_s,
            }
        )

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._child.pid

    def wait(self, timeout_ms: float) -> None:
        """Wait for a packet or a message, and take in what was said. Raises ``CameraError`` if the child is lost."""
        for descriptor, _ in self._poll.poll(max(0.0, timeout_ms)):
            if descriptor == self._control.fileno():
                self._take_message()
            elif descriptor == self._said:
                self._listen()

    def check(self) -> None:
        """Raise ``CameraError`` if the child hangs, or takes too long to open."""
        if self.facts is None:
            opening_s = time.monotonic() - self._opened
            if opening_s > self._open_timeout_s:
                self._lose(
                    f"camera: not open after {opening_s:.1f} s (limit {self._open_timeout_s:g}); unplug it and plug it "
                    "in again, or raise camera.open_timeout_s"
                )
            return
        if self._silent_ms() > self._hang_ms:
            self.wait(SECOND_LOOK_MS)
            limit_ms = max(self._hang_ms, STARVED_MS) if self._would_run() else self._hang_ms
            silent_ms = self._silent_ms()
            if silent_ms > limit_ms:
                self._lose(
                    f"camera: its library hangs, nothing for {silent_ms:.0f} ms (limit {limit_ms:.0f}); "
                    "unplug it and plug it in again"
                )

    def wait_ready(self) -> SourceFacts:
        """Wait until the camera is open.

        Raises ``CameraError`` if it cannot be or takes too long, ``ConfigError`` if its table is wrong for it.
        """
        while self.facts is None:
            left_s = self._opened + self._open_timeout_s - time.monotonic()
            self.wait(1e3 * max(0.0, left_s) + 1)
            self.check()
        return self.facts

    def call(self, name: str, arguments: Sequence[Any] = ()) -> Any:
        """Ask the camera for something and wait for the answer, while packets gather in the ring.

        Raises ``UsageError`` with the camera's own words if it cannot, ``CameraError`` if it is lost.
        """
        self._calls += 1
        self._reply = None
        self._tell({"id": self._calls, "name": name, "arguments": list(arguments)})
        control = select.poll()
        control.register(self._control, select.POLLIN)
        until = time.monotonic() + CALL_S
        while self._reply is None:
            left_s = until - time.monotonic()
            if left_s <= 0:
                self._lose(f"camera: no answer to {name} within {CALL_S:g} s; unplug it and plug it in again")
            if control.poll(1e3 * left_s):
                self._take_message()
        if "error" in self._reply:
            raise UsageError(self._reply["error"])
        return self._reply["value"]

    def notes(self) -> dict[str, float]:
        """Return the camera library's counters, after the end as they were last. Never waits."""
        return self._notes if self._closed else self.reader.notes()

    @property
    def ended(self) -> bool:
        """Whether the child is gone; one that was told to go and stays too long is killed when this is asked."""
        if self._child.poll() is None and self._closed and time.monotonic() > self._told_to_go + END_S:
            self._child.kill()
        return self._child.poll() is not None

    def close(self) -> None:
        """End the child, gently first. Idempotent. No process, memory or descriptor is left."""
        self._release()
        for then in (signal.SIGTERM, signal.SIGKILL):
            if self._waited(END_S if then == signal.SIGTERM else KILLED_S):
                return
            self._child.send_signal(then)
        self._waited(KILLED_S)

    def kill(self) -> None:
        """End the child at once. Idempotent. No process, memory or descriptor is left."""
        self._child.kill()
        self._release()
        self._waited(KILLED_S)

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _take_message(self) -> None:
        try:
            message = self._control.recv(MESSAGE_BYTES, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except ConnectionError:
            message = b""
        if not message:
            self._lose(f"camera: its process {self._how_ended()}; start it again")
        content: dict[str, Any] = json.loads(message)
        if "lost" in content:
            self._release()
            raise (ConfigError if content.get("kind") == ConfigError.__name__ else CameraError)(content["lost"])
        if "ready" in content:
            self.facts = SourceFacts.from_data(content["ready"])
        else:
            self._reply = content if content["reply"] == self._calls else None

    def _tell(self, message: dict[str, Any]) -> None:
        try:
            self._control.send(json.dumps(message).encode())
        except OSError:
            self._take_message()  # what it said last is the better reason
            self._lose(f"camera: its process {self._how_ended()}; start it again")

    def _lose(self, reason: str) -> None:
        self.kill()
        raise CameraError(reason)

    def _how_ended(self) -> str:
        if not self._waited(KILLED_S):
            return "closed its line"
        self._listen()
        status = self._child.returncode
        how = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        words = _last_words(self._tail.decode(errors="replace"))
        return f"{how} ({words})" if words else how

    def _silent_ms(self) -> float:
        return (time.monotonic_ns() - self.reader.heartbeat_ns) / 1e6

    def _would_run(self) -> bool:
        """Say whether any of the child's threads runs, or waits for a processor or for its memory.

        A library's call may wait for a thread of the library's own, which is only starved.
        """
        with suppress(OSError):
            for thread in Path(f"/proc/{self.pid}/task").iterdir():
                stat = (thread / "stat").read_text(encoding="ascii", errors="replace")
                if stat.rpartition(")")[2].split()[0] in {"R", "D"}:
                    return True
        return False

    def _listen(self) -> None:
        """Keep the end of what the library prints."""
        with suppress(BlockingIOError):
            while words := os.read(self._said, 1 << 16):
                self._tail = (self._tail + words)[-TAIL_BYTES:]
            with suppress(KeyError):
                self._poll.unregister(self._said)  # closed: it would be readable for ever

    def _waited(self, patience_s: float) -> bool:
        with suppress(subprocess.TimeoutExpired):
            self._child.wait(patience_s)
        return self._child.returncode is not None

    def _release(self) -> None:
        """Give everything but the child back; that its line closes tells it to end."""
        if self._closed:
            return
        self._notes = self.reader.notes()
        self._closed, self._told_to_go = True, time.monotonic()
        self._control.close()
        os.close(self._said)
        os.close(self._semaphore)
        self._memory.close()


def _last_words(printed: str) -> str:
    """Return what a process printed before it ended, as part of a sentence: of a traceback, where it was."""
    before, fatal, traceback = printed.partition("Fatal Python error: ")
    said = " ".join(before.split())[-WORDS:]
    if not fatal:
        return said
    place = next((line.strip() for line in traceback.splitlines() if line.startswith("  File ")), "")
    return f"{said} {traceback.splitlines()[0]}, in {place}".strip()
