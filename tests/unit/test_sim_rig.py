"""The simulated rig as the controller gets it: real bytes, a real lens driver, and a truth to be judged by."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from elpd_drivers.sim.rig import SimulatedTruth, build_rig

from elpd.errors import ConfigError
from elpd.events.evt3 import Evt3Decoder
from elpd.records import BiasSet, Encoding, FocusResult, Outcome, Roi, StopMode
from elpd.units import HostNs, Steps

if TYPE_CHECKING:
    from elpd.ports import RigParts

SMALL = {"width": 128, "height": 96}


def _rest(rig: RigParts, ms: float) -> list[np.ndarray]:
    """Let time pass, reading the camera and polling the lens; return what the camera sent."""
    end, sent = rig.clock.now_ns() + round(ms * 1e6), []
    while rig.clock.now_ns() < end:
        packet = rig.camera.read(0.001)
        rig.lens.poll()
        if packet is not None:
            sent.append(packet.data.copy())
    return sent


def _truth(rig: RigParts) -> SimulatedTruth:
    assert isinstance(rig.truth, SimulatedTruth)
    return rig.truth


def _sweep(settings: dict[str, Any]) -> tuple[RigParts, list[np.ndarray]]:
    rig = build_rig({**SMALL, **settings})
    assert rig.aperture is not None
    rig.camera.start()
    rig.camera.apply_biases(BiasSet.EXPOSE)
    sent = _rest(rig, 5)
    rig.aperture.open()
    sent += _rest(rig, 30)
    rig.camera.apply_biases(BiasSet.FOCUS)
    sent += _rest(rig, 5)
    direction = 1 if settings.get("start_um", -200) < 0 else -1
    rig.lens.run(direction * 4000 / rig.um_per_step, HostNs(rig.clock.now_ns() + 10**9))
    sent += _rest(rig, 70)
    rig.lens.stop(StopMode.ABRUPT)
    sent += _rest(rig, 30)
    return rig, sent


def _digest(sent: list[np.ndarray]) -> str:
    return hashlib.sha256(b"".join(words.tobytes() for words in sent)).hexdigest()


def test_the_default_rig_opens_its_aperture_and_sweeps_through_focus() -> None:
    rig, sent = _sweep({"seed": 4})
    assert rig.camera.geometry.width == 128
    truth = _truth(rig)
    assert 0 < truth.carriage_error_um() < 100
    events = Evt3Decoder(rig.camera.geometry).feed(np.concatenate(sent))
    assert (np.diff(events.t) >= 0).all()
    assert len(events.t) > 2 * 128 * 96 * 0.9  # about one each in the opening, and more in the sweep


def test_the_same_seed_sends_the_same_bytes_and_another_does_not() -> None:
    assert _digest(_sweep({"seed": 4})[1]) == _digest(_sweep({"seed": 4})[1])
    assert _digest(_sweep({"seed": 4})[1]) != _digest(_sweep({"seed": 5})[1])


def test_one_parts_randomness_does_not_disturb_another() -> None:
    calm, shaking = build_rig(SMALL | {"seed": 3}), build_rig(SMALL | {"seed": 3, "motion": "shake", "hot_pixels": 5})
    assert _truth(calm).focus_carriage_um == _truth(shaking).focus_carriage_um
    assert _truth(calm).scene == _truth(shaking).scene


@pytest.mark.parametrize("start_um", [-200.0, 200.0, -900.0, 0.0])
def test_the_lens_begins_referenced_at_rest_beside_focus(start_um: float) -> None:
    for seed in range(5):
        rig = build_rig(SMALL | {"seed": seed, "start_um": start_um})
        truth = _truth(rig)
        assert truth.carriage_error_um() == pytest.approx(start_um, abs=1e-6)
        assert 300 - 1 <= truth.focus_carriage_um <= 2200 + 1
        steps = rig.lens.position_at(rig.clock.now_ns()).steps
        assert steps * rig.um_per_step == pytest.approx(truth.focus_carriage_um + start_um, abs=0.01)


@pytest.mark.parametrize("sign", [1, -1])
def test_moving_the_motor_to_the_told_focus_from_the_told_side_brings_the_glass_there(sign: int) -> None:
    rig = build_rig(SMALL | {"seed": 8, "start_um": -200.0 * sign})
    truth = _truth(rig)
    focus_um = truth.focus_um(sign)
    assert focus_um is not None
    assert focus_um == pytest.approx(truth.focus_carriage_um + sign * 2.0)
    rig.lens.move_to(Steps(round(focus_um / rig.um_per_step)), 4000 / rig.um_per_step)
    rig.clock.sleep_until(HostNs(rig.clock.now_ns() + 200_000_000))
    assert abs(truth.carriage_error_um()) <= rig.um_per_step / 2 + 0.01


def _result(**numbers: Any) -> FocusResult:
    blank: dict[str, Any] = dict.fromkeys(("focus_um", "sigma_um", "stop_um", "final_um", "stop_latency_us"))
    return FocusResult(
        **{**blank, **numbers}, outcome=Outcome.FOCUSED, reason="", reversals=0, duration_ms=1.0, phases=(), events=0,
        lost=0, details={"sweep_sign": 1},
    )  # fmt: skip


def test_errors_are_signed_and_missing_where_the_result_has_no_number() -> None:
    rig = build_rig(SMALL | {"seed": 8})
    truth = _truth(rig)
    focus_um = truth.focus_carriage_um + 2.0
    errors = truth.errors(_result(focus_um=focus_um + 0.5, stop_um=focus_um + 20.0, final_um=0.0))
    assert errors["focus_um"] == pytest.approx(focus_um)
    assert errors["estimate_error_um"] == pytest.approx(0.5)
    assert errors["stop_error_um"] == pytest.approx(20.0)
    assert errors["final_error_um"] == pytest.approx(-200.0)
    nothing = truth.errors(_result())
    assert [nothing[key] for key in ("estimate_error_um", "stop_error_um", "final_error_um")] == [None] * 3


def test_the_davis_has_frames_and_arrays_and_no_aperture() -> None:
    rig = build_rig({"camera": "davis346", "seed": 2, "scene": "coffee"})
    assert rig.aperture is None
    rig.camera.start()
    packet = rig.camera.read(0.1)
    assert packet is not None
    assert packet.encoding is Encoding.ARRAY
    frames = 0
    for _ in range(100):
        packet = rig.camera.read(0.1)
        frames += len(packet.frames) if packet else 0
    assert frames == 3


@pytest.mark.parametrize("board", ["tic", "grbl", "tmcl", "scf4", "theia", "zaber"])
def test_every_board_turns_the_lens(board: str) -> None:
    rig = build_rig(SMALL | {"seed": 1, "board": board})
    truth = _truth(rig)
    rig.lens.run(4000 / rig.um_per_step, HostNs(rig.clock.now_ns() + 150_000_000))
    rig.clock.sleep_until(HostNs(rig.clock.now_ns() + 400_000_000))
    assert truth.carriage_error_um() > -150


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"colour": 1}, r"sim\.colour: unknown key"),
        ({"scene": "moon"}, r"sim\.scene is 'moon'"),
        ({"motion": "wobble"}, r"sim\.motion is 'wobble'"),
        ({"camera": "evk9"}, r"sim\.camera is 'evk9'; known: evk4, davis346"),
        ({"board": "abacus"}, r"sim\.board is 'abacus'; known: tic, grbl, avr, tmcl, scf4, theia, zaber"),
        ({"width": 2000}, r"sim\.width, sim\.height are 2000, 720"),
        ({"start_um": 2400.0}, r"sim\.start_um is 2400, too far"),
        ({"brightness": 0.0}, r"sim\.brightness"),
        ({"seed": "x"}, r"sim\.seed: 'x' is not a int"),
    ],
)
def test_nonsense_is_refused_by_name(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_rig(settings)


def test_a_hardware_window_limits_what_is_sent() -> None:
    rig = build_rig(SMALL | {"seed": 1, "noise_hz": 50.0, "aperture_ms": 5.0})
    rig.camera.start()
    rig.camera.set_window(Roi(32, 16, 32, 32))
    events = Evt3Decoder(rig.camera.geometry).feed(np.concatenate(_rest(rig, 50)))
    assert len(events.t) > 100
    assert (events.x.min(), events.x.max()) == (32, 63)
    assert (events.y.min(), events.y.max()) == (16, 47)
