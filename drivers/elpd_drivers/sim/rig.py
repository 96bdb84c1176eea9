"""A simulated rig, whole, wired by hand: the entry point ``elpd.rigs: sim``.

One world holds a camera, an aperture and a lens behind its real wire protocol; the driver that moves the lens is that
for real hardware. True focus is drawn over the lens's travel, and the lens begins referenced and at rest beside it.
What a controller cannot know, the ``Truth`` does: where focus is and where the glass really came to rest.

The two rulers differ by the play between motor and carriage. ``focus_um`` is given on the motor's ruler as it is while
the carriage is pushed in the direction of the sweep (``result.details["sweep_sign"]``): carriage focus plus half the
play for an upward sweep, minus half for a downward one. The final error is read off the carriage and needs no ruler.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from elpd.errors import ConfigError, LensError
from elpd.events.evt3_encode import Evt3Encoder
from elpd.motion.lens_output import aperture_on_lens
from elpd.ports import RigParts
from elpd.records import Encoding, Geometry, LensReport, Roi, Trigger
from elpd.scale import LensScale
from elpd.units import Steps, after_ms
from elpd_drivers.lenses.axis import read_settings
from elpd_drivers.lenses.iris_axis import INTO_STOP, IRIS
from elpd_drivers.sim.aperture import Opening, SimulatedAperture, StepperIris
from elpd_drivers.sim.camera import RING_PACKETS, ArrayWire, CameraFaults, RateLimit, SimulatedCamera, TriggerLine, Wire
from elpd_drivers.sim.controllers import Wanted, controller, fitted
from elpd_drivers.sim.drift import Drift
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens
from elpd_drivers.sim.motion import SceneMotion
from elpd_drivers.sim.optics import LAMP_SHAPES, DefocusStack, Lamp, Layer, LightField
from elpd_drivers.sim.retina import OVEREXPOSED, ApsFrames, Retina
from elpd_drivers.sim.scene import choose_scene, scene_canvas
from elpd_drivers.sim.sensor import FOCUS, HOT_PIXEL_HZ, LAG_US_AT_FULL, MISMATCH_SD, BiasLevels, EventSensor
from elpd_drivers.sim.world import BIRTH_NS, World, random_stream

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from elpd.motion.lens_output import LensOutputAperture
    from elpd.ports import Lens
    from elpd.records import FocusResult
    from elpd_drivers.sim.boards.line import MemoryPort
    from elpd_drivers.sim.sensor import Events

MARGIN_PX = 32
INTERPOLATION_PX = 3
ROOM_UM = 300.0
HOMING_MS = 60_000.0
CAMERAS = {"evk4": Geometry(1280, 720), "davis346": Geometry(346, 260)}
MASK_SLOTS = {"evk4": 64, "davis346": 8}
OBJECT_SCENE = "gravel"
LARGEST_MISMATCH = 0.2


@dataclass(frozen=True, slots=True)
class SimSettings:
    """The table ``[sim]``. Everything random follows from ``seed``.

    ``start_um`` is where the lens begins, relative to true focus. ``scene`` is a name or ``random``, one of the natural
    pictures by seed. ``speed_um_s`` is what the sweep is meant to run at; the lens allows three times as much.
    ``width`` and ``height`` shrink the sensor; 0 is the camera's own size. Rates are per pixel; ``brightness`` scales
    the light, and with it photoreceptor lag and shot noise; ``lag_us`` is the photoreceptors' time constant in full
    light, ``mismatch`` the relative spread of the contrast thresholds over pixels. ``cam`` makes the image move by 1 ±
    that many times as much as the carriage, one wave over the travel; ``steps_to_um`` is the ruler that its owner
    believes in. With ``iris_steps`` the aperture is an iris on another axis of the lens's board (scf4, theia,
    tmcl or zaber), with so many microsteps from stop to stop, turned at ``iris_speed_sps``. Focus moves along the
    travel by ``drift_um_s``. With ``sync_steps`` the board's sync line, which makes an edge at every multiple of so
    many steps, is wired to the camera's trigger input, unless ``sync_cut``.

    Misfortunes: ``flicker_shape`` is ``sine`` or ``pwm``. ``pan_px_s`` is a steady motion, ``pan_deg`` its direction
    from the x axis; ``breathing_per_mm`` how the magnification changes with travel. With ``second_plane_um`` the right
    half of the picture is in focus so much further along the travel. With ``object_px_s`` a textured square, in the
    scene's plane, goes across it. ``overexposed`` is the share of a frame's pixels that clip. Events beyond
    ``rate_limit_mev_s`` do not leave the sensor, which says so (``rate_limit_told``) or not. The ``camera_*``,
    ``drop_*`` and ``aperture_stuck`` or ``_slow`` keys inject faults, in seconds after the camera's start.
    """

    seed: int = 0
    start_um: float = -200.0
    scene: str = "random"
    motion: str = "static"
    board: str = "tic"
    camera: str = "evk4"
    depth_of_focus_um: float = 6.0
    speed_um_s: float = 4000.0
    pace: float = 0.0
    width: int = 0
    height: int = 0
    # light
    cap: bool = False
    brightness: float = 1.0
    flicker_hz: float = 0.0
    flicker_depth: float = 0.1
    flicker_shape: str = "sine"
    # scene
    pan_px_s: float = 0.0
    pan_deg: float = 0.0
    breathing_per_mm: float = 0.0
    second_plane_um: float = 0.0
    object_px_s: float = 0.0
    # sensor
    noise_hz: float = 1.0
    leak_hz: float = 0.1
    hot_pixels: int = 0
    hot_pixel_hz: float = HOT_PIXEL_HZ
    overexposed: float = OVEREXPOSED
    rate_limit_mev_s: float = 0.0
    rate_limit_told: bool = True
    contrast_on: float = FOCUS.c_on
    contrast_off: float = FOCUS.c_off
    refractory_us: int = FOCUS.refractory_us
    mismatch: float = MISMATCH_SD
    lag_us: float = LAG_US_AT_FULL
    memories: bool = True
    ring_packets: int = RING_PACKETS
    # aperture
    aperture_ms: float = 20.0
    aperture_profile: str = "iris"
    aperture_stuck: bool = False
    aperture_slow: bool = False
    iris_steps: int = 0
    iris_speed_sps: float = 12_800.0
    # lens
    travel_um: float = 2500.0
    um_per_step: float = 0.3125
    steps_to_um: tuple[tuple[float, float], ...] = ()
    cam: float = 0.0
    drift_um_s: float = 0.0
    backlash_um: float = 4.0
    acceleration_um_s2: float = 400_000.0
    microstep_error_um: float = 0.0
    sync_steps: int = 0
    sync_cut: bool = False
    # faults of the camera
    camera_vanishes_at_s: float | None = None
    camera_silent_from_s: float | None = None
    drop_from_s: float | None = None
    drop_for_s: float = 0.01


IRIS_HOMING_MS, IRIS_SPARE_MS = 500.0, 20.0


@runtime_checkable
class TurnsIris(Protocol):
    """A board with an axis for an iris, and what its driver calls that axis."""

    iris_axis: int | str

    def add_iris(self, iris: StepperIris) -> None:
        """Put it there."""
        ...


class Evt3Wire:
    """EVT3 words, each span closed by the time at its end."""

    encoding = Encoding.EVT3

    def __init__(self, width: int) -> None:
        self._encoder = Evt3Encoder(width)

    def encode(self, events: Events, begin_us: int, end_us: int) -> NDArray[Any]:
        """Return a fresh array of uint16 words."""
        del begin_us
        words = self._encoder.encode(events.t_us, events.x, events.y, events.on).copy()
        return np.concatenate([words, self._encoder.encode_time(end_us)])

    def encode_edge(self, edge: Trigger) -> NDArray[Any]:
        """Return its words."""
        return self._encoder.encode_trigger(edge.t_us, edge.id, rising=edge.rising).copy()


@dataclass(frozen=True, slots=True)
class Cam:
    """What a lens with a cam does to the carriage's travel: the image moves by ``1 ± unevenness`` times as much.

    ``unevenness`` is the largest relative departure from one (0: a plain screw), one wave over the travel.
    """

    unevenness: float
    travel_um: float

    def image_um(self, carriage_um: NDArray[np.float64] | np.float64) -> NDArray[np.float64]:
        """Return how far the image has moved, um, where the carriage is at *carriage_um* (any shape)."""
        wave = 2 * np.pi / self.travel_um
        return np.asarray(carriage_um + self.unevenness / wave * np.sin(wave * carriage_um))


class SimulatedTruth:
    """What only a simulated rig knows (``elpd.ports.Truth``), and its parts, for tests that reach in.

    Parameters
    ----------
    focus_carriage_um
        The carriage position of true focus, from the lower end stop.
    drift
        How far focus has moved since; tests move it.
    """

    def __init__(
        self,
        *,
        world: World,
        lens: Lens,
        mechanism: SimulatedLens,
        port: MemoryPort,
        aperture: Opening | None,
        focus_carriage_um: float,
        scene: str,
        light: LightField,
        geometry: Geometry,
        cam: Cam,
        scale: LensScale,
        drift: Drift,
    ) -> None:
        self.world = world
        self.mechanism = mechanism
        self.port = port
        self.aperture = aperture
        self.focus_carriage_um = focus_carriage_um
        self.scene = scene
        self.drift = drift
        self._lens = lens
        self._light = light
        self._geometry = geometry
        self._cam = cam
        self._scale = scale

    def picture(self) -> NDArray[np.float32]:
        """Return what falls on the sensor now, behind an open aperture: log photocurrent, (height, width)."""
        whole = Roi(0, 0, self._geometry.width, self._geometry.height)
        out = np.empty((whole.height, whole.width), np.float32)
        self._light.render(self._light.wide_open(self.world.now_ns()), whole, out)
        return out

    def carriage_error_um(self) -> float:
        """Return how far the carriage is from focus now, signed."""
        now = np.array([self.world.now_ns()], np.int64)
        here_um, focus_um = (
            self._cam.image_um(self.mechanism.carriage_um(now)),
            self._cam.image_um(np.float64(self.focus_carriage_um)),
        )
        return float(here_um[0] - focus_um - self.drift.um(now)[0])

    def focus_um(self, sweep_sign: int) -> float | None:
        """Return focus on the motor's ruler while the carriage is pushed in a direction (+1, -1; 0: mid-play).

        The ruler is the driver's own count, so lost steps and a new reference are taken into account. ``None`` if the
        driver does not know where it is.
        """
        now = self.world.now_ns()
        try:
            count = self._lens.position_at(now).steps
        except LensError:
            return None
        mechanics = self.mechanism.mechanics
        drift_um = float(self.drift.um(np.array([now], np.int64))[0])  # without a cam the two rulers are one
        rotor_um = self.focus_carriage_um + drift_um + sweep_sign * mechanics.backlash_um / 2
        shift = round(count - self.mechanism.rotor_at(now))
        return self._scale.to_um(rotor_um / mechanics.um_per_step + shift)

    def errors(self, result: FocusResult) -> dict[str, float | None]:
        """Return ``focus_um estimate_error_um stop_error_um final_error_um``; ``None`` where there is no number."""
        focus_um = self.focus_um(int(result.details.get("sweep_sign", 0)))

        def error(measured_um: float | None) -> float | None:
            return None if measured_um is None or focus_um is None else measured_um - focus_um

        return {
            "focus_um": focus_um,
            "estimate_error_um": error(result.focus_um),
            "stop_error_um": error(result.stop_um),
            "final_error_um": None if result.final_um is None else self.carriage_error_um(),
        }


def encodings(settings: Mapping[str, Any]) -> frozenset[Encoding]:
    """Return how the simulated camera's packets are encoded."""
    return frozenset({Encoding.EVT3 if settings.get("camera") == "evk4" else Encoding.ARRAY})


