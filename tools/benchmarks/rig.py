"""A rig to live a case through: its scene, lens and sensor in front of a controller that decides where the lens goes.

A recorded case has been swept once, whoever looks at it. Here the same scene moves as it does there, behind the same
lens and before the same sensor, and the picture of every step is that of where the lens is by then. The sensor has been
looking since the rig was started, so that a second pass goes on with the pixels as the first has left them. The lens is
the simulated rig's behind a simulated Tic controller, with the rig's play between motor and carriage; camera and host
add no delay.
"""

from __future__ import annotations

import time
import zlib
from typing import TYPE_CHECKING

import numpy as np
from elpd_drivers.sim.camera import EVENT_DTYPE
from elpd_drivers.sim.controllers import Wanted, controller, fitted
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens
from elpd_drivers.sim.world import BIRTH_NS, World

from benchmarks.cases import region, streams
from benchmarks.retina import Retina, joined
from benchmarks.scenery import Scenery
from benchmarks.sets import APERTURE_US, FRAME_PERIODS_US, MAP
from benchmarks.shutter import Shutter
from elpd.errors import CameraError
from elpd.ports import RigParts
from elpd.records import BiasSet, CameraPacket, CommandStamp, Encoding, Frame, Geometry
from elpd.scale import LensScale
from elpd.units import NS_PER_S, NS_PER_US, HostNs, SensorUs
from elpd.vision.temporal_map import linear

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.cases import Case
    from elpd.ports import Clock

LONGEST_MS = 5_000.0
"""How long a cycle may take, as in ``elpd.config``."""

ROOM_UM = 20.0
"""From where the lens begins to the end of its travel behind it, and as much beyond where a recorded sweep ends."""

UM_PER_STEP = 0.3125
ACCELERATION_UM_S2 = 400_000.0
"""As of the simulated rig (``[sim]``)."""

FIRST_FRAME_US = 20_000
"""When the first frame's exposure begins: by then the cycle has seen that the lens rests, and asks for one."""

PACKET_US = 500
"""A camera sends as often as this, or with each step of a scene that is rendered less often."""

_SPARE_US = 1_000_000


def build_rig(case: Case, rate: str) -> tuple[RigParts, CaseCamera, CaseLens]:
    """Build the rig of *case* whose camera has frames at *rate*, or the aperture's picture in their place."""
    chosen = case.of_set
    world = World()
    # Focus lies anywhere between two steps of the motor.
    within_um = UM_PER_STEP * np.random.default_rng([case.seed, zlib.crc32(case.name.encode())]).random()
    glass = CaseLens(ROOM_UM - chosen.start_um + within_um, 2.0 * (ROOM_UM + abs(chosen.start_um)))
    speed_um_s = abs(chosen.speed_um_s)
    wanted = Wanted(UM_PER_STEP, glass.travel_um, 3.0 * speed_um_s, ACCELERATION_UM_S2)
    port, table = fitted("tic", glass.mechanism, wanted, world, seed=case.seed)
    world.add(port)
    lens = controller("tic").open_lens(table, world, port)
    aperture = CaseAperture(world) if rate == MAP else None
    camera = (CaseCamera if aperture is None else BiasedCamera)(case, rate, world, glass, aperture)
    return RigParts(world, camera, lens, aperture, LensScale(UM_PER_STEP)), camera, glass


class CaseLens:
    """The glass: where it is, and where it is in focus, um from the lower end of its travel."""

    def __init__(self, focus_um: float, travel_um: float) -> None:
        self._focus_um = focus_um
        self.travel_um = travel_um
        self._mechanics = LensMechanics(um_per_step=UM_PER_STEP, travel_um=travel_um)
        self.mechanism = SimulatedLens(self._mechanics, start_um=ROOM_UM)

    def focus_um(self, sweep_sign: int) -> float:
        """Return focus on the motor's ruler while the carriage is pushed in a direction (+1, -1; 0: mid-play)."""
        return self._focus_um + sweep_sign * self._mechanics.backlash_um / 2

    def defocus_um(self, when: int) -> float:
        """Return how far the glass is beyond focus at a host instant."""
        return float(self.mechanism.carriage_um(np.array([when], np.int64))[0]) - self._focus_um


