"""A case of the benchmark lived through by the controller."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from benchmarks.cases import Case, make
from benchmarks.cycles import live_through
from benchmarks.methods import CYCLE, all_methods, run_method
from benchmarks.rig import CaseAperture, build_rig
from benchmarks.runner import wanted_pairs
from benchmarks.sets import APERTURE_US, MAP, SETS
from elpd_drivers.sim.world import BIRTH_NS

from elpd.errors import CameraError
from elpd.units import NS_PER_US

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def small() -> Iterator[None]:
    """Make the sets small: less to render."""
    kept = dict(SETS)
    for name in ("davis-dark", "evk4-bright"):
        SETS[name] = replace(SETS[name], size_px=96, margin_px=16, start_um=-120.0, step_us=500)
    yield
    SETS.clear()
    SETS.update(kept)


@pytest.mark.usefixtures("small")
def test_in_the_dark_focus_is_crossed_again_and_known_better_than_by_one_pass() -> None:
    case = Case("davis-dark", "camera", 1, "static", 5)
    lived = live_through(case, "20")
    assert lived.reason == ""
    assert lived.direction == "approaching"
    assert lived.again_ms > 20.0
    assert lived.focusing_ms is not None
    assert lived.focusing_ms > 60.0 + lived.again_ms  # the way to focus alone takes 60 ms
    assert lived.error_um is not None
    assert abs(lived.error_um) < 3.0
    assert lived.estimate_um == pytest.approx(lived.error_um, abs=0.5)  # a step, and what the lens still swings
    assert lived.sigma_um is not None
    assert lived.one_pass_sigma_um is not None
    assert lived.sigma_um < 0.5 * lived.one_pass_sigma_um
    assert lived.decided_um is not None
    assert lived.decided_um > 0.0
    again = live_through(case, "20")
    assert replace(again, cpu_ms=0.0) == replace(lived, cpu_ms=0.0)


@pytest.mark.usefixtures("small")
def test_an_aperture_opens_first_where_there_are_no_frames() -> None:
    case = Case("evk4-bright", "camera", 1, "static", 5)
    row = run_method(all_methods()[CYCLE], MAP, make(case))
    assert (row.reason, row.method, row.rate) == ("", CYCLE, MAP)
    assert row.error_um is not None
    assert abs(row.error_um) < 3.0
    assert row.again_ms is not None
    assert row.details["direction"] == "approaching"
    assert {one["name"] for one in row.details["contributions"]} <= {"pairs", "vertex"}


def test_nothing_to_see_is_refused_and_says_why() -> None:
    lived = live_through(Case("nothing", "cap", 1, "static", 5), "20")
    assert lived.error_um is None
    assert lived.focusing_ms is None
    assert lived.reason.startswith("NO_TEXTURE")


@pytest.mark.usefixtures("small")
def test_the_camera_sends_the_first_frame_and_no_other_at_1_fps_and_ends_with_its_case() -> None:
    parts, camera, glass = build_rig(Case("davis-dark", "camera", 1, "static", 5), "1")
    with pytest.raises(CameraError, match="between start and stop"):
        camera.read(0.01)
    camera.start()
    frames = []
    for _ in range(200):
        packet = camera.read(0.01)
        assert packet is not None
        assert packet.complete_until_us is not None
        assert packet.received_ns == parts.clock.now_ns()
        assert packet.received_ns >= BIRTH_NS + packet.complete_until_us * NS_PER_US
        frames += packet.frames
    assert camera.read(1e-5) is None  # no packet is due so soon
    (frame,) = frames
    assert frame.exposure_us == 20_000
    assert frame.available_us - frame.t_us == 14_000
    assert glass.defocus_um(parts.clock.now_ns()) == pytest.approx(-120.0, abs=0.32)
    camera.stop()
    with pytest.raises(CameraError):
        camera.read(0.01)


def test_the_aperture_opens_evenly_and_once() -> None:
    class Clock:
        now = 0

        def now_ns(self) -> int:
            return self.now

    clock = Clock()
    aperture = CaseAperture(clock)  # type: ignore[arg-type]  # it asks for the time only
    assert aperture.opened(5) == 0.0
    aperture.open()
    clock.now = APERTURE_US * NS_PER_US // 2
    aperture.open()
    assert aperture.opened(clock.now) == 0.5
    assert aperture.opened(10 * clock.now) == 1.0
    aperture.close()
    assert aperture.opened(clock.now) == 0.0


def test_cycles_are_run_where_the_lens_can_be_steered() -> None:
    assert wanted_pairs("syn", [CYCLE], ["50", "1"]) == ((CYCLE, "50"), (CYCLE, "1"))
    assert wanted_pairs("evk4-dark", [CYCLE], ["50"]) == ((CYCLE, MAP),)
    assert wanted_pairs("third-c05", [CYCLE], ["50"]) == ()
    assert wanted_pairs("flicker", [CYCLE], ["50"]) == ()