def build_rig(settings: Mapping[str, Any]) -> RigParts:
    """Build a simulated rig from the table ``[sim]``; see ``SimSettings`` for the keys.

    Raises ``ConfigError`` for unknown keys, wrong types and impossible values.
    """
    chosen = read_settings(SimSettings, settings, "sim")
    geometry = _geometry(chosen)
    scale = LensScale(chosen.um_per_step, chosen.steps_to_um)
    cam = Cam(chosen.cam, chosen.travel_um)
    seed = chosen.seed
    world = World(chosen.pace)
    focus_um, start_um = _place(chosen)
    mechanism = SimulatedLens(_mechanics(chosen), start_um=start_um)
    drift = Drift(BIRTH_NS, chosen.drift_um_s)
    iris = StepperIris(chosen.iris_steps) if chosen.iris_steps else None
    lens, port = _lens(chosen, world, mechanism, iris)
    aperture = _aperture(chosen, world) if chosen.camera == "evk4" and iris is None else None
    scene = choose_scene(chosen.scene, random_stream(seed, "scene"))
    stack = _stack(scene, geometry, chosen.brightness)
    heading = np.deg2rad(chosen.pan_deg)
    pan_px_s = (float(chosen.pan_px_s * np.cos(heading)), float(chosen.pan_px_s * np.sin(heading)))
    light = LightField(
        stack,
        lambda times_ns: cam.image_um(mechanism.carriage_um(times_ns)) - drift.um(times_ns),
        float(cam.image_um(np.float64(focus_um))),
        SceneMotion(chosen.motion, random_stream(seed, "motion"), MARGIN_PX - INTERPOLATION_PX, pan_px_s),
        aperture=iris or aperture,
        depth_of_focus_um=chosen.depth_of_focus_um,
        margin_px=MARGIN_PX,
        lamp=Lamp(chosen.flicker_hz, chosen.flicker_depth, chosen.flicker_shape),
        cap=chosen.cap,
        layers=_layers(chosen, stack, geometry),
        breathing_per_mm=chosen.breathing_per_mm,
    )
    truth = SimulatedTruth(
        world=world,
        lens=lens,
        mechanism=mechanism,
        port=port,
        aperture=iris or aperture,
        focus_carriage_um=focus_um,
        scene=scene,
        light=light,
        geometry=geometry,
        cam=cam,
        scale=scale,
        drift=drift,
    )
    wired = chosen.sync_steps and not chosen.sync_cut
    line = port.wire.board if wired and isinstance(port.wire.board, TriggerLine) else None
    opener = aperture if iris is None else _iris_on(lens, chosen)
    return RigParts(world, _camera(chosen, world, light, geometry, line), lens, opener, scale, truth)


