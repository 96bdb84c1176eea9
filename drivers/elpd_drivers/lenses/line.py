"""A driver's end of its line: one write per command, when its bytes have left, and a memory for what broke.

A line that failed once is not tried again until somebody opens it anew. What must stop the motor and be remembered is
raised as ``Trouble``, wherever a driver finds out; the one place that can act on it (``stopping_on_trouble``) sends
the strongest stop there is, latches the fault, and makes it the ``LensError`` that the caller sees.
"""

from __future__ import annotations

import threading
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

from elpd.errors import LensError
from elpd.units import NS_PER_S, HostNs
from elpd_drivers.lenses.axis import ADAPTER_LATENCY_SIGMA_US, ADAPTER_LATENCY_US, read_settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import Any

    from elpd.ports import BytePort, Clock


class Trouble(Exception):  # noqa: N818  (not an error yet: the words of one, for whoever can stop the motor)
    """What went wrong, so that the motor must be stopped and the fault remembered."""


@dataclass(frozen=True, slots=True)
class Sent:
    """One write: when it was handed over, and when its last bit has left the wire."""

    begun_ns: HostNs
    done_ns: HostNs
    off_wire_ns: int


class Line:
    """A ``BytePort`` with a clock beside it.

    Parameters
    ----------
    port
        The bytes' way; closed with the line.
    clock
        What writes are timed by.
    baud
        Bits per second, ten of them a byte. A USB line that ignores it is faster, never slower.
    name
        What messages call the port; empty for one in memory.
    """

    def __init__(self, port: BytePort, clock: Clock, baud: int, name: str = "") -> None:
        self.name = name or "(in memory)"
        self.byte_ns = 10 * NS_PER_S // baud
        self._port, self._clock = port, clock
        self.since_ns = self.by_ns = HostNs(0)
        """Between which instants came what ``read`` returned last: the look before it, and its own end."""
        self.looked_ns = HostNs(0)
        """When ``read`` last looked: what is not in it by then had not come. Patience is measured with this."""
        self._fault: str | None = None
        self._free_ns = 0
        self._lock = threading.Lock()

    def send(self, data: bytes) -> Sent:
        """Write *data* at once, behind nothing, from any thread; the books are kept afterwards."""
        begun = self._clock.now_ns()
        try:
            self._port.write(data)
        except LensError as error:
            self._latch(str(error))
            raise
        done = self._clock.now_ns()
        with self._lock:
            self._free_ns = max(self._free_ns, begun) + len(data) * self.byte_ns
            return Sent(begun, done, self._free_ns)

    def read(self) -> bytes:
        """Return what has come, and note between which instants.

        A thread can be put aside between a look at the port and a look at the clock, for as long as a busy machine
        likes. So the clock is read on both sides of the port: before it for what the next look will find, after it for
        what this one did.
        """
        looked = self._clock.now_ns()
        try:
            data = self._port.read_available()
        except LensError as error:
            self._latch(str(error))
            raise
        self.since_ns, self.by_ns, self.looked_ns = self.looked_ns, self._clock.now_ns(), looked
        return data

    def close(self) -> None:
        """Give the port back. Idempotent."""
        self._port.close()

    def check(self) -> None:
        """Raise the latched fault, if there is one."""
        if self._fault is not None:
            raise LensError(self._fault)

    @contextmanager
    def stopping_on_trouble(self, strongest: Callable[[], bytes], name: str) -> Iterator[None]:
        """Turn ``Trouble`` into a latched ``LensError``, behind the *strongest* stop there is (called *name*)."""
        self.check()
        try:
            yield
        except Trouble as trouble:
            what = str(trouble)
            try:
                self._port.write(strongest())
            except LensError as error:
                what = f"{what} (and the {name} could not be written: {error})"
            self._latch(f"lens: {what}")
            raise LensError(self._fault) from None

    def _latch(self, fault: str) -> None:
        self._fault = self._fault or fault


class PortSettings(Protocol):
    """What the settings of every driver on a serial port have."""

    @property
    def port(self) -> str:
        """The path of the serial port."""
        ...

    @property
    def baud(self) -> int:
        """Bits per second."""
        ...


class Connecting(Protocol):
    """A lens that is not yet."""

    def connect(self) -> None:
        """Identify the controller and make it ready."""
        ...


S = TypeVar("S", bound=PortSettings)
L = TypeVar("L", bound=Connecting)


def open_on_line(
    kind: type[S],
    settings: Mapping[str, Any],
    clock: Clock,
    port: BytePort | None,
    build: Callable[[S, Line], L],
) -> L:
    """Read a driver's settings, open its port exclusively (unless given one), build the lens and connect it.

    A real port gets the latency that USB adapters need, unless the table says how long its own is. Raises
    ``ConfigError`` for a wrong table; whatever else goes wrong, the port is given back first.
    """
    table = read_settings(kind, settings, "lens")
    if port is None:
        from elpd_drivers.lenses.serial_port import SerialPort  # noqa: PLC0415  (needs pyserial, in-memory use does not)

        port = SerialPort(table.port, table.baud)
        if "latency_us" not in settings:
            adapter = {"latency_us": ADAPTER_LATENCY_US, "latency_sigma_us": ADAPTER_LATENCY_SIGMA_US}
            table = replace(table, **adapter)  # type: ignore[type-var]
    try:
        lens = build(table, Line(port, clock, table.baud, table.port))
        lens.connect()
    except BaseException:
        port.close()
        raise
    return lens
