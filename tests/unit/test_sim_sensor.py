"""The DVS model: its kernels against their twins, and its physics."""

from __future__ import annotations

import naive_sim
import numpy as np
import pytest
from elpd_drivers.sim.optics import Lamp
from elpd_drivers.sim.pixels import fire_noise, scratch, sort_events, step_pixels
from elpd_drivers.sim.sensor import MISMATCH_STEP, EventSensor
from elpd_drivers.sim.world import random_stream
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_rigs import Ramp, Setup, rank_correlation

from elpd.records import BiasSet, Roi

F = np.float32
QUIET = {"noise_hz": 0.0, "leak_hz": 0.0}


def _state(seed: int, n: int, begin_us: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    level = rng.normal(-2, 0.5, n).astype(F)
    return {
        "target": level + rng.normal(0, 0.4, n).astype(F),
        "level": level,
        "reference": level + rng.uniform(-0.15, 0.15, n).astype(F),
        "gain": rng.uniform(0.05, 0.95, n).astype(F),
        "spread_on": rng.integers(0, 256, n).astype(np.uint8),
        "spread_off": rng.integers(0, 256, n).astype(np.uint8),
        "held": rng.integers(0, 2, n).astype(np.uint8),
        "release_us": begin_us + rng.integers(-100, 700, n).astype(np.int64),
    }


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.sampled_from([1, 7, 64, 2500]),
    refractory_us=st.integers(1, 600),
    span_us=st.sampled_from([125, 250, 500]),
)
def test_step_equals_its_slow_twin(seed: int, n: int, refractory_us: int, span_us: int) -> None:
    begin_us = 10_000
    fast, slow = _state(seed, n, begin_us), _state(seed, n, begin_us)
    t, pixel, on = np.empty(200_000, np.int64), np.empty(200_000, np.int64), np.empty(200_000, np.uint8)
    outputs = (t, pixel, on)
    count = step_pixels(
        *fast.values(), F(0.18), F(0.21), F(MISMATCH_STEP), refractory_us, begin_us, begin_us + span_us, 0, *outputs,
        *scratch(),
    )  # fmt: skip
    expected = naive_sim.step_pixels(
        *slow.values(), 0.18, 0.21, MISMATCH_STEP, refractory_us, begin_us, begin_us + span_us
    )
    assert list(zip(t[:count].tolist(), pixel[:count].tolist(), on[:count].tolist(), strict=True)) == expected
    for name, value in fast.items():
        np.testing.assert_array_equal(value, slow[name], err_msg=name)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 300))
def test_noise_equals_its_slow_twin(seed: int, count: int) -> None:
    fast, slow = _state(seed, 50, 0), _state(seed, 50, 0)
    rng = np.random.default_rng(seed + 1)
    times = np.sort(rng.integers(0, 500, count))
    pixels, kinds = rng.integers(0, 50, count), rng.integers(0, 2, count).astype(np.uint8)
    dice = rng.random(count, F)
    t, pixel, on = np.empty(400, np.int64), np.empty(400, np.int64), np.empty(400, np.uint8)
    names = ("level", "reference", "held", "release_us")
    n = fire_noise(times, pixels, kinds, *(fast[k] for k in names), F(0.2), F(0.3), dice, 40, 0, t, pixel, on)
    candidates = list(zip(times.tolist(), pixels.tolist(), kinds.tolist(), strict=True))
    expected = naive_sim.fire_noise(candidates, *(slow[k] for k in names), 0.2, 0.3, dice, 40)
    assert list(zip(t[:n].tolist(), pixel[:n].tolist(), on[:n].tolist(), strict=True)) == expected
    np.testing.assert_array_equal(fast["release_us"], slow["release_us"])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 500))