def _stack(scene: str, geometry: Geometry, brightness: float) -> DefocusStack:
    return DefocusStack(scene_canvas(scene, geometry.width, geometry.height, MARGIN_PX), brightness)


def _layers(chosen: SimSettings, stack: DefocusStack, geometry: Geometry) -> tuple[Layer, ...]:
    """Return what stands before the scene: its own right half at another depth, an object that goes by."""
    width, height = geometry.width, geometry.height
    layers = []
    if chosen.second_plane_um:
        layers.append(Layer(stack, (width // 2, 0, width - width // 2, height), chosen.second_plane_um))
    if chosen.object_px_s:
        side = height // 3
        own = _stack(OBJECT_SCENE, geometry, chosen.brightness)
        layers.append(Layer(own, (0, (height - side) // 2, side, side), velocity_px_s=chosen.object_px_s))
    return tuple(layers)


def _geometry(chosen: SimSettings) -> Geometry:
    if chosen.camera not in CAMERAS:
        raise ConfigError(f"sim.camera is {chosen.camera!r}; known: {', '.join(CAMERAS)}")
    full = CAMERAS[chosen.camera]
    geometry = Geometry(chosen.width or full.width, chosen.height or full.height)
    if not (16 <= geometry.width <= full.width and 16 <= geometry.height <= full.height):
        raise ConfigError(
            f"sim.width, sim.height are {geometry.width}, {geometry.height}; a simulated {chosen.camera} has 16 to "
            f"{full.width} columns and 16 to {full.height} rows"
        )
    if chosen.lag_us <= 0 or not 0 <= chosen.mismatch <= LARGEST_MISMATCH:
        raise ConfigError(
            f"sim.lag_us is {chosen.lag_us:g} and must be more than 0; sim.mismatch is {chosen.mismatch:g} and must "
            f"lie in 0 to {LARGEST_MISMATCH:g}, or some pixels would have no threshold"
        )
    if chosen.drift_um_s and chosen.cam:
        raise ConfigError("sim.drift_um_s and sim.cam do not go together: the truth would not know where focus is")
    if chosen.depth_of_focus_um <= 0 or chosen.brightness <= 0:
        raise ConfigError("sim.depth_of_focus_um and sim.brightness must be more than 0; use sim.cap for darkness")
    if chosen.flicker_shape not in LAMP_SHAPES or not 0 <= chosen.flicker_depth <= 1:
        raise ConfigError(
            f"sim.flicker_shape is {chosen.flicker_shape!r}, sim.flicker_depth {chosen.flicker_depth:g}; known shapes: "
            f"{', '.join(LAMP_SHAPES)}; the depth lies between 0 and 1"
        )
    if not 0 < chosen.overexposed < 1 or chosen.rate_limit_mev_s < 0:
        raise ConfigError("sim.overexposed lies between 0 and 1, sim.rate_limit_mev_s is 0 (none) or more")
    return geometry


def _place(chosen: SimSettings) -> tuple[float, float]:
    """Return true focus and where the lens begins, a whole step, in um of travel."""
    low = max(ROOM_UM, -chosen.start_um)
    high = min(chosen.travel_um - ROOM_UM, chosen.travel_um - chosen.start_um)
    if low > high:
        raise ConfigError(
            f"sim.start_um is {chosen.start_um:g}, too far for a travel of {chosen.travel_um:g} um with {ROOM_UM:g} um "
            "of room at the ends; start nearer, or raise sim.travel_um"
        )
    drawn_um = float(random_stream(chosen.seed, "focus").uniform(low, high))
    steps = (drawn_um + chosen.start_um) / chosen.um_per_step
    last = int(chosen.travel_um / chosen.um_per_step)
    start_um = min(max(round(steps), 0), last) * chosen.um_per_step
    return start_um - chosen.start_um, start_um


def _mechanics(chosen: SimSettings) -> LensMechanics:
    return LensMechanics(
        um_per_step=chosen.um_per_step,
        travel_um=chosen.travel_um,
        backlash_um=chosen.backlash_um,
        microstep_error_um=chosen.microstep_error_um,
    )


def _lens(
    chosen: SimSettings, world: World, mechanism: SimulatedLens, iris: StepperIris | None
) -> tuple[Lens, MemoryPort]:
    wanted = Wanted(chosen.um_per_step, chosen.travel_um, 3 * chosen.speed_um_s, chosen.acceleration_um_s2)
    port, table = fitted(chosen.board, mechanism, wanted, world, seed=chosen.seed)
    world.add(port)
    if chosen.sync_steps:
        if not isinstance(port.wire.board, TriggerLine):
            raise ConfigError(f"sim.sync_steps: the board {chosen.board!r} has no sync line; sim.board=avr has")
        table = {**table, "sync_steps": chosen.sync_steps}
    if iris is not None:
        if not isinstance(port.wire.board, TurnsIris):
            raise ConfigError(
                f"sim.iris_steps: the board {chosen.board!r} has no second axis here; scf4, theia, tmcl and zaber have"
            )
        port.wire.board.add_iris(iris)
        table = {**table, "iris_axis": port.wire.board.iris_axis, "iris_open": chosen.iris_steps}
        table["iris_speed_sps"] = chosen.iris_speed_sps
    lens = controller(chosen.board).open_lens(table, world, port)
    if not lens.capabilities.stop_on_command:  # nor does such a controller remember where it is: as a person would
        here = Steps(round(mechanism.rotor_at(world.now_ns())))
        lens.home(after_ms(world.now_ns(), HOMING_MS))
        lens.move_to(here, lens.limits.max_speed_sps)
        _at_rest(lens, world)
    return lens, port


def _at_rest(lens: Lens, world: World) -> LensReport:
    """Return the first report of rest."""
    while True:
        report = lens.poll()
        if report is not None and not report.moving:
            return report
        world.sleep_until(after_ms(world.now_ns(), 1.0))


def _aperture(chosen: SimSettings, world: World) -> SimulatedAperture:
    return SimulatedAperture(
        world,
        random_stream(chosen.seed, "aperture"),
        opening_ms=chosen.aperture_ms,
        profile=chosen.aperture_profile,
        fault="stuck" if chosen.aperture_stuck else "slow" if chosen.aperture_slow else None,
    )


def _iris_on(lens: Lens, chosen: SimSettings) -> LensOutputAperture:
    """Return the iris as whoever owns the rig would describe it: so long it takes to its stop, at the most."""
    way_ms = 1000.0 * INTO_STOP * chosen.iris_steps / chosen.iris_speed_sps
    table = {"output": IRIS, "opening_ms": max(way_ms, IRIS_HOMING_MS) + IRIS_SPARE_MS}
    return aperture_on_lens(table, lens)


def _camera(
    chosen: SimSettings, world: World, light: LightField, geometry: Geometry, line: TriggerLine | None
) -> SimulatedCamera:
    seed, width, height = chosen.seed, geometry.width, geometry.height
    sensor = EventSensor(
        width,
        height,
        random_stream(seed, "pattern"),
        random_stream(seed, "noise"),
        noise_hz=chosen.noise_hz / chosen.brightness,
        leak_hz=chosen.leak_hz,
        hot_pixels=chosen.hot_pixels,
        hot_pixel_hz=chosen.hot_pixel_hz,
        mismatch=chosen.mismatch,
        lag_us=chosen.lag_us,
        focus=BiasLevels(chosen.contrast_on, chosen.contrast_off, chosen.refractory_us),
        memories=chosen.memories,
    )
    davis = chosen.camera == "davis346"
    frames = ApsFrames(width, height, random_stream(seed, "frames"), chosen.overexposed) if davis else None
    wire: Wire = ArrayWire() if davis else Evt3Wire(width)
    born_ns = world.now_ns()
    return SimulatedCamera(
        world,
        Retina(sensor, light, born_ns, frames),
        wire,
        geometry,
        birth_ns=born_ns,
        origin_us=int(random_stream(seed, "clock").integers(1_000_000, 20_000_000)),
        jitter=random_stream(seed, "usb"),
        frames=frames,
        mask_slots=MASK_SLOTS[chosen.camera],
        serial=f"simulated-{seed}",
        ring_packets=chosen.ring_packets,
        trigger_line=line,
        rate_limit=RateLimit(chosen.rate_limit_mev_s, told=chosen.rate_limit_told),
        faults=CameraFaults(
            chosen.camera_vanishes_at_s, chosen.camera_silent_from_s, chosen.drop_from_s, chosen.drop_for_s
        ),
    )
