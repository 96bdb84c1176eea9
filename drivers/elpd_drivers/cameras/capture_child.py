"""The capture process: a camera library on one side, the ring on the other, nothing else in between.

Camera libraries block for seconds while they open, and abort the process they live in when their assertions fail. Here
that costs a process which holds nothing: the controller hears of it at once, because the socket between the two closes.
The other way round the same socket ends this process when the controller is gone. A library that hangs is ended by a
watchdog of the interpreter's which needs no lock of its, with a traceback of where it hung.

Run as ``python -m elpd_drivers.cameras.capture_child CONTROL MEMORY SEMAPHORE SLOTS CAPACITY``, the first three
inherited descriptors; the rest comes as the first message.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import resource
import select
import signal
import socket
import sys
import time
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any, NoReturn

from elpd.errors import CameraError, ElpdError
from elpd_drivers.cameras.ring import RingMemory, RingWriter

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from elpd_drivers.cameras.source import Source

READ_S = 0.005
"""One turn of the loop when the camera is silent; the controller's patience is ten of them."""

WATCHDOG_S = 10.0
"""A library that does not return for so long does not mean to."""

NOTES_NS = 100_000_000
BUSY_NS = 2_500_000_000
"""What is asked for may take this long without counting as a hang."""

MESSAGE_BYTES = 1 << 17


class Ended(Exception):  # noqa: N818  (not an error: the controller closed, or asked to end)
    """The controller wants no more."""


def main(arguments: list[str]) -> int:
    """Open the camera that the first message names and serve until told to end. Return the exit status."""
    control_descriptor, memory_descriptor, semaphore, slots, capacity = map(int, arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the controller's to answer
    signal.signal(signal.SIGTERM, _end)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core dump would keep the line open while it is written
    with socket.socket(fileno=control_descriptor) as control:
        hello = json.loads(control.recv(MESSAGE_BYTES))
        sys.path[:] = hello["path"]
        writer = RingWriter(RingMemory(memory_descriptor, slots, capacity), semaphore)
        faulthandler.dump_traceback_later(hello["open_timeout_s"] + WATCHDOG_S, exit=True)
        source = None
        try:
            source = _open(hello["backend"], hello["settings"])
            _serve(source, Control(control), writer)
        except Ended:
            status = 0
        except ElpdError as error:
            _say(control, {"lost": str(error), "kind": error.kind})
            status = 1
        except Exception as error:  # noqa: BLE001  (the root of the process: whatever a library raises is the camera's loss)
            _say(control, {"lost": f"camera: its library failed: {type(error).__name__}: {error}"})
            status = 1
        if source is not None:
            with suppress(Exception):  # giving back what is lost may fail in any way
                source.close()
        return status


class Control:
    """The controller's requests."""

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._poll = select.poll()
        self._poll.register(control, select.POLLIN)

    def say(self, message: dict[str, Any]) -> None:
        """Send a message."""
        _say(self._control, message)

    def request(self) -> dict[str, Any] | None:
        """Return a request that has come, never waiting. Raises ``Ended`` when the controller is gone."""
        if not self._poll.poll(0):
            return None
        message = self._control.recv(MESSAGE_BYTES)
        if not message:
            raise Ended
        request: dict[str, Any] = json.loads(message)
        return request


def _serve(source: Source, control: Control, writer: RingWriter) -> NoReturn:
    generation = 0
    writer.beat(time.monotonic_ns())
    control.say({"ready": source.facts.as_data()})
    gc.collect()
    gc.freeze()
    noted_ns = guarded_ns = 0
    while True:
        now_ns = time.monotonic_ns()
        writer.beat(now_ns)
        if now_ns - guarded_ns > WATCHDOG_S * 1e8:
            faulthandler.dump_traceback_later(WATCHDOG_S, exit=True)
            guarded_ns = now_ns
        if now_ns - noted_ns > NOTES_NS:
            writer.note(
                {
                    **source.notes(),
                    "ring_dropped_packets": writer.dropped_packets,
                    "ring_dropped_events": writer.dropped_events,
                }
            )
            noted_ns = now_ns
        request = control.request()
        if request is not None:
            if request["name"] == "deliver":
                generation = int(request["arguments"][0])
                writer.restart()
            writer.beat(now_ns + BUSY_NS)
            control.say(_answer(source, request))
        packet = source.read(READ_S)
        if packet is not None and generation:
            writer.publish(packet, generation)


def _answer(source: Source, request: dict[str, Any]) -> dict[str, Any]:
    """Do what was asked; what cannot be done is an answer too, a lost camera is not."""
    if request["name"] == "deliver":
        return {"reply": request["id"], "value": None}
    try:
        value = source.call(request["name"], request["arguments"])
    except CameraError:
        raise
    except ElpdError as error:
        return {"reply": request["id"], "error": str(error)}
    return {"reply": request["id"], "value": value}


def _open(backend: str, settings: dict[str, Any]) -> Source:
    module, _, name = backend.partition(":")
    make: Callable[[dict[str, Any]], Source] = getattr(import_module(module), name)
    return make(settings)


def _say(control: socket.socket, message: dict[str, Any]) -> None:
    with suppress(OSError):  # nobody listens any more: the next request says so
        control.send(json.dumps(message).encode())


def _end(_signal: int, _frame: FrameType | None) -> None:
    raise Ended


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
