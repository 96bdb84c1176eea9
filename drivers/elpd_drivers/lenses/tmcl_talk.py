"""Talking to a TMCL module: one command, one reply, and finding out which module it is.

The reply says which command it belongs to, but not which parameter; so nothing else is sent before it has come. Stops
are the exception: they leave from any thread, and how many acknowledgements are still due is counted here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from elpd.errors import LensError
from elpd.units import after_ms
from elpd_drivers.lenses import tmcl_wire as wire
from elpd_drivers.lenses.line import Trouble

if TYPE_CHECKING:
    from elpd.ports import Clock
    from elpd_drivers.lenses.line import Line

IDENTIFICATIONS = 3
LOOK_MS = 0.25


@dataclass(frozen=True, slots=True)
class TmclSettings:
    """The table ``[lens]`` for a TMCL module.

    ``address`` is the module's, ``host`` the one that it replies to, ``motor`` the axis. ``module`` is needed only for
    a module that this driver does not know by number. With ``iris_axis`` another of its motors turns a stepper iris,
    which is the output "iris" then: between ``iris_closed`` (its closed stop) and ``iris_open``, microsteps, at
    ``iris_speed_sps``. ``home_um_s`` and ``switch_um_s`` are the speeds of the search
    for the left switch and of leaving it. ``latency_us`` is the usual time from a command's last bit to its effect,
    adapter included, and ``latency_sigma_us`` how well that is known; unless given, a real port gets what USB needs.
    """

    port: str = ""
    baud: int = 115_200
    address: int = 1
    host: int = 2
    motor: int = 0
    module: int = 0
    um_per_step: float = 0.3125
    min_um: float = 0.0
    max_um: float = 2500.0
    max_speed_um_s: float = 12_000.0
    acceleration_um_s2: float = 200_000.0
    home_um_s: float = 1000.0
    switch_um_s: float = 125.0
    query_ms: float = 5.0
    reply_ms: float = 100.0
    latency_us: float = 250.0
    latency_sigma_us: float = 87.0
    iris_axis: int | None = None
    iris_closed: int = 0
    iris_open: int = 0
    iris_speed_sps: float = 0.0


class Talk:
    """Commands to one axis of one module.

    Parameters
    ----------
    settings
        Addresses and patience.
    clock
        What waiting is timed by.
    line
        The way to the module.
    """

    def __init__(self, settings: TmclSettings, clock: Clock, line: Line) -> None:
        self.settings, self.clock, self.line = settings, clock, line
        self.stops_open = 0
        self._replies = wire.Replies(settings.address, settings.host)

    def frame(self, command: int, kind: int = 0, value: int = 0, *, motor: int | None = None) -> bytes:
        """Return a command's bytes; *motor* is the bank for global parameters."""
        settings = self.settings
        return wire.request(settings.address, command, kind, settings.motor if motor is None else motor, value)

    def replies(self) -> list[tuple[wire.Reply, int]]:
        """Return the replies that have come, each with the number of bytes behind it."""
        return self._replies.feed(self.line.read())

    def heed(self, reply: wire.Reply) -> None:
        """Count a stop's acknowledgement; anything else is late or a duplicate."""
        if reply.command == wire.MST and self.stops_open > 0:
            self.stops_open -= 1

    def exchange(self, command: int, kind: int = 0, value: int = 0, *, motor: int | None = None) -> int:
        """Send a command, wait for its reply, and return its value. Raises ``Trouble`` if it is refused or lost."""
        reply = self.attempt(command, kind, value, motor=motor)
        if reply.status != wire.OK:
            raise refusal(reply, f"type {kind}, value {value}: compare the module's axis parameters with the config")
        return reply.value

    def attempt(self, command: int, kind: int = 0, value: int = 0, *, motor: int | None = None) -> wire.Reply:
        """Send a command and return its reply, whatever it says. Raises ``Trouble`` if it is lost."""
        self.line.send(self.frame(command, kind, value, motor=motor))
        return self._answer(command)

    def confirm(self, command: int) -> None:
        """Wait for the reply to what was sent already. Raises ``Trouble`` if it is refused or lost."""
        reply = self._answer(command)
        if reply.status != wire.OK:
            raise refusal(reply, "home it again")

    def _answer(self, command: int) -> wire.Reply:
        due = after_ms(self.clock.now_ns(), self.settings.reply_ms)
        while True:
            for reply, _ in self.replies():
                if reply.command == command:
                    return reply
                self.heed(reply)
            if self.line.looked_ns >= due:
                raise Trouble(
                    f"no reply to command {command} for {self.settings.reply_ms:.0f} ms; check the cable, or raise "
                    "lens.reply_ms"
                )
            self.clock.sleep_until(after_ms(self.clock.now_ns(), LOOK_MS))


def refusal(reply: wire.Reply, next_step: str) -> Trouble:
    """Return what to raise for a reply with another status than 100."""
    words = wire.STATUS_WORDS.get(reply.status, "unknown")
    return Trouble(f"the module refused command {reply.command} with status {reply.status} ({words}); {next_step}")


def identify(talk: Talk) -> None:
    """See that a TMCL stepper module answers; what another session had asked for may arrive first."""
    settings, clock, line = talk.settings, talk.clock, talk.line
    known, seen = wire.STEPPER_MODULES | {settings.module}, b""
    for _ in range(IDENTIFICATIONS):
        line.read()
        line.send(talk.frame(wire.GET_VERSION))
        due, seen = after_ms(clock.now_ns(), settings.reply_ms), b""
        firmware = None
        while firmware is None and line.looked_ns < due:
            seen += line.read()
            firmware = wire.parse_version(seen, settings.host)
            clock.sleep_until(after_ms(clock.now_ns(), LOOK_MS))
        if firmware is None:
            continue
        if firmware.module in known:
            return
        raise LensError(
            f"lens port {line.name}: module {firmware.module} with firmware {firmware.version} answered, which is not "
            f"known as a stepper module; if it is one, set lens.module = {firmware.module}"
        )
    raise LensError(
        f"lens port {line.name}: no answer from a TMCL module within {settings.reply_ms:.0f} ms (received "
        f"{seen[:40]!r}); check power, cable, baud ({settings.baud}), lens.address ({settings.address}) and lens.host "
        f"({settings.host})"
    )


def learn_units(talk: Talk, motor: int | None = None) -> wire.Units:
    """Ask for the divisors of a motor's TMC429; modules without them count in pulses per second."""
    pulse = talk.attempt(wire.GAP, wire.PULSE_DIVISOR, motor=motor)
    if pulse.status != wire.OK:
        return wire.Units()
    return wire.Units(pulse.value, talk.exchange(wire.GAP, wire.RAMP_DIVISOR, motor=motor))