class CaseAperture:
    """An aperture whose area opens evenly, at once when it is told, and closes in no time."""

    opening_ms = APERTURE_US / 1e3

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._opens_ns: int | None = None

    def open(self) -> CommandStamp:
        """Begin to open, if it is closed."""
        now = self._clock.now_ns()
        self._opens_ns = now if self._opens_ns is None else self._opens_ns
        return CommandStamp("open", now, now)

    def close(self) -> CommandStamp:
        """Close."""
        now, self._opens_ns = self._clock.now_ns(), None
        return CommandStamp("close", now, now)

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of the area that is open, by time."""
        return linear(since_open_us)

    def opened(self, when: int) -> float:
        """Return the share of the area that is open at a host instant."""
        if self._opens_ns is None:
            return 0.0
        return min(max((when - self._opens_ns) / (NS_PER_US * APERTURE_US), 0.0), 1.0)


class CaseCamera:
    """The case's sensor (``elpd.ports.EventCamera``). Time passes in ``read``, and only then is anything rendered.

    Parameters
    ----------
    case, rate:
        What is to be seen, and how often there is a frame: the names of ``sets.FRAME_PERIODS_US``, at 1 fps the first
        frame and no other.
    """

    def __init__(self, case: Case, rate: str, world: World, glass: CaseLens, aperture: CaseAperture | None) -> None:
        chosen = case.of_set
        self.geometry = Geometry(chosen.size_px, chosen.size_px)
        self.roi = region(chosen)
        self.simulated_s = 0.0
        """Processor time that went into rendering and into the sensor."""
        self._chosen = chosen
        self._world, self._glass, self._aperture = world, glass, aperture
        motion_rng, self._retina_rng, self._frame_rng = streams(case)
        self._last_us = round(1e3 * LONGEST_MS) + _SPARE_US
        self._scenery = Scenery(case, self._last_us, motion_rng)
        self._shutter = Shutter(chosen.exposure_us, chosen.read_out_us, chosen.step_us)
        self._settings = chosen.retina
        self._retina: Retina | None = None
        self._next_us = 0
        self._packet_us = max(PACKET_US, chosen.step_us)
        period_us = FRAME_PERIODS_US.get(rate)
        first_us = FIRST_FRAME_US + self._shutter.reach_us
        stop_us = first_us + 1 if rate == "1" else self._last_us
        self._frames_us = frozenset() if period_us is None else frozenset(range(first_us, stop_us, period_us))
        self._known: tuple[tuple[float, ...], NDArray[np.float32]] | None = None
        self._runs = False

    def start(self) -> None:
        """Begin to deliver."""
        self._runs = True

    def stop(self) -> None:
        """Stop delivering."""
        self._runs = False

    def read(self, timeout_s: float) -> CameraPacket | None:
        """Let time pass until a packet is there, *timeout_s* at the most. Raises ``CameraError`` when it never will."""
        if not self._runs or self._next_us > self._last_us:
            raise CameraError("the case's camera delivers between start and stop, and no longer than a cycle may take")
        deadline = HostNs(self._world.now_ns() + round(timeout_s * NS_PER_S))
        due = HostNs(BIRTH_NS + (self._next_us + self._packet_us) * NS_PER_US)
        self._world.sleep_until(min(due, deadline))
        return None if due > deadline else self._packet()

    def _packet(self) -> CameraPacket:
        begun_s = time.process_time()
        begin_us, end_us, step_us = self._next_us, self._next_us + self._packet_us, self._chosen.step_us
        parts, frames = [], []
        for t_us in range(begin_us + step_us, end_us + 1, step_us):
            light, opened = self._look(t_us)
            self._shutter.see(light)
            if self._retina is None:
                self._retina = Retina(self._settings, light * np.float32(opened), t_us, self._last_us, self._retina_rng)
            else:
                self._retina.see(light * np.float32(opened), float(t_us))
                parts.append(self._retina.newest())
            if t_us in self._frames_us:
                frames.append(self._frame(t_us))
        seen = joined(parts)
        data = np.empty(seen.t_us.size, EVENT_DTYPE)
        data["t"], data["x"], data["y"], data["on"] = seen.t_us, seen.x, seen.y, seen.on
        self._next_us = end_us
        self.simulated_s += time.process_time() - begun_s
        return CameraPacket(data, Encoding.ARRAY, self._world.now_ns(), SensorUs(end_us), tuple(frames))

    def _look(self, t_us: int) -> tuple[NDArray[np.float32], float]:
        """Return the picture at *t_us* and the share of the aperture that is open; what has not changed is known."""
        when = BIRTH_NS + t_us * NS_PER_US
        opened = 1.0 if self._aperture is None else self._aperture.opened(when)
        place_um = self._glass.defocus_um(when)
        lamp_us = t_us if self._chosen.flicker else 0
        asked = (place_um, opened, float(lamp_us), *self._scenery.shift_px(t_us))
        if self._known is None or self._known[0] != asked:
            self._known = asked, self._scenery.picture(t_us, place_um, opened)
        return self._known[1], opened

    def _frame(self, t_us: int) -> Frame:
        chosen, exposed = self._chosen, self._shutter.exposed()
        noisy = exposed + chosen.frame_noise_dn * self._frame_rng.standard_normal(exposed.shape)
        pixels = np.round(np.clip(noisy, 0.0, 255.0)).astype(np.uint8)
        return Frame(SensorUs(t_us - chosen.frame_age_us), SensorUs(t_us), chosen.exposure_us, pixels)


class BiasedCamera(CaseCamera):
    """The same with a sensor that is biased for exposing, and for focusing; its pixels begin anew either way."""

    def apply_biases(self, biases: BiasSet) -> None:
        """Switch from the next picture on."""
        exposing = self._chosen.expose
        self._settings = exposing if biases is BiasSet.EXPOSE and exposing is not None else self._chosen.retina
        self._retina = None
