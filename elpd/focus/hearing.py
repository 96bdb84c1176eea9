"""What a region says, packet by packet: windows of ELP, and the memory of the events.

At rest packets teach what noise is; in motion they go through the fused kernel into windows, each placed where the lens
was, and their events into the memory that builds the image. Under a lamp both get only what whole periods leave behind.
Nothing is judged here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from elpd.events.stream import PacketDecoder
from elpd.focus.lamplight import Lamplight, weighed
from elpd.focus.placed import Placed
from elpd.units import SensorUs
from elpd.vision.detector import RestingRate
from elpd.vision.elp import ElpWindows
from elpd.vision.memory import EventMemory
from elpd.vision.resting import Resting
from elpd.vision.saturation import RateWatch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from elpd.records import CameraPacket, ElpSample, Geometry, Roi, SensorProfile
    from elpd.vision.flicker import Flicker
    from elpd.vision.memory import BuiltImage
    from elpd.vision.reference import Reference


class Hearing:
    """Listens to one region.

    Parameters
    ----------
    reference
        Weights over the whole sensor, zero outside the region.
    roi, geometry
        The region and the sensor.
    window_um, speed_um_s
        Travel of a window, and the speed that makes a time of it.
    locate
        Lens position in um at a sensor time.
    sensor
        What a calibration knows of the sensor.
    picture
        Makes the first picture, as ``Resting`` wants it.
    support_us
        Of the filter of background activity; 0: none.
    """

    def __init__(
        self,
        reference: Reference,
        roi: Roi,
        geometry: Geometry,
        *,
        window_um: float,
        speed_um_s: float,
        locate: Callable[[SensorUs], float],
        sensor: SensorProfile | None,
        picture: Callable[[], NDArray[np.float32]] | None,
        support_us: int = 0,
    ) -> None:
        self.reference = reference
        """The weights that the region is judged by."""
        self.resting = Resting(roi, geometry, picture)
        """What the sensor says at rest."""
        self.rest_rate = RestingRate()
        """What noise alone looks like, known once ``armed``."""
        self.rate = RateWatch()
        """Whether the read-out is full."""
        self.lamp: Lamplight | None = None
        self.undoing = False
        """Whether what comes now undoes what the way out has done (under a lamp)."""
        self.begun_us = SensorUs(0)
        """Since when events are remembered: the beginning of the present motion."""
        self.last_us = SensorUs(0)
        """Up to when everything was heard."""
        self.events = 0
        """Events in the region, in windows, since it was armed."""
        self.gaps_us: list[int] = []
        """When something was lost, since the present direction of travel began."""
        inside = np.zeros((geometry.height, geometry.width), np.bool_)
        inside[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width] = True
        for x, y in sensor.hot_pixels if sensor is not None else ():
            inside[y, x] = False
        self._inside = inside
        self.roi = roi
        self._geometry = geometry
        self._sensor = sensor
        self._support_us = support_us
        self._window_um = window_um
        self.window_us = max(20, round(1e6 * window_um / speed_um_s))
        self._windows: ElpWindows | None = None
        self._decoder = PacketDecoder(geometry)
        self._placed = Placed(locate)
        self.memory = EventMemory(roi, geometry, sensor=sensor, support_us=support_us)
        """The events of the present stretch of motion, and the image that they build."""

    # --- at rest ---

    def rest(self, packet: CameraPacket) -> None:
        """Learn from a packet of a sensor that sees nothing move."""
        events = self._decoder.feed(packet)
        self.resting.add(events.t, events.x, events.y, events.p, packet.complete_until_us)
        self.resting.see(packet.frames)

    def armed(self) -> None:
        """Close the lesson of the resting sensor: its rate is known, and hot pixels are not listened to any more."""
        self.rest_rate = self.resting.settle(self.reference.weights)
        self._inside &= ~self.resting.hot

    def under_a_lamp(self, lamp: Flicker, speed_um_s: float) -> None:
        """Make windows of whole periods of a lamp that flickers."""
        self.lamp = Lamplight(self.resting.heard & ~self.resting.hot)
        shortest_us = 1e6 * self._window_um / speed_um_s
        self.window_us = round(lamp.period_us * np.ceil(shortest_us / lamp.period_us))

    # --- in motion ---

    def begin(self, at_us: SensorUs) -> None:
        """Begin a direction of travel: a new memory that goes on with the image there is."""
        self._remember(self.resting.image_at_start if self._windows is None else self.memory.built())
        if self.lamp is not None:
            self.lamp.begin(at_us)
        if self._windows is None:
            weights = self.reference.weights
            self._windows = ElpWindows(
                weights, self._inside, window_us=self.window_us, rate_cap=True, support_us=self._support_us
            )
        self.begun_us = at_us
        self.gaps_us = []
        self.undoing = False

    def begin_again(self, at_us: SensorUs) -> None:
        """Begin another pass of the same search."""
        self._remember(self.memory.built())
        self.begun_us = at_us

    def keep(self, packet: CameraPacket) -> None:
        """Remember a packet's events for the estimate."""
        if packet.complete_until_us is not None:
            self.last_us = packet.complete_until_us
        if packet.gap_before:
            self.gaps_us.append(int(self.last_us))
        events = self._decoder.feed(packet)
        self.rate.add(events.t)
        if self.lamp is not None:
            self.lamp.add(events)
            return
        first = int(np.searchsorted(events.t, self.begun_us, side="left"))
        self.memory.add(events.t[first:], events.x[first:], events.y[first:], events.p[first:])

    def count(self, packet: CameraPacket) -> None:
        """Count the region's events in a packet; under a lamp they are kept to be undone."""
        if self.lamp is not None:
            self.keep(packet)
        for _ in self.windows(packet):
            pass

    def follow(self, packet: CameraPacket) -> None:
        """Count the region's events in a packet, and remember them."""
        self.keep(packet)
        for _ in self.windows(packet):
            pass

    def windows(self, packet: CameraPacket) -> Iterator[ElpSample]:
        """Yield the windows that a packet closes, each when the last one has been judged.

        Under a lamp a window holds what whole periods leave, and that is remembered for the estimate.
        """
        assert self._windows is not None, "begin() comes first"
        for row in self._windows.feed(packet).tolist():
            sample = self._net(self._placed.sample(row))
            self.events += sample.n_on + sample.n_off
            yield sample

    def rereference(self, reference: Reference) -> None:
        """Judge by other weights from here on."""
        self.reference = reference
        if self._windows is not None:
            self._windows.set_weights(reference.weights, self._inside)

    def _remember(self, start: BuiltImage | None) -> None:
        """Begin a new memory that goes on with an image.

        Built anew, it would begin with the negative of what the scene looked like where the lens turned, perhaps close
        to focus, and when the scene moves the difference of two sharp pictures is sharpest anywhere.
        """
        hot, sensor, support_us = self.resting.hot, self._sensor, self._support_us
        deafness = self.resting.deafness
        self.memory = EventMemory(
            self.roi, self._geometry, hot=hot, sensor=sensor, start=start, support_us=support_us, deafness=deafness
        )
        if self.lamp is not None:
            self.memory.under_a_lamp()

    def _net(self, sample: ElpSample) -> ElpSample:
        if self.lamp is None:
            return sample
        net = self.lamp.close(sample)
        if self.undoing:
            self.lamp.undo(net)
        elif sample.begin_us >= self.begun_us:  # else only part of a period was heard
            self.memory.add(*net)
        return weighed(sample, net, self.reference.weights, self._inside)
