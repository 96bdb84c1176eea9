"""The sets of cases: which lens, speed, sensor, light and motion.

``syn`` is the paper's synthetic set built again: 7 scenes x 4 fields of view x 3 motions = 84 sweeps of one second from
-400 to +400 um, 200 x 200 pixels, frames at 1, 20 and 50 fps, in the reading that reproduces the paper's table
(threshold 0.05, motion in pixels of the 600 x 600 picture). ``syn-std`` is the same with v2e's default threshold of 0.2
and motion in the sensor's pixels, which is harder. Frames are instantaneous and noise-free, as in the paper.

The ``davis`` and ``evk4`` sets are like the paper's rig: 2 mm/s, 200 um either side of focus, a depth of focus of 6 um
(the same traced lens, 2.67 um of defocus to a um of travel), bright or dark, the scene still, moving as in a hand, or
shaking. Only the region that matters is simulated, with a margin, in place of the whole sensor. ``davis`` has frames,
noisy ones, exposed for 5 ms in good light (as in the simulated rig) and 20 ms in the dark: the light of every 250 us
of the exposure is averaged, so scene and lens blur them as they go on moving (10 and 40 um of travel), and a frame is
there only when its read-out of 4 ms is over. Its time stamp is the middle of its exposure. ``evk4`` has no frames: its
record begins with an aperture that opens in 20 ms, from which a picture must be made.

``flicker``, ``nothing`` and ``noise`` are there to be refused: a lamp that flickers by 30 %; a wall, a grey card and a
lens cap, of which nothing but noise can be seen; and the
same with a sensor that makes 20 Hz of noise in every pixel.

The ``third`` sets are recorded (``--recorded``), not made here.
"""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.retina import RetinaSettings
from benchmarks.scenes import BLANKS, SCENES

SECOND_US = 1_000_000

FRAME_PERIODS_US = {"50": 20_000, "20": 50_000, "1": SECOND_US}
"""Frame rates by name; at 1 fps there is the first frame and no other."""

MAP = "map"
"""In place of a frame rate: the one picture that an opening aperture gives."""

REBUILT = "rebuilt"
"""In its place, for the ablation: a picture made from the first events of the sweep by a high-pass filter."""

E2VID = "e2vid"
"""The same by E2VID, where there are weights for it."""


@dataclass(frozen=True, slots=True)
class CaseSet:
    """What is common to a set's cases.

    Lengths in um are of lens travel; ``defocus_per_um`` turns them into defocus behind the traced lens. ``motion_px``
    is a pixel of motion in pixels of the sensor, ``flicker`` the amplitude of a 100 Hz lamp. ``rates`` are the frame
    rates that exist. ``expose`` is the sensor's setting while the aperture opens, ``None`` without an aperture.
    Frames gather light for ``exposure_us``, a multiple of two steps or none at all, and are there ``read_out_us``
    later.
    """

    name: str
    about: str
    retina: RetinaSettings
    motions: tuple[str, ...]
    fields: tuple[int, ...]
    rates: tuple[str, ...]
    motion_px: float = 1.0
    size_px: int = 200
    margin_px: int = 8
    border_px: int = 10
    start_um: float = -400.0
    speed_um_s: float = 800.0
    defocus_per_um: float = 1.0
    depth_of_focus_um: float = 16.0
    step_us: int = 1_000
    keep_every_us: int = 10_000
    frame_noise_dn: float = 0.0
    exposure_us: int = 0
    read_out_us: int = 0
    expose: RetinaSettings | None = None
    scenes: tuple[str, ...] = SCENES
    flicker: float = 0.0

    @property
    def nothing_there(self) -> bool:
        """Whether there is nothing to focus on, so that every answer is wrong."""
        return self.scenes == BLANKS

    @property
    def sweep_begin_us(self) -> int:
        """When the lens starts: after the aperture has opened and rested."""
        return 0 if self.expose is None else APERTURE_US + APERTURE_REST_US

    @property
    def frame_age_us(self) -> int:
        """How old the middle of a frame's exposure is when the frame is there."""
        return self.read_out_us + self.exposure_us // 2

    @property
    def truth_us(self) -> float:
        """When the PSF has its least RMS radius."""
        return self.sweep_begin_us - self.start_um / self.speed_um_s * SECOND_US

    @property
    def end_us(self) -> int:
        """When the sweep ends, as far behind focus as it began before it."""
        return round(self.sweep_begin_us - 2.0 * self.start_um / self.speed_um_s * SECOND_US)

    @property
    def um_per_us(self) -> float:
        """Lens travel per microsecond."""
        return self.speed_um_s / SECOND_US

    def position_um(self, t_us: float) -> float:
        """Return where the lens is, 0 in focus."""
        return self.start_um + self.um_per_us * max(t_us - self.sweep_begin_us, 0.0)