def test_sorting_is_stable_and_finds_rows_and_columns(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    t, pixel = rng.integers(1000, 1500, count), rng.integers(0, 30 * 20, count)
    on = rng.integers(0, 2, count).astype(np.uint8)
    out_t, out_on = np.empty(count, np.int64), np.empty(count, np.uint8)
    x, y = np.empty(count, np.uint16), np.empty(count, np.uint16)
    sort_events(t, pixel, on, count, 1000, 500, 30, 100, 200, np.empty(501, np.int64), out_t, x, y, out_on)
    order = np.argsort(t, kind="stable")
    np.testing.assert_array_equal(out_t, t[order])
    np.testing.assert_array_equal(x, 100 + pixel[order] % 30)
    np.testing.assert_array_equal(y, 200 + pixel[order] // 30)
    np.testing.assert_array_equal(out_on, on[order])


def test_events_beyond_the_arbiters_capacity_are_counted_not_kept() -> None:
    state = _state(1, 100, 0)
    state["held"][:] = 0
    state["target"][:] = state["reference"] + 30
    few = np.empty(5, np.int64), np.empty(5, np.int64), np.empty(5, np.uint8)
    count = step_pixels(*state.values(), F(0.2), F(0.2), F(MISMATCH_STEP), 10_000, 0, 500, 0, *few, *scratch())
    assert count == 100


# --- physics -------------------------------------------------------------------------------------------------------


def test_a_still_scene_gives_only_noise_at_its_rate() -> None:
    quiet = Setup(sensor=QUIET).run(0.2)
    assert len(quiet) == 0
    noisy = Setup(sensor={"noise_hz": 5.0, "leak_hz": 0.0}).run(1.0)
    assert len(noisy) == pytest.approx(5.0 * 96 * 80, rel=0.05)
    assert noisy["on"].mean() == pytest.approx(0.5, abs=0.05)


def test_approaching_focus_bright_spots_brighten_and_events_vanish_at_focus() -> None:
    setup = Setup(Ramp(begin_s=0.01), sensor=QUIET, size=(160, 120))
    events = setup.run(0.12)  # from -200 um at 10 ms through focus at 60 ms to +200 um
    margin = 32
    log = np.log(setup.canvas)
    laplacian = np.zeros_like(log)
    laplacian[1:-1, 1:-1] = log[2:, 1:-1] + log[:-2, 1:-1] + log[1:-1, 2:] + log[1:-1, :-2] - 4 * log[1:-1, 1:-1]
    laplacian = laplacian[margin:-margin, margin:-margin]

    def elp(begin_us: int, end_us: int) -> float:
        part = events[(events["t"] >= begin_us) & (events["t"] < end_us)]
        return float(-np.sum(np.where(part["on"], 1, -1) * laplacian[part["y"], part["x"]]))

    assert elp(30_000, 58_000) > 0
    assert elp(64_000, 90_000) < 0
    rate, _ = np.histogram(events["t"], np.arange(20_000, 100_001, 1_000))
    assert rate[40:42].mean() < 0.2 * min(rate[:36].max(), rate[45:].max())


def test_event_count_is_symmetric_about_focus() -> None:
    # Over a whole sweep: hysteresis makes those after focus late, and mismatch of ON and OFF costs a few.
    events = Setup(Ramp(begin_s=0.01), sensor=QUIET, size=(160, 120)).run(0.15)
    before, after = np.sum(events["t"] < 60_000), np.sum(events["t"] >= 60_000)
    assert after == pytest.approx(before, rel=0.15)


def test_the_same_sweep_in_finer_steps_gives_nearly_the_same_events(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse = Setup(Ramp(begin_s=0.01), sensor=QUIET).run(0.1)
    monkeypatch.setattr("elpd_drivers.sim.optics.TRAVEL_PER_STEP_UM", 0.5)
    fine = Setup(Ramp(begin_s=0.01), sensor=QUIET).run(0.1)
    assert len(coarse) == pytest.approx(len(fine), rel=0.01)
    a, _ = np.histogram(coarse["t"], np.arange(10_000, 100_001, 2_000))
    b, _ = np.histogram(fine["t"], np.arange(10_000, 100_001, 2_000))
    assert np.abs(a - b).sum() < 0.03 * b.sum()


def test_first_on_events_of_an_opening_map_the_scene() -> None:
    setup = Setup(with_aperture=True, scene="astronaut", size=(160, 120))
    setup.camera.start()
    setup.camera.apply_biases(BiasSet.EXPOSE)
    setup.packets(0.006)
    setup.aperture.open()
    events = setup.run(0.040)
    began_us = (setup.aperture.began_ns - 1e9) / 1e3
    true_on = events[events["on"] & (events["t"] > began_us)][::-1]
    first = np.full((120, 160), np.nan)
    first[true_on["y"], true_on["x"]] = true_on["t"] - began_us
    fired = np.isfinite(first)
    assert fired.mean() > 0.97
    intensity = setup.canvas[32:-32, 32:-32]
    assert rank_correlation(-first[fired], intensity[fired]) > 0.95
    _, per_pixel = np.unique(true_on["y"].astype(int) * 160 + true_on["x"], return_counts=True)
    assert per_pixel.mean() < 1.05


def test_a_second_exposure_is_as_good_as_the_first() -> None:
    setup = Setup(with_aperture=True, scene="camera", size=(160, 120))
    setup.run(0.001)
    spreads = []
    for _ in range(2):
        now_s = (setup.world.now_ns() - 1e9) / 1e9
        setup.camera.apply_biases(BiasSet.EXPOSE)
        setup.packets(now_s + 0.006)
        setup.aperture.open()
        events = setup.run(now_s + 0.040)
        first = np.full((120, 160), np.nan)
        true_on = events[events["on"] & (events["t"] > (setup.aperture.began_ns - 1e9) / 1e3)][::-1]
        first[true_on["y"], true_on["x"]] = true_on["t"] - (setup.aperture.began_ns - 1e9) / 1e3
        fired = np.isfinite(first)
        spreads.append(rank_correlation(-first[fired], setup.canvas[32:-32, 32:-32][fired]))
        assert fired.mean() > 0.97
        setup.camera.apply_biases(BiasSet.FOCUS)
        setup.aperture.close()
        setup.packets(now_s + 0.1)
    assert spreads[1] == pytest.approx(spreads[0], abs=0.005)


def test_after_switching_biases_events_are_disordered_for_a_few_milliseconds() -> None:
    setup = Setup(sensor={"noise_hz": 1.0})
    setup.run(0.02)
    setup.camera.apply_biases(BiasSet.FOCUS)
    events = setup.run(0.04)
    disordered, settled = np.sum(events["t"] < 22_000) / 2, np.sum(events["t"] > 25_000) / 15
    assert disordered > 10 * settled


def test_photoreceptors_lag_more_in_dim_light() -> None:
    def last_event_us(brightness: float) -> float:
        setup = Setup(Ramp(start_um=0, begin_s=0.01, travel_um=60), sensor=QUIET, brightness=brightness)
        return float(np.percentile(setup.run(0.06)["t"], 90))

    assert last_event_us(0.1) > last_event_us(1.0) + 300


def test_hot_pixels_fire_and_can_be_masked() -> None:
    setup = Setup(sensor={**QUIET, "hot_pixels": 3})
    events = setup.run(0.1)
    assert {(int(e["x"]), int(e["y"])) for e in events} == set(setup.sensor.hot)
    assert len(events) > 100
    assert setup.camera.set_mask(setup.sensor.hot) == 3
    setup.run(0.102)
    assert len(setup.run(0.2)) == 0
    setup.camera.set_mask([])
    setup.run(0.202)
    assert len(setup.run(0.3)) > 100


def test_flicker_and_cap() -> None:
    flickering = Setup(light={"lamp": Lamp(100.0, 0.3)}, sensor=QUIET).run(0.1)
    rate, _ = np.histogram(flickering["t"], np.arange(20_000, 100_001, 5_000))
    assert rate.min() > 0
    capped = Setup(Ramp(begin_s=0.01), light={"cap": True}, sensor=QUIET).run(0.1)
    assert len(capped) == 0


def test_pixels_entering_a_window_start_from_the_present_brightness() -> None:
    setup = Setup(Ramp(begin_s=0.03, travel_um=200), sensor=QUIET)
    setup.camera.start()
    setup.camera.set_window(Roi(10, 20, 30, 25))
    inside = setup.run(0.12)  # the lens has moved and rests in focus
    assert len(inside) > 100
    assert (inside["x"].min(), inside["y"].min()) >= (10, 20)
    assert inside["x"].max() < 40
    assert inside["y"].max() < 45
    assert setup.sensor.level.shape == (25, 30)
    setup.camera.set_window(None)
    assert len(setup.run(0.16)) == 0
    assert setup.sensor.level.shape == (80, 96)


def test_mismatch_is_fixed_by_the_seed_and_independent_of_noise() -> None:
    a = EventSensor(32, 32, random_stream(1, "pattern"), random_stream(1, "noise"))
    b = EventSensor(32, 32, random_stream(1, "pattern"), random_stream(2, "noise"), noise_hz=9.0)
    np.testing.assert_array_equal(a._spread_on, b._spread_on)
    assert (a._spread_on.std() * MISMATCH_STEP) == pytest.approx(0.035, rel=0.1)
