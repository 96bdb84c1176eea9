"""`elpd calibrate lens`: stops that were measured are the stops that come; a table becomes the ruler."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from command_line import Answer, caller
from elpd_drivers.sim.boards import avr
from lens_rigs import KINDS, SPEED_SPS, UM_PER_STEP, Rig, open_rig, rig
from structlog.testing import capture_logs

from elpd import rig as rigs
from elpd.calibrate.in_use import as_measured
from elpd.calibrate.lens import Stopping, lens_profile, measure_lens, teach, with_part
from elpd.calibrate.lens import keep as keep_profile
from elpd.calibrate.lens_live import LensBench, lost_steps
from elpd.calibrate.profile import MeasuredOn
from elpd.calibrate.stops import Cruise, StopTrial, measure_stops
from elpd.config import load
from elpd.errors import ConfigError, UsageError
from elpd.ports import LearnsStops
from elpd.records import StopMode
from elpd.scale import LensScale

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SPEED_UM_S = 4000.0


def trials(seed: int, onset_ms: float, scatter_ms: float, deceleration_sps2: float) -> list[StopTrial]:
    """Stops of a motor that counts whole steps, reported within half a millisecond."""
    random = np.random.default_rng(seed)
    made = []
    for speed_sps in (3000.0, 6000.0, 9000.0, 12_000.0):
        for sign in (1, -1) * 4:
            sent_ns = 10**9 + int(random.integers(10**7))
            earliest = sent_ns - np.arange(60, 4, -6) * 10**6 + random.integers(0, 10**5, 10)
            sampled_s = 1e-9 * (earliest + 250_000 - sent_ns)
            cruise = Cruise(np.floor(sign * speed_sps * sampled_s), earliest, earliest + 500_000)
            late_s = 1e-3 * random.normal(onset_ms, scatter_ms)
            way = speed_sps * late_s + speed_sps**2 / (2 * deceleration_sps2)
            made.append(StopTrial(StopMode.RAMPED, sign * speed_sps, cruise, sent_ns, np.floor(sign * way), 60.0, 1.0))
    return made


def test_onset_and_deceleration_lie_within_their_errors() -> None:
    scores = []
    for seed in range(30):
        found = measure_stops(trials(seed, 45.0, 3.0, 400_000.0), set_sps2=4_000_000.0)
        onset, braking, scatter = found.onset_ms, found.deceleration_sps2, found.onset_scatter_ms
        assert onset.value is not None
        assert onset.sigma is not None
        assert braking.value is not None
        assert braking.sigma is not None
        assert scatter.value == pytest.approx(3.0, abs=1.5)
        scores += [(onset.value - 45.0) / onset.sigma, (braking.value - 400_000.0) / braking.sigma]
    assert np.mean(np.abs(scores) < 2) >= 0.9
    assert np.sqrt(np.mean(np.square(scores))) > 0.4, "errors that are far too wide are no use"


def test_a_ramp_that_is_as_set_makes_the_onset_better_known() -> None:
    found = measure_stops(trials(1, 1.0, 0.1, 1_280_000.0), set_sps2=1_280_000.0)
    timing = found.timing()
    assert timing is not None
    assert timing.deceleration_sps2 is None
    assert found.onset_ms.sigma is not None
    assert found.set_ramp_onset_ms.sigma is not None
    assert found.set_ramp_onset_ms.sigma < found.onset_ms.sigma
    assert timing.onset_ms == pytest.approx(1.0, abs=0.3)


def test_stops_from_no_steady_speed_are_no_evidence() -> None:
    moving = trials(2, 45.0, 3.0, 400_000.0)
    unsteady = [
        StopTrial(one.mode, 2 * one.speed_sps, one.cruise, one.sent_ns, one.rest_steps, 60.0, 1.0) for one in moving
    ]
    found = measure_stops(unsteady)
    assert found.timing() is None
    assert "0 of 32 stops came from a steady speed" in (found.onset_ms.reason or "")


def test_stops_before_which_nothing_was_heard_are_left_out_and_said_to_be() -> None:
    made = trials(3, 45.0, 3.0, 400_000.0)
    nothing = Cruise(np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64))
    deaf = [StopTrial(one.mode, one.speed_sps, nothing, one.sent_ns, one.rest_steps, 60.0, 1.0) for one in made]
    some = measure_stops([*made, *deaf[:5]], set_sps2=4_000_000.0)
    assert some.timing() == measure_stops(made, set_sps2=4_000_000.0).timing()
    assert "before 32 of them fewer than 4 reports came" in (measure_stops(deaf).onset_ms.reason or "")


def bench(made: Rig, repeats: int = 2) -> LensBench:
    return LensBench(made.clock, made.lens, LensScale(UM_PER_STEP), speed_um_s=SPEED_UM_S, repeats=repeats)


@pytest.mark.parametrize("kind", KINDS)
def test_a_measured_stop_is_the_next_one_that_comes(kind: str) -> None:
    made = open_rig(kind)
    if not made.lens.capabilities.stop_on_command:
        with pytest.raises(UsageError, match="cannot stop on command"):
            bench(made).measure(homing=False)
        return
    stopping = measure_lens(bench(made).measure(homing=False))
    timings = stopping.timings()
    assert isinstance(made.lens, LearnsStops)
    made.lens.learn_stops(timings)
    mode = StopMode.ABRUPT if made.lens.capabilities.abrupt_stop else StopMode.RAMPED
    timing, speed_sps = timings[mode], 0.6 * SPEED_SPS
    assert made.lens.capabilities.stop_onset_ms == timing.onset_ms
    made.lens.move_to(3200, SPEED_SPS)
    made.live(400)
    made.lens.run(speed_sps, made.soon(1000))
    made.live(100)
    sent_at = made.rotor
    made.lens.stop(mode)
    made.live(100)
    deceleration = timing.deceleration_sps2 or (np.inf if mode is StopMode.ABRUPT else stopping.acceleration_sps2)
    expected = speed_sps * timing.onset_ms / 1000 + speed_sps**2 / (2 * deceleration)
    sigma = speed_sps * timing.onset_sigma_ms / 1000
    assert abs(made.rotor - sent_at - expected) < 3 * sigma + 1.5, (timing, expected)
    assert stopping.round_trip_ms.value is not None


def test_steps_that_were_lost_are_found_by_homing_again() -> None:
    for lost in (0, 600):
        made = open_rig("tic")
        calibration = bench(made)
        before = calibration._stops

        def stops(mode: StopMode, *, before: Any = before, made: Rig = made, lost: int = lost) -> list[StopTrial]:
            done: list[StopTrial] = before(mode)
            if lost and mode is StopMode.ABRUPT:
                made.motor.slip(made.clock.now_ns(), -float(lost))
            return done

        calibration._stops = stops  # type: ignore[method-assign]
        stopping = measure_lens(calibration.measure(homing=True))
        found = stopping.lost_steps
        assert found.sigma is not None
        assert found.sigma < 100
        assert found.value == pytest.approx(lost, abs=3 * found.sigma)
        assert any("steps were lost" in warning for warning in stopping.warnings) == bool(lost)


def test_homing_that_tells_nothing_says_so() -> None:
    assert lost_steps(100.0, (0.2, 0.2), (0.2, 0.2), 0.2).value is None


def test_an_adapter_that_holds_replies_back_is_named() -> None:
    made = rig("tic")
    quick = made.port.read_available

    held, since_ns = bytearray(), [0]

    def slow() -> bytes:
        if not held:
            since_ns[0] = made.clock.now_ns()
        held.extend(quick())
        if not held or made.clock.now_ns() < since_ns[0] + 10_000_000:  # the adapter's timer
            return b""
        data = bytes(held)
        held.clear()
        return data

    made.open()
    made.port.read_available = slow  # type: ignore[method-assign]
    stopping = measure_lens(bench(made).measure(homing=False))
    assert any("latency_timer" in warning and "setserial" in warning for warning in stopping.warnings)
    assert (stopping.round_trip_ms.value or 0.0) > 4.0


def test_a_lens_without_a_reference_or_without_room_is_refused() -> None:
    made = open_rig("tic", referenced=False)
    with pytest.raises(UsageError, match="home it first"):
        bench(made).measure(homing=False)
    made = open_rig("tic")
    made.lens._controller.limits = type(made.lens.limits)(3000, 3300, SPEED_SPS, made.lens.limits.acceleration_sps2)
    with pytest.raises(UsageError, match="the travel has"):
        bench(made).measure(homing=False)
    assert not made.moving


# --- the profile -------------------------------------------------------------------------------------------------


def stopping_of(kind: str) -> Stopping:
    return measure_lens(bench(open_rig(kind)).measure(homing=False))


def test_a_profile_of_another_lens_is_told_once(tmp_path: Path) -> None:
    grbl = ("sim.board=grbl", f"state.directory={tmp_path}")
    config = load(None, grbl)
    keep_profile(config, with_part(config, MeasuredOn.lens(config), stopping=stopping_of("grbl")))
    other = load(None, (*grbl, "sim.backlash_um=5.0"))
    with capture_logs() as logs:
        for _ in range(3):
            assert lens_profile(other) is None
            assert as_measured(other) is other
    assert [log["event"] for log in logs] == ["lens profile not used"]


def test_a_lens_that_cannot_be_stopped_has_no_stop_to_calibrate() -> None:
    theia = load(None, ["sim.board=theia", "state.profiles=false"])
    with rigs.lens_alone(theia) as (clock, lens, scale), pytest.raises(UsageError, match="no stop to calibrate"):
        LensBench(clock, lens, scale, speed_um_s=1000.0, repeats=2).measure(homing=False)


def test_a_profile_teaches_its_own_lens_and_no_other(tmp_path: Path) -> None:
    grbl = ("sim.board=grbl", f"state.directory={tmp_path}")
    config = load(None, grbl)
    stopping = stopping_of("grbl")
    stopping = stopping.model_copy(update={"acceleration_sps2": 400_000.0 / UM_PER_STEP})
    keep_profile(config, with_part(config, MeasuredOn.lens(config), stopping=stopping))
    taught = stopping.timings()[StopMode.RAMPED].onset_ms

    def onset_ms(*overrides: str) -> float:
        with rigs.lens_alone(load(None, (*grbl, *overrides))) as (_, lens, _):
            return float(lens.capabilities.stop_onset_ms)

    assert onset_ms() == taught != 45.0
    assert onset_ms("state.profiles=false") == 45.0
    assert onset_ms("sim.backlash_um=5.0") == 45.0, "another lens"
    parts = rigs.build(load(None, (*grbl, "state.profiles=false")))
    softer = stopping.model_copy(update={"acceleration_sps2": 100_000.0})
    keep_profile(config, with_part(config, MeasuredOn.lens(config), stopping=softer))
    teach(parts.lens, config)
    assert parts.lens.capabilities.stop_onset_ms == 45.0, "its ramps were set otherwise since"
    rigs.release(parts)


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


STATE = ("--set", "state.directory=state")


def test_the_command_measures_stores_and_draws(elpd: Callable[..., Answer], tmp_path: Path) -> None:
    options = ("--repeats", "2", "--plot", "lens.png", "--json", *STATE)
    answer = elpd("calibrate", "lens", *options)
    assert answer.code == 0, answer.err
    found = answer.json
    assert found["saved"] == "state/lens.json"
    assert found["stopping"]["abrupt"]["onset_ms"]["value"] == pytest.approx(0.2, abs=0.2)
    lost = found["stopping"]["lost_steps"]
    assert abs(lost["value"]) < 3 * lost["sigma"]
    assert found["stopping"]["warnings"] == []
    assert cv2.imread(str(tmp_path / "lens.png")).std() > 20
    words = elpd("calibrate", "lens", "--repeats", "2", "--dry-run", *STATE)
    assert "bites after" in words.out
    assert "stored" not in words.out
    damaged = tmp_path / "state" / "lens.json"
    damaged.write_text(damaged.read_text()[:200])
    assert elpd("home", "--foreground", *STATE, "--json").json["error"]["kind"] == "FormatError"


SET_SPS2 = 1_280_000.0


@pytest.mark.parametrize(
    ("board", "onset_ms"), [("avr", 0.2), ("grbl", 45.0), ("scf4", 0.3), ("tmcl", 1.2), ("zaber", 1.7)]
)
def test_the_command_measures_the_stops_of_every_board(
    elpd: Callable[..., Answer], tmp_path: Path, board: str, onset_ms: float
) -> None:
    if board == "avr" and avr.hindrance() is not None:
        pytest.skip(str(avr.hindrance()))
    answer = elpd(
        *("calibrate", "lens", "--repeats", "2", "--json", "--plot", "lens.png", *STATE),
        *("--set", f"sim.board={board}", "--set", "sim.seed=91"),
    )
    assert answer.code == 0, answer.err
    found = answer.json["stopping"]
    stop = found["abrupt"] or found["ramped"]
    onset = stop["onset_ms"] if stop["set_ramp_onset_ms"]["value"] is None else stop["set_ramp_onset_ms"]
    assert onset["value"] == pytest.approx(onset_ms, abs=4 * onset["sigma"] + 0.1 * onset_ms)
    braking = found["ramped"]["deceleration_sps2"]
    assert braking["value"] is None or abs(braking["value"] - SET_SPS2) < 4 * braking["sigma"]
    lost = found["lost_steps"]
    assert abs(lost["value"]) < 3 * lost["sigma"]
    assert (tmp_path / "state" / "lens.json").exists()
    assert cv2.imread(str(tmp_path / "lens.png")).std() > 20


def test_a_measured_table_is_the_ruler_unless_the_configuration_has_one(
    elpd: Callable[..., Answer], tmp_path: Path
) -> None:
    (tmp_path / "gauge.csv").write_text("steps,um\n0,0\n4000,1180.0\n8000,2500.0\n")
    answer = elpd("calibrate", "lens", "--table", "gauge.csv", "--json", *STATE)
    assert answer.code == 0, answer.err
    assert answer.json["steps_to_um"] == [[0, 0], [4000, 1180.0], [8000, 2500.0]]
    assert answer.json["stopping"] is None
    moved = elpd("move", "1180", "--foreground", "--json", *STATE).json
    assert moved["position_steps"] == pytest.approx(4000, abs=1)
    own = ("--set", "lens.steps_to_um=[[0, 0.0], [8000, 2400.0]]")
    assert elpd("move", "1200", "--foreground", "--json", *STATE, *own).json["position_steps"] == pytest.approx(4000)
    measured = elpd("calibrate", "lens", "--repeats", "2", "--no-home", "--json", *STATE).json
    assert measured["steps_to_um"] == answer.json["steps_to_um"], "the one part does not wipe the other out"
    assert measured["stopping"]["lost_steps"]["value"] is None


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("steps,um\n0,0\n10,x\n", r"gauge\.csv:3"),
        ("0,0\n10,3\n5,4\n", "ascend"),
        ("0,0\n", "one row"),
        ("\n", "no row"),
        ("0,0\n1000,312500\n", "micrometres"),
        ("0,0\n1000,nan\n", r"gauge\.csv:2"),
    ],
)
def test_a_table_that_is_none_is_refused_with_its_line(tmp_path: Path, text: str, told: str) -> None:
    from elpd.calibrate.lens import read_table  # noqa: PLC0415

    path = tmp_path / "gauge.csv"
    path.write_text(text)
    with pytest.raises((UsageError, ConfigError), match=told):
        read_table(path, UM_PER_STEP)
    with pytest.raises(UsageError, match="cannot be read"):
        read_table(tmp_path / "none.csv", UM_PER_STEP)


def test_without_profiles_the_configuration_is_the_same_object(tmp_path: Path) -> None:
    config = load(None, (f"state.directory={tmp_path}",))
    assert as_measured(config) is config
    (tmp_path / "lens.json").write_text(json.dumps({"kind": "lens", "version": 0}))
    assert as_measured(load(None, (f"state.directory={tmp_path}", "state.profiles=false"))).lens == config.lens
