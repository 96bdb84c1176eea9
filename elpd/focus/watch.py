"""What a sweep's events say, while it runs and after it stopped.

While the lens moves two things are computed. Packets go through the fused kernel into ELP windows and windows into the
sequential detector: that is the direction. And the region's events build their own image, whose sharpness is followed
tick by tick of travel: that is the passing, because scene motion does not change sharpness, while it turns a product
with a stale picture negative. After the stop has been sent the witnesses of ``vision.crossing`` are asked where focus
was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from elpd.events.stream import PacketDecoder
from elpd.focus.frame_track import FrameTrack
from elpd.focus.heading import Heading
from elpd.focus.lamplight import Lamplight, weighed
from elpd.focus.passes import NO_PLAY, Pass, Passes, Play
from elpd.focus.placed import Placed
from elpd.focus.shedding import Shedding
from elpd.records import Direction
from elpd.units import SensorUs
from elpd.vision.crossing import DARK, DARK_OF_MAP, WIDTHS_PER_DEPTH_OF_FOCUS
from elpd.vision.detector import RestingRate
from elpd.vision.elp import ElpWindows
from elpd.vision.memory import BuiltImage, EventMemory
from elpd.vision.meter import TRAVEL_PER_DEPTH_OF_FOCUS
from elpd.vision.resting import Resting
from elpd.vision.saturation import RateWatch

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.records import CameraPacket, ElpSample, FocusEstimate, Frame, Geometry, Roi, SensorProfile
    from elpd.vision.flicker import Flicker
    from elpd.vision.reference import Reference

LOOK_BACK_DOF = 12.0
"""Losses this far back from the decision count against it: the witnesses look no further."""

TICK_DOF = 0.5
"""Travel between two looks at the sharpness of the image that the events build."""

PATIENCE_DOF = 8.0
"""How far beyond a sign change of ELP the image's sharpness may take to agree: a curve's width and a half."""

FAR_DROP = 0.2
"""The lens goes on until log S has fallen so far: pairs that answer late would be missing otherwise, and with them the
late half of the midpoints. Stopping at half of this is 2 ms sooner and costs 0.3 um of bias."""

AFTERMATH_DOF = 2.0
"""Travel beyond the decision whose events still count: pixels with little contrast answer late."""

LATE_DOF = 3.0
"""How late the events' own image is sharpest: its pixels answer 11 to 22 um after a focus 6 um deep (natural scenes).
Too far on the way back costs less than not far enough."""

FOR_EVER = SensorUs(1 << 62)

LAG_UNEXPLAINED_LIVE = 0.3
"""Share of the lag correction that may be wrong where the picture that says which pixels are slow is a temporal map,
taken without saturation, or the newest frame: neither is as blurred as the first frame of a record."""

SLOW_SHARE = 0.2
"""Windows with less than this share of the planned travel say little: the lens starts, stops or turns."""


class Rereference(Protocol):
    """How a newer frame becomes the reference."""

    def __call__(self, frame: Frame, /) -> Reference:
        """Return the weights of *frame* over the region."""
        ...


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """What a watch needs to know of rig and taste."""

    speed_um_s: float
    depth_of_focus_um: float
    play: Play = NO_PLAY
    """Between motor and carriage."""
    frames: bool = False
    """Whether the reference is a frame, whose bright and dark are blurred, and not a temporal map."""


class Watch:
    """Watches one region during a cycle.

    Parameters
    ----------
    reference
        Weights over the whole sensor, zero outside the region.
    roi, geometry
        The region and the sensor.
    settings
        Speed and depth of focus, which set the windows.
    locate
        Lens position in um at a sensor time.
    rereference
        Makes weights of a newer frame, for cameras that have frames.
    sensor
        What a calibration knows of the sensor.
    """

    def __init__(
        self,
        reference: Reference,
        roi: Roi,
        geometry: Geometry,
        settings: WatchSettings,
        locate: Callable[[SensorUs], float],
        rereference: Rereference | None = None,
        sensor: SensorProfile | None = None,
    ) -> None:
        self._reference = reference
        self.roi = roi
        self._geometry = geometry
        self._settings = settings
        self._locate = locate
        self._rereference = rereference
        self._window_us = max(
            20, round(1e6 * TRAVEL_PER_DEPTH_OF_FOCUS * settings.depth_of_focus_um / settings.speed_um_s)
        )
        inside = np.zeros((geometry.height, geometry.width), np.bool_)
        inside[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width] = True
        for x, y in sensor.hot_pixels if sensor is not None else ():
            inside[y, x] = False
        self._inside = inside
        self._sensor = sensor
        self.resting = Resting(roi, geometry)
        """What the sensor says at rest."""
        self.rate = RateWatch()
        """Whether the read-out is full."""
        self.shedding = Shedding(roi)
        """What of a sweep is not looked at when there is too much of it."""
        self._lamp: Lamplight | None = None
        self._windows: ElpWindows | None = None
        self._rest = RestingRate()
        self._heading = Heading(self._rest)
        self._decoder = PacketDecoder(geometry)
        self._memory = EventMemory(roi, geometry, sensor=sensor)
        self._ticked_um = self._here_um = float("nan")
        self._passed = False
        self._gaps_us: list[int] = []
        self._last_us = SensorUs(0)
        self._turned_us = FOR_EVER
        self._placed = Placed(locate)
        self._sign = 1
        self._begun_us = SensorUs(0)
        self._judge_from = float("-inf")
        self._samples: list[ElpSample] = []
        self._passes = Passes()
        self._frames = FrameTrack(self.roi, follow=self.scene_moves)
        self._unheard: list[CameraPacket] = []
        self.decided_us: SensorUs | None = None
        """When the window that decided was complete, on the sensor's clock."""
        self.events = 0
        """Events in the region since this direction of travel began."""
        self.flicker: Flicker | None = None
        """A lamp's flicker that only the sweep has shown."""
        self.depths_um: tuple[float, ...] = ()
        """Where planes of the region are in focus, if the estimate has found several, the first met first."""
        self.events_in_cycle = 0
        """Events in the region since the watch was armed."""
        self.events_back = 0
        """Events in the region on the way back, from ``back_from_us`` on."""
        self.back_from_us = FOR_EVER

    # --- before and during a sweep ---

    def rest(self, packet: CameraPacket) -> None:
        """Learn from a packet of a sensor that sees nothing move."""
        events = self._decoder.feed(packet)
        self.resting.add(events.t, events.x, events.y, events.p, packet.complete_until_us)
        self.resting.see(packet.frames)

    def armed(self) -> None:
        """Close the lesson of the resting sensor: its rate is known, and hot pixels are not listened to any more."""
        self._rest = self.resting.settle(self._reference.weights)
        self._inside &= ~self.resting.hot

    def under_a_lamp(self, lamp: Flicker, speed_um_s: float) -> None:
        """Judge only whole periods of a lamp that flickers, of a sweep that is slow enough for them."""
        self._lamp = Lamplight(self.resting.heard & ~self.resting.hot)
        self._settings = replace(self._settings, speed_um_s=speed_um_s)
        shortest_us = 1e6 * TRAVEL_PER_DEPTH_OF_FOCUS * self._settings.depth_of_focus_um / speed_um_s
        self._window_us = round(lamp.period_us * np.ceil(shortest_us / lamp.period_us))

    @property
    def reference(self) -> Reference:
        """The weights that the region is judged by: the first picture's, or the newest frame's."""
        return self._reference

    @property
    def passage(self) -> tuple[ElpSample, ...]:
        """The windows of this direction of travel so far."""
        return tuple(self._samples)

    @property
    def lit(self) -> bool:
        """Whether the sensor at rest has shown that the scene is in the light: a lamp flickers."""
        return self._lamp is not None

    @property
    def scene_moves(self) -> bool:
        """Whether the scene was seen to move, while the lens stood still or when focus was passed."""
        return self.resting.moves or self._passes.scene_moves

    @property
    def resting_rate_hz(self) -> float:
        """Events per second that noise makes in the region: what it sends at rest, unless the scene moved."""
        return 0.0 if self.scene_moves else 1e6 * self._rest.events_per_us

    @property
    def resting_events(self) -> int:
        """How many events the resting rate was learnt from."""
        return self.resting.events

    def begin(self, sign: int, at_us: SensorUs, turned_at_um: float | None = None) -> None:
        """Begin a direction of travel: everything is judged afresh.

        *turned_at_um* is where a reversal was commanded. Until the lens has come back there the events say more about
        the way out (photoreceptors lag, comparators have hysteresis) than about the way back, and are not judged; and
        the verdict that led here was certain, so the opposite one must be more certain still.
        """
        self._remember(self.resting.image_at_start if self._windows is None else self._memory.built())
        if self._lamp is not None:
            self._lamp.begin(at_us)
        self._ticked_um = self._here_um = float("nan")
        self._passed = False
        if self._windows is None:
            self._windows = ElpWindows(self._reference.weights, self._inside, window_us=self._window_us, rate_cap=True)
        self._heading = Heading.of_sweep(
            self._rest, self._memory, again=turned_at_um is not None, scene_moves=self.scene_moves
        )
        self._sign = sign
        self._judge_from = float("-inf") if turned_at_um is None else sign * turned_at_um
        self._begun_us = at_us
        self._samples = []
        self._frames = FrameTrack(self.roi, follow=self.scene_moves)
        self._gaps_us = []
        self._passes, self._unheard = Passes(), []
        self.decided_us = None
        self._turned_us = FOR_EVER
        self.events = 0

    def feed(self, packet: CameraPacket) -> list[ElpSample]:
        """Judge one packet; return the windows it closed."""
        assert self._windows is not None, "begin() comes before feed()"
        self.keep(packet)
        samples = []
        needed_um = SLOW_SHARE * 1e-6 * self._settings.speed_um_s
        for row in self._windows.feed(packet):
            sample = self._net(self._placed.sample(row))
            duration_us = sample.end_us - sample.begin_us
            if self.shedding.shed_us:
                sample = replace(sample, shed_us=self.shedding.within(sample.begin_us, sample.end_us))
            samples.append(sample)
            self.events += sample.n_on + sample.n_off
            if sample.begin_us < self._begun_us or self._sign * sample.travel_um < needed_um * duration_us:
                continue
            ticked = self._tick(sample, sample.position_um + 0.5 * sample.travel_um)
            if self._sign * sample.position_um < self._judge_from:
                continue
            if 2 * sample.shed_us < duration_us:  # a window that was hardly looked at says nothing
                self._heading.feed(sample, self._memory, ticked=ticked)
            far = self._memory.track.drop > FAR_DROP
            if self._heading.seen_ahead and not self._passed and far and self._memory.peak_passed:
                self._passed = True
                self.decided_us = SensorUs(max(sample.end_us, self._last_us))
        self._samples += samples
        self.events_in_cycle += sum(sample.n_on + sample.n_off for sample in samples)
        for frame in packet.frames:
            self._take_frame(frame)
        return samples

    def keep(self, packet: CameraPacket) -> None:
        """Remember a packet's events for the estimate."""
        if packet.complete_until_us is not None:
            self._last_us = packet.complete_until_us
        if packet.gap_before:
            self._gaps_us.append(int(self._last_us))
        events = self._decoder.feed(packet)
        self.rate.add(events.t)
        if self._lamp is not None:
            self._lamp.add(events)
            return
        first = int(np.searchsorted(events.t, self._begun_us, side="left"))
        self._memory.add(events.t[first:], events.x[first:], events.y[first:], events.p[first:])

    def turn(self, at_us: SensorUs) -> None:
        """Take note that the sweep ends at *at_us*: what comes later is of the way back.

        A motor that brakes late goes far beyond what is of interest; ``AFTERMATH_DOF`` of that is listened to.
        """
        assert self.decided_us is not None, "turn() comes after the decision"
        aftermath_us = 1e6 * AFTERMATH_DOF * self._settings.depth_of_focus_um / self._settings.speed_um_s
        self._turned_us = min(at_us, SensorUs(self.decided_us + round(aftermath_us)))

    @property
    def roughly_um(self) -> float:
        """Where focus was, known at once and not to be believed: the top of the raw curve, less what it is late by."""
        track = self._memory.track
        return self._sign * (track.positions[track.peak] - LATE_DOF * self._settings.depth_of_focus_um)

    def _tick(self, sample: ElpSample, end_um: float) -> bool:
        """Follow the sharpness of the events' own image: once per ``TICK_DOF`` of travel. Say whether it was time."""
        if abs(end_um - self._ticked_um) < TICK_DOF * self._settings.depth_of_focus_um:
            return False
        self._ticked_um = self._here_um = end_um
        # Under a lamp a pixel has spoken at some time in the period: at its middle, in the mean.
        self._memory.advance(sample.end_us, self._sign * (end_um if self._lamp is None else sample.position_um))
        return True

    @property
    def passed(self) -> bool:
        """Whether focus has certainly been passed.

        The image has become as sharp as it gets and duller again, and its product with the reference, the ELP, has said
        that focus was ahead: by the coarse weights, which know the direction from far away.
        """
        return self._passed

    @property
    def direction(self) -> Direction:
        """Where focus lies, as far as the events have said.

        Once ELP has said "ahead", a change of its mind is no reason to turn round at once: with a picture from far away
        it comes some depths of focus early, and the sharpness of the image has the say. Nor is it as long as frames get
        sharper: far from focus a lens shows some fine structure with its bright and dark exchanged, and a reference
        made of that points the wrong way. Where the scene moves, sharpness alone is asked (``vision.bearing``).
        """
        changed_us = self._heading.changed_us
        if changed_us is not None and not self._passed:
            if self._frames.sharpens:
                return Direction.APPROACHING
            beyond_um = self._sign * (self._here_um - self._locate(SensorUs(changed_us)))
            if beyond_um < PATIENCE_DOF * self._settings.depth_of_focus_um:
                return Direction.APPROACHING
        return self._heading.direction

    @property
    def score(self) -> float:
        """The running evidence in standard deviations: positive while focus is ahead, negative once it is behind."""
        return self._heading.score

    # --- after the stop ---

    def estimate(self) -> FocusEstimate | None:
        """Say where focus was, in um on the motor's ruler; ``None`` if no witness saw it.

        Asks the remembered events of the pass that is over, once: milliseconds, after the stop has been sent. What an
        earlier pass testified stands beside it.
        """
        if self.decided_us is None:
            return None
        one = Pass(
            self._memory,
            tuple(self._frames.seen),
            self._begun_us,
            max(self.decided_us, min(self._turned_us, self._last_us)),
            self._sign,
            self._settings.speed_um_s,
            WIDTHS_PER_DEPTH_OF_FOCUS * self._settings.depth_of_focus_um,
            self.scene_moves,
            self._passes.deaf,
        )
        if self._lamp is not None:
            said = one.testify_under_a_lamp(self._locate, self._window_us)
        else:
            dark = DARK if self._settings.frames else DARK_OF_MAP
            said = one.testify(self._locate, self._reference.brightness, LAG_UNEXPLAINED_LIVE, dark)
        look_back_us = 1e6 * LOOK_BACK_DOF * self._settings.depth_of_focus_um / self._settings.speed_um_s
        self._passes.add(said, self._sign, (self.decided_us - look_back_us, self.decided_us))
        self.flicker = self._passes.flicker
        self.depths_um = self._passes.depths_um
        return self._passes.estimate(self._settings.play)

    @property
    def peak_um(self) -> float:
        """Where the image was sharpest, in the last pass."""
        track = self._memory.track
        return self._sign * track.positions[track.peak]

    @property
    def gap_near_crossing(self) -> bool:
        """Whether anything was lost in the last part of a pass, where the estimate comes from."""
        return self._passes.hold_any(self._gaps_us)

    def events_within(self, from_um: float, to_um: float) -> int:
        """Return how many events the last pass in the sweep's direction saw between two places."""
        low, high = min(from_um, to_um), max(from_um, to_um)
        return sum(one.n_on + one.n_off for one in self._samples if low <= one.position_um <= high)

    def count(self, packet: CameraPacket) -> None:
        """Count the region's events of a packet that is not judged (the way back)."""
        assert self._windows is not None, "begin() comes before count()"
        if self._lamp is not None:
            self.keep(packet)
        self._count(packet)

    def follow(self, packet: CameraPacket) -> None:
        """Count the region's events, and let them go on building their image, while the lens goes where it is sent."""
        assert self._windows is not None, "begin() comes before follow()"
        self.keep(packet)
        self._count(packet)

    def _count(self, packet: CameraPacket) -> None:
        assert self._windows is not None
        for row in self._windows.feed(packet):
            sample = self._net(self._placed.sample(row))
            self.events_in_cycle += sample.n_on + sample.n_off

    def return_score(self, focus_um: float) -> float | None:
        """Return by how many standard deviations the way back undid what the way out from focus had done to the pixels.

        Only under a lamp, where events cannot simply be counted; else ``None``.
        """
        return None if self._lamp is None else self._lamp.return_score(self._memory, self._sign * focus_um)

    def hear_out(self, packet: CameraPacket) -> None:
        """Take a packet after the decision: what is still of the sweep belongs to it, the rest is counted."""
        assert self._windows is not None, "begin() comes before hear_out()"
        if self._last_us < self._turned_us or self._lamp is not None:
            self.keep(packet)
        else:  # nobody waits for what it says, unless there is a second pass
            self._unheard.append(replace(packet, data=packet.data.copy(), frames=()))
        for row in self._windows.feed(packet):
            sample = self._net(self._placed.sample(row))
            if row["end_us"] <= self._turned_us:
                self._samples.append(sample)
            count = sample.n_on + sample.n_off
            self.events_in_cycle += count
            self.events_back += count if row["begin_us"] >= self.back_from_us else 0

    def go_back(self, at_us: SensorUs) -> None:
        """Take note that the way back is under way at *at_us*, and that what is left of the sweep has died away."""
        self.back_from_us, self.events_back = at_us, 0

    # --- a second pass ---

    def catch_up(self) -> None:
        """Let the events of the way back that nobody has listened to yet go on building the image."""
        for packet in self._unheard:
            self.keep(packet)
        self._unheard = []

    def begin_again(self, sign: int, at_us: SensorUs, from_um: float) -> None:
        """Begin to pass focus once more, in either direction.

        The image is gone on with; its sharpness is followed from *from_um* on, where the play has been taken up.
        """
        self._remember(self._memory.built())
        self._sign = sign
        if sign == self._passes.sign:
            self._samples = []
        self._ticked_um = self._here_um = float("nan")
        self._begun_us, self._judge_from = at_us, self._sign * from_um
        self._turned_us = FOR_EVER
        self._frames = FrameTrack(self.roi, follow=self.scene_moves)

    def pass_again(self, packet: CameraPacket) -> None:
        """Follow the image's sharpness in a packet of the second pass."""
        assert self._windows is not None, "begin() comes before pass_again()"
        self.keep(packet)
        for row in self._windows.feed(packet):
            sample = self._placed.sample(row)
            if self._sign == self._passes.sign:
                self._samples.append(sample)
            self.events_in_cycle += sample.n_on + sample.n_off
            end_um = sample.position_um + 0.5 * sample.travel_um
            if sample.begin_us >= self._begun_us and self._sign * end_um >= self._judge_from:
                self._tick(sample, end_um)
        for frame in packet.frames:
            self._measure_frame(frame)

    def passed_again(self) -> None:
        """End the second pass: from here on packets are of the way back. ``estimate`` may be asked again."""
        track = self._memory.track
        self.decided_us = self._turned_us = SensorUs(track.times_us[-1]) if len(track) else self._last_us
        self.go_back(self._last_us)

    # --- pieces ---

    def _remember(self, start: BuiltImage | None) -> None:
        """Begin a new memory that goes on with an image.

        Built anew, it would begin with the negative of what the scene looked like where the lens turned, perhaps close
        to focus, and when the scene moves the difference of two sharp pictures is sharpest anywhere.
        """
        self._memory = EventMemory(self.roi, self._geometry, hot=self.resting.hot, sensor=self._sensor, start=start)

    def _net(self, sample: ElpSample) -> ElpSample:
        """Under a lamp, keep of a window only what whole periods leave; remember that for the estimate."""
        if self._lamp is None:
            return sample
        net = self._lamp.close(sample)
        if self._passed:
            self._lamp.undo(net)
        elif sample.begin_us >= self._begun_us:  # else only part of a period was heard
            self._memory.add(*net)
        return weighed(sample, net, self._reference.weights, self._inside)

    def _take_frame(self, frame: Frame) -> None:
        self._measure_frame(frame)
        if self._rereference is not None and self._windows is not None:
            self._reference = self._rereference(frame)
            self._windows.set_weights(self._reference.weights, self._inside)

    def _measure_frame(self, frame: Frame) -> None:
        if frame.t_us >= self._begun_us:
            self._frames.take(frame, self._sign * self._locate(frame.t_us))