APERTURE_US = 20_000
APERTURE_REST_US = 5_000
_READ_OUT_US = 4_000

# The setting under which the paper's code reproduces the paper's table (third-party finding), and v2e's defaults.
C05 = RetinaSettings(0.05, 0.05, 0.01)
STD = RetinaSettings(0.2, 0.2, 0.03)
# A photoreceptor of 2 kHz in good light; ten times slower and fifty times noisier in the dark.
BRIGHT = RetinaSettings(0.2, 0.2, 0.02, cutoff_hz=2_000.0, leak_rate_hz=0.1, shot_noise_rate_hz=0.1)
DARK = RetinaSettings(0.2, 0.2, 0.02, cutoff_hz=200.0, leak_rate_hz=0.1, shot_noise_rate_hz=5.0)
NOISY = RetinaSettings(0.2, 0.2, 0.02, cutoff_hz=200.0, leak_rate_hz=0.1, shot_noise_rate_hz=20.0)
# Biases for the aperture: a high ON threshold, and a refractory period that leaves one event to a pixel.
EXPOSE = RetinaSettings(
    0.4, 0.4, 0.02, cutoff_hz=3_000.0, shot_noise_rate_hz=0.1, refractory_period_s=1.0, settled=True
)

_PICTURES = (MAP, REBUILT, E2VID)
_PAPER_MOTIONS = ("static", "moderate", "violent")
_RIG_MOTIONS = ("static", "dynamic", "shake")


def _rig(name: str, about: str, retina: RetinaSettings, rates: tuple[str, ...], **more: object) -> CaseSet:
    common: dict[str, object] = {
        "motions": _RIG_MOTIONS,
        "fields": (1,),
        "margin_px": 40,
        "start_um": -200.0,
        "speed_um_s": 2_000.0,
        "defocus_per_um": 16.0 / 6.0,
        "depth_of_focus_um": 6.0,
        "step_us": 250,
    }
    return CaseSet(name, about, retina, rates=rates, **(common | more))  # type: ignore[arg-type]  # fields by name


def _davis(name: str, about: str, retina: RetinaSettings, **more: object) -> CaseSet:
    common: dict[str, object] = {
        "rates": ("50", "1"),
        "size_px": 160,
        "frame_noise_dn": 1.0,
        "exposure_us": 5_000,
        "read_out_us": _READ_OUT_US,
    }
    return _rig(name, about, retina, **(common | more))  # type: ignore[arg-type]  # fields by name


_DIM: dict[str, object] = {"rates": ("20", "1"), "frame_noise_dn": 4.0, "exposure_us": 20_000}
_BLANK: dict[str, object] = {"fields": (1, 2, 3, 4), "scenes": BLANKS}

SETS = {
    one.name: one
    for one in (
        CaseSet("syn", "the paper's synthetic set", C05, _PAPER_MOTIONS, (1, 2, 3, 4), ("50", "20", "1"), 1.0 / 3.0),
        CaseSet("syn-std", "the same, threshold 0.2", STD, _PAPER_MOTIONS, (1, 2, 3, 4), ("50", "20", "1")),
        CaseSet("third-c05", "third-party sweeps, threshold 0.05", C05, (), (), ("50", "20", "1"), 1.0 / 3.0),
        CaseSet("third-std", "third-party sweeps, threshold 0.2", STD, (), (), ("50", "20", "1")),
        _davis("davis-bright", "like a DAVIS346, bright", BRIGHT),
        _davis("davis-dark", "like a DAVIS346, dark", DARK, **_DIM),
        _rig("evk4-bright", "like an EVK4, events only, bright", BRIGHT, _PICTURES, size_px=240, expose=EXPOSE),
        _rig("evk4-dark", "like an EVK4, events only, dark", DARK, _PICTURES, size_px=240, expose=EXPOSE),
        _davis("flicker", "like a DAVIS346, bright, a lamp of 30 %", BRIGHT, flicker=0.3),
        _davis("nothing", "like a DAVIS346, dark, nothing to see", DARK, **_DIM, **_BLANK),
        _davis("noise", "the same, 20 Hz of noise a pixel", NOISY, **_DIM, **_BLANK),
    )
}
