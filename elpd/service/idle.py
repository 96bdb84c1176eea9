"""Between requests: where the lens is, whether the camera lives, and what it sees.

A lens at rest is asked where it is all the same, for a cable that was pulled should be known of before somebody asks
for focus, and some boards switch their motor off when nobody asks. The camera is listened to all the time, or for a
moment now and then where listening costs (``service.look_every_s``). What it says is decoded where that is of use:
while continuous mode weighs it or somebody looks at its pictures; else a tenth of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import CameraError, LensError
from elpd.records import Geometry, LensFlag
from elpd.service.gathering import Gathering

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.config import ServiceSection
    from elpd.events.decoder import EventArrays
    from elpd.ports import RigParts
    from elpd.records import Frame, LensReport
    from elpd.service.situation import Situation
    from elpd.service.timing import Time

LISTEN_TURN_S = 0.02
"""One turn of listening: packets gather meanwhile, since waking for each costs more than what it holds. No camera's
buffers fill in that time, and a request ends the wait."""

TOLD_EVERY_S = 0.1
"""So often what has gathered is decoded and passed on."""

MOST_GATHERED_BYTES = 1 << 18
"""Or sooner, where a scene is busy: this is some milliseconds of work, which a request may have to wait for."""

MOST_PACKETS_A_TURN = 256
"""More than a camera sends in a turn; one that floods must not keep a request waiting."""

POLL_TURN_S = 0.002
FIRST_REPORT_S = 1.0
"""A controller that has just been identified tells where it is within this time."""

GLANCE_EVERY_S = 1.0
"""Where nobody watches, one look in so much time is attentive; the others are for silence and losses."""

SILENCE_S = 1.0
"""While nothing moves a camera may say nothing for so long before it counts as lost."""

FRAMES_WITHIN_S = 0.5
"""A camera that has delivered no frame in so much listening has none."""


class Idle:
    """What the focus thread does between requests.

    Parameters
    ----------
    situation, time
        What is told, and by which time.
    settings
        How often to look.
    hear
        Takes a turn's newest frame, if there was one, and its events; for pictures and evidence.
    """

    def __init__(
        self,
        situation: Situation,
        time: Time,
        settings: ServiceSection,
        hear: Callable[[Frame | None, EventArrays], None],
    ) -> None:
        self._situation = situation
        self._time = time
        self._settings = settings
        self._hear = hear
        self._geometry = Geometry(1, 1)
        self._gathering = Gathering(self._geometry)
        self._frame: Frame | None = None
        self._lost = self._backlog = 0
        self._told_s = float("-inf")
        self._look_begun_s: float | None = None
        self._look_ended_s = float("-inf")
        self._last_packet_s = 0.0
        self._events = 0
        self._listened_s = 0.0
        self._polled_s = float("-inf")
        self._attentive = True
        self._attended_s = float("-inf")
        self.every_s = 0.0
        """How often to listen; 0 is all the time."""
        self.somebody_watches = True
        """Whether all that is heard matters; else it is mostly only looked whether something comes."""

    def reconfigure(self, settings: ServiceSection) -> None:
        """Take other settings."""
        self._settings = settings

    @property
    def looking(self) -> bool:
        """Whether the camera delivers."""
        return self._look_begun_s is not None

    def opened(self, parts: RigParts) -> None:
        """Begin with a rig that was just opened."""
        geometry = parts.camera.geometry
        self._geometry, self._gathering = geometry, Gathering(geometry)
        self._attended_s = float("-inf")
        self._look_begun_s, self._look_ended_s, self._polled_s = None, float("-inf"), float("-inf")
        limits = parts.lens.limits
        self._situation.update_camera(width=geometry.width, height=geometry.height, connected=True)
        self._situation.update_lens(
            connected=True, limits_um=(parts.scale.to_um(limits.min_steps), parts.scale.to_um(limits.max_steps))
        )

    def meet(self, parts: RigParts, *, needs_home: bool) -> None:
        """Hear once where the lens is, before requests are taken. Raises ``LensError`` if it does not say."""
        until_s = self._time.now_s() + FIRST_REPORT_S
        while (report := parts.lens.poll()) is None:
            if self._time.now_s() > until_s:
                raise LensError(f"lens: no report within {FIRST_REPORT_S:g} s of connecting; check its cable")
            self._time.nap(POLL_TURN_S)
        self.tell_lens(parts, report, needs_home=needs_home)

    def turn(self, parts: RigParts, *, needs_home: bool) -> None:
        """Do one turn: a few milliseconds of listening or napping, the lens asked once.

        Raises ``CameraError`` or ``LensError`` when one of them is lost.
        """
        now_s = self._time.now_s()
        if now_s - self._polled_s >= 1e-3 * self._settings.poll_ms:
            self._polled_s = now_s
            self.tell_lens(parts, parts.lens.poll(), needs_home=needs_home)
        if self._look_begun_s is None and now_s - self._look_ended_s >= self.every_s:
            self._begin_look(parts, now_s)
        if self._look_begun_s is None:
            left_s = self._look_ended_s + self.every_s - now_s
            self._time.nap(max(1e-4, min(1e-3 * self._settings.poll_ms, left_s)))
            return
        self._listen(parts)
        if self._time.now_s() - self._look_begun_s >= self._settings.look_s:
            self._end_look(parts)

    def leave(self, parts: RigParts) -> None:
        """Stop listening: a cycle needs the camera for itself."""
        if self._look_begun_s is not None:
            self._tell(self._time.now_s())
            self._look_begun_s = None
            parts.camera.stop()
        self._look_ended_s = self._time.now_s()

    def tell_lens(self, parts: RigParts, report: LensReport | None, *, needs_home: bool) -> None:
        """Tell where the lens is; what no report says stays as it was."""
        if report is not None:
            referenced = LensFlag.REFERENCED in report.flags and not needs_home
            self._situation.update_lens(moving=report.moving, referenced=referenced)
        try:
            here = parts.lens.position_at(parts.clock.now_ns())
        except LensError:
            self._situation.update_lens(position_um=None, sigma_um=None)
            return
        per_step_um = abs(parts.scale.to_um(here.steps + 1) - parts.scale.to_um(here.steps))
        self._situation.update_lens(position_um=parts.scale.to_um(here.steps), sigma_um=here.sigma_steps * per_step_um)

    def _begin_look(self, parts: RigParts, now_s: float) -> None:
        parts.camera.start()
        self._gathering = Gathering(self._geometry)
        self._last_packet_s = now_s
        self._attend(now_s)

    def _attend(self, now_s: float) -> None:
        """Begin a look; where nobody watches, one in a while is enough to tell what the camera sees."""
        self._look_begun_s, self._events = now_s, 0
        attentive = self.somebody_watches or now_s - self._attended_s >= GLANCE_EVERY_S
        if attentive and not self._attentive:
            self._gathering = Gathering(self._geometry)  # what it knew of time and place is old
        self._attentive = attentive
        if attentive:
            self._attended_s = now_s

    def _end_look(self, parts: RigParts) -> None:
        now_s, begun_s = self._time.now_s(), self._look_begun_s
        self._tell(now_s)
        assert begun_s is not None, "a look ends after it began"
        if self._attentive:
            self._listened_s += now_s - begun_s
            rate = self._events / max(1e-6, now_s - begun_s)
            none = not self._situation.camera.has_frames and self._listened_s >= FRAMES_WITHIN_S
            self._situation.update_camera(events_per_s=rate, **({"has_frames": False} if none else {}))
        if self.every_s > 0:
            self.leave(parts)
        else:
            self._attend(now_s)

    def _listen(self, parts: RigParts) -> None:
        """Take what has come in a turn."""
        self._time.nap(LISTEN_TURN_S)
        came = False
        for _ in range(MOST_PACKETS_A_TURN):
            packet = parts.camera.read(0.0)
            if packet is None:
                break
            came, self._lost, self._backlog = True, self._lost + packet.lost_events, packet.backlog
            if self._attentive:
                self._gathering.add(packet)
                self._frame = packet.frames[-1] if packet.frames else self._frame
        now_s = self._time.now_s()
        if came:
            self._last_packet_s = now_s
        if now_s - self._told_s >= TOLD_EVERY_S or self._gathering.size_bytes > MOST_GATHERED_BYTES:
            self._tell(now_s)
        silent_s = now_s - self._last_packet_s
        if silent_s > SILENCE_S:
            raise CameraError(
                f"camera: no data for {silent_s:.1f} s (limit {SILENCE_S:g}) while nothing moved; check its cable "
                "and power, then clear the fault"
            )

    def _tell(self, now_s: float) -> None:
        """Decode what has gathered, and pass it on."""
        self._told_s = now_s
        heard, events = self._gathering.take(), 0
        frame, self._frame = self._frame, None
        lost, self._lost = self._lost, 0
        if heard is not None:
            events = int(heard.t.size)
            self._events += events
            self._hear(frame, heard)
        if self._attentive or lost:
            known = {"has_frames": True} if frame is not None else {}
            self._situation.heard(events, lost, backlog=self._backlog, **known)
