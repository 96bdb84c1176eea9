"""The benchmark's lens, sensor, cases and report: deterministic, physical, resumable."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import benchmark
import naive_baselines as naive
import numpy as np
import pytest
from benchmarks.cases import Case, cases_of, load_or_make, make
from benchmarks.methods import all_methods, run_method
from benchmarks.optics import FocusRenderer, cubic_weights, fold_spectrum, load_psf
from benchmarks.plots import Plot, Series, draw
from benchmarks.recorded import read_recorded, recorded_cases
from benchmarks.retina import Retina, cross_thresholds, lin_log
from benchmarks.rows import Row
from benchmarks.scoring import scores
from benchmarks.sets import APERTURE_US, MAP, REBUILT, SETS, STD
from benchmarks.shake import MOTIONS, shifts_px
from benchmarks.starts import aperture_picture
from hypothesis import given, settings
from hypothesis import strategies as st
from shared import SHARED, needs_shared

# --- the lens ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("field_of_view", [1, 2, 3, 4])
def test_the_table_is_sharpest_at_zero_and_ten_times_wider_at_the_ends(field_of_view: int) -> None:
    psf = load_psf(field_of_view)
    middle = psf.positions_um.size // 2
    assert psf.positions_um[middle] == 0.0
    assert np.argmin(psf.rms_um) == middle
    assert np.all(np.diff(psf.rms_um[: middle + 1]) < 0)
    assert np.all(np.diff(psf.rms_um[middle:]) > 0)
    # The paper's sweep ends 400 um either side of focus; the table goes on for rigs with more defocus.
    ends = np.flatnonzero(np.abs(psf.positions_um) == 400.0)
    ratios = psf.rms_um[ends] / psf.rms_um[middle]
    assert np.all((ratios > 9.0) & (ratios < 10.5))


@pytest.mark.parametrize("field_of_view", [1, 4])
def test_kernels_are_as_wide_as_the_rays_say_and_centred(field_of_view: int) -> None:
    psf = load_psf(field_of_view)
    cells = psf.kernels.shape[1]
    offset_um = (np.arange(cells) - cells // 2) * psf.cell_um
    for kernel, rms_um in zip(psf.kernels[::10], psf.rms_um[::10], strict=True):
        assert kernel.sum() == pytest.approx(1.0, abs=1e-5)
        x_um, y_um = kernel.sum(axis=0) @ offset_um, kernel.sum(axis=1) @ offset_um
        assert abs(x_um) < 0.05 * psf.cell_um
        assert abs(y_um) < 0.05 * psf.cell_um
        second = kernel.sum(axis=0) @ offset_um**2 + kernel.sum(axis=1) @ offset_um**2 - x_um**2 - y_um**2
        # Counting in cells adds a cell's own variance along each axis.
        assert np.sqrt(second - psf.cell_um**2 / 6.0) == pytest.approx(rms_um, rel=0.02)


@given(st.floats(0.0, 9.0))
def test_cubic_weights_reproduce_parabolas(position: float) -> None:
    first, weights = cubic_weights(position, 10)
    nodes = np.arange(first, first + 4)
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ (3.0 * nodes**2 - 2.0 * nodes) == pytest.approx(3.0 * position**2 - 2.0 * position, abs=1e-9)


def test_a_frame_is_the_picture_convolved_moved_and_averaged() -> None:
    rng = np.random.default_rng(5)
    picture = rng.uniform(10, 200, (144, 144)).astype(np.float32)
    psf = load_psf(4)
    renderer = FocusRenderer(picture, psf, margin_px=8)
    kernel = psf.kernels[psf.positions_um.size // 2]
    reach = kernel.shape[0] // 2
    padded = np.pad(picture, reach, mode="wrap").astype(np.float64)
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape)
    convolved = np.einsum("ijkl,kl->ij", windows, kernel[::-1, ::-1].astype(np.float64), optimize=True)
    moved = np.roll(convolved, (-6, 3), axis=(0, 1))
    expected = moved.reshape(48, 3, 48, 3).mean(axis=(1, 3))[8:-8, 8:-8]
    np.testing.assert_allclose(renderer.frame(0.0, (1.0, -2.0)), expected, rtol=2e-5)


def test_fold_spectrum_is_its_twin() -> None:
    rng = np.random.default_rng(6)
    side = 12
    nodes = [np.fft.rfft2(rng.normal(size=(side, side))) for _ in range(4)]
    weights = rng.normal(size=4)
    shift = (0.7, -1.3)
    rows = np.exp(-2j * np.pi * shift[1] * np.fft.fftfreq(side)).astype(np.complex64)
    columns = np.exp(-2j * np.pi * shift[0] * np.fft.rfftfreq(side)).astype(np.complex64)
    # At the Nyquist frequencies a fractional shift of a real image is not defined; keep them empty.
    for node in nodes:
        node[side // 2] = 0.0
        node[:, side // 2] = 0.0
    folded = np.zeros((side // 3, side // 6 + 1), dtype=np.complex64)
    fast = [np.ascontiguousarray(node, dtype=np.complex64) for node in nodes]
    fold_spectrum(*fast, weights.astype(np.float32), rows, columns, folded)
    np.testing.assert_allclose(folded, naive.fold_spectrum(nodes, weights, shift), rtol=1e-4, atol=1e-4)


# --- the sensor --------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.sampled_from([60.0, 300.0, 700.0]))
@settings(max_examples=40, deadline=None)
def test_the_retina_is_its_twin(seed: int, refractory_us: float) -> None:
    rng = np.random.default_rng(seed)
    pixels, span_us = 6, 1_000.0
    levels = (rng.normal(size=pixels), rng.normal(size=pixels))
    levels[1][0] = levels[0][0]
    thresholds = rng.uniform(0.05, 0.4, (pixels, 2))
    noise = sorted((float(t), int(p), int(on)) for t, p, on in zip(
        rng.uniform(0, span_us, 3), rng.integers(0, pixels, 3), rng.integers(0, 2, 3), strict=True
    ))  # fmt: skip
    reference, busy = levels[0] + rng.uniform(-0.5, 0.5, pixels), rng.uniform(-100.0, 300.0, pixels)
    slow_reference, slow_busy = reference.copy(), busy.copy()
    room = pixels * 20 + len(noise)
    when, where, on = np.empty(room), np.empty(room, dtype=np.int64), np.empty(room, dtype=np.uint8)
    columns = list(zip(*noise, strict=True))
    found = cross_thresholds(
        *levels, 0.0, span_us, thresholds, refractory_us,
        np.array(columns[0]), np.array(columns[1], dtype=np.int64), np.array(columns[2], dtype=np.uint8),
        reference, busy, when, where, on,
    )  # fmt: skip
    slow = naive.cross_thresholds(levels, (0.0, span_us), thresholds, refractory_us, noise, slow_reference, slow_busy)
    assert list(zip(where[:found], on[:found], strict=True)) == [(pixel, sign) for _, pixel, sign in slow]
    np.testing.assert_allclose(when[:found], [time for time, _, _ in slow], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(reference, slow_reference, rtol=1e-12)


def test_a_brightening_pixel_counts_its_thresholds() -> None:
    settings_ = replace(STD, sigma_thres=0.0, shot_noise_rate_hz=0.0, leak_rate_hz=0.0, cutoff_hz=1e5)
    rng = np.random.default_rng(1)
    retina = Retina(settings_, np.full((20, 20), 50.0, dtype=np.float32), 0, 1_000_000, rng)
    for k in range(1, 101):
        retina.see(np.full((20, 20), 50.0 * np.exp(0.02 * k), dtype=np.float32), 10_000.0 * k)
    seen = retina.events()
    # Two e-foldings at 0.2 are ten thresholds; the reference starts anywhere within one of the level.
    assert np.all(seen.on == 1)
    assert 9.0 <= seen.t_us.size / 400 <= 10.6
    assert np.all(np.diff(seen.t_us) >= 0)


def test_the_logarithm_is_continuous_where_it_turns_linear() -> None:
    values = lin_log(np.array([0.0, 19.999, 20.001, 255.0]))
    assert values[0] == 0.0
    assert values[1] == pytest.approx(values[2], abs=1e-3)
    assert values[3] == pytest.approx(np.log(255.0))


def test_white_and_lasting_jitter_have_the_speed_asked_for() -> None:
    for name in ("violent", "shake"):
        moved = shifts_px(MOTIONS[name], 20_001, 1.0, np.random.default_rng(3))
        speed = np.diff(moved, axis=0) * 1e3
        assert speed.std() == pytest.approx(100.0, rel=0.1)
        lasting = np.corrcoef(speed[:-10, 0], speed[10:, 0])[0, 1]
        assert lasting == pytest.approx(np.exp(-10 / 30) if name == "shake" else 0.0, abs=0.08)


# --- cases -------------------------------------------------------------------------------------------------------


def test_the_set_has_the_papers_84_cases_and_patterns_choose_among_them() -> None:
    assert len(cases_of("syn", 1)) == 84
    assert len(cases_of("syn-std", 1)) == 84
    assert len({case.name for name in SETS for case in cases_of(name, 1)}) == 2 * 84 + 5 * 21 + 2 * 36
    assert [case.name for case in cases_of("syn", 1, "*-camera-fov2-static")] == ["syn-camera-fov2-static"]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cases")


def test_a_case_follows_from_its_name_and_seed_and_survives_the_cache(cache: Path) -> None:
    case = Case("syn", "camera", 1, "violent", 3)
    made, kept = load_or_make(case, cache), load_or_make(case, cache)
    again = make(case)
    for one in (kept, again):
        for name in ("t_us", "x", "y", "on", "frame_t_us", "frames"):
            np.testing.assert_array_equal(getattr(made, name), getattr(one, name))
    assert [path.suffix for path in cache.iterdir()] == [".npz"]
    assert made.frames_at("50")[1].t_us == 20_000
    assert len(made.frames_at("20")) == 21
    assert [frame.t_us for frame in made.frames_at("1")] == [0]
    assert made.frame_nearest(350_000).t_us == 350_000
    assert case.of_set.truth_us == 500_000.0
    assert abs(made.sharpest_um) < 2.0
    # Sharpest where the truth says.
    edges = (np.diff(made.frames.astype(np.float64), axis=2) ** 2).mean(axis=(1, 2))
    assert abs(int(np.argmax(edges)) - 50) <= 1


def test_an_opening_aperture_leaves_a_picture_and_one_event_a_pixel(cache: Path) -> None:
    made = load_or_make(Case("evk4-bright", "camera", 1, "static", 3), cache)
    opening = made.t_us < APERTURE_US
    pixels = made.geometry.width * made.geometry.height
    assert 0.9 * pixels < np.count_nonzero(made.on[opening]) < 1.1 * pixels
    picture = aperture_picture(made)
    # What the picture shows is the scene as the lens sees it before it moves.
    before = np.log(made.frame_nearest(APERTURE_US).pixels.astype(np.float64) + 1.0)
    assert np.corrcoef(before[picture.valid], picture.log_intensity[picture.valid])[0, 1] > 0.9
    # Peers see the sweep alone; time goes on counting from the opening.
    stack = made.stack(())
    assert stack.begin_us == 25_000
    assert stack.t_us[0] >= 25_000
    assert made.path().at(stack.begin_us) == -200.0
    assert made.path().at(made.case.of_set.truth_us) == pytest.approx(0.0)
    found = run_method(all_methods()["elpd"], MAP, made)
    assert found.error_um is not None
    assert abs(found.error_um) < 6.0
    # A picture made of the sweep's own events says less of who is dark, and so of the lag: refused, or right.
    rebuilt = run_method(all_methods()["elpd"], REBUILT, made)
    assert rebuilt.error_um is None or abs(rebuilt.error_um) < 6.0
    told = rebuilt.details["contributions"]
    assert all(abs(one["at_um"]) < 6.0 for one in told)
    assert {one["name"] for one in told} == {"vertex", "pairs"}
    assert found.limit_um is not None
    assert 0.1 < found.limit_um < 2.0


@needs_shared
def test_third_party_sweeps_are_read_with_their_frames_and_truth() -> None:
    cases = recorded_cases(SHARED / "sweeps")
    assert {case.motion for case in cases} == {"static", "moderate", "violent"}
    made = read_recorded(cases[0])
    assert made.case.folder is not None
    assert made.truth_us == json.loads((made.case.folder / "truth.json").read_text())["gt_us"]
    assert 48 <= len(made.frames_at("50")) <= 52
    assert 20 <= len(made.frames_at("20")) <= 22
    assert made.frame_nearest(350_000).t_us == pytest.approx(350_000, abs=2_000)
    assert np.all(np.diff(made.t_us) >= 0)


# --- scores and report -------------------------------------------------------------------------------------------


def row(error_um: float | None, decided_um: float = 30.0) -> Row:
    return Row(
        "syn-a-fov1-static", 1, "syn", "a", 1, "static", "pbf", "-", 100, error_um, None if error_um is None else 2.0,
        None if error_um is None else decided_um, 500.0, 1.0, 0.5, 3.0, "",
    )  # fmt: skip


def test_misses_and_wild_answers_are_counted_beside_the_mean_not_in_it() -> None:
    (score,) = scores([row(2.0), row(-4.0), row(20.0, decided_um=-40.0), row(None)])
    assert (score.cases, score.missed, score.outside, score.early) == (4, 1, 1, 1)
    assert score.mae_um == pytest.approx(26.0 / 3.0, abs=1e-3)
    assert score.worst_um == 20.0
    assert score.published_um == 4.93
    assert (score.limit_um, score.spread, score.beyond_two) == (0.5, pytest.approx(5.916, abs=1e-3), 0.3333)
    (on_a_rig,) = scores([replace(row(2.0), set_name="davis-bright")])
    assert (on_a_rig.published_um, on_a_rig.published_cpu_ms, on_a_rig.published_focusing_ms) == (10.9, 2.37, 302.4)
    (nothing,) = scores([row(None)])
    assert nothing.mae_um is None
    (fooled,) = scores([replace(row(0.5), set_name="nothing"), replace(row(None), set_name="nothing")])
    assert (fooled.missed, fooled.outside) == (1, 1)


def test_a_plot_is_text_and_lines_and_escapes_what_it_is_told() -> None:
    svg = draw(Plot("a < b", "x", "y", [Series("one & two", [1.0, 10.0], [0.0, 1.0])], log_x=True))
    assert "a &lt; b" in svg
    assert "one &amp; two" in svg
    assert svg.count("<polyline") == 1
    assert "nothing to draw" in draw(Plot("empty", "x", "y", []))


def test_the_benchmark_runs_resumes_and_writes_one_self_contained_report(
    cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results"
    common = ["--out", str(out), "--cache", str(cache), "--seed", "3", "--executor", "serial"]
    common += ["--quick", "--sets", "syn", "--cases", "*-violent", "--rates", "50"]
    assert benchmark.main([*common, "--methods", "egs,pbf,elp-syn"]) == 0
    first = json.loads((out / "results.json").read_text())
    assert [one["method"] for one in first["rows"]] == ["egs", "pbf", "elp-syn"]

    # Without --resume nothing is overwritten; with it, only what is missing is run.
    assert benchmark.main([*common, "--methods", "egs"]) == 2
    assert "--resume" in capsys.readouterr().err
    assert benchmark.main([*common, "--methods", "elpd,egs,pbf,elp-syn", "--resume"]) == 0
    second = json.loads((out / "results.json").read_text())
    assert second["rows"][2:] == first["rows"]
    assert [(one["method"], one["rate"]) for one in second["rows"][:2]] == [("elpd", "50"), ("elpd", "-")]
    with_frames, without = (one["error_um"] for one in second["rows"][:2])
    assert abs(with_frames) < 16.0
    assert without is None or abs(without) < 16.0  # events alone, in violent motion, may know that they do not know

    again = [*common, "--methods", "egs,pbf", "--resume", "--redo", "egs"]
    assert benchmark.main(again) == 0
    third = json.loads((out / "results.json").read_text())["rows"]
    assert third[1] == first["rows"][1]
    assert third[0]["error_um"] == first["rows"][0]["error_um"]
    assert benchmark.main([*common, "--methods", "elpd,egs,pbf,elp-syn", "--resume"]) == 0

    with (out / "rows.csv").open() as file:
        assert [line["method"] for line in csv.DictReader(file)] == ["elpd", "elpd", "egs", "pbf", "elp-syn"]
    with (out / "times.csv").open() as file:
        assert all(float(line["cpu_ms"]) > 0.0 for line in csv.DictReader(file))
    page = (out / "report.html").read_text()
    assert page.count("<svg") >= 3
    assert "2.26" in page  # the paper's number stands beside ours
    assert not re.search(r"(src|href)=", page)


@pytest.mark.parametrize("executor", ["joblib", "dask"])
def test_processes_give_what_one_process_gives(executor: str, cache: Path, tmp_path: Path) -> None:
    """Real methods on a real case; a cluster of its own is started, with processes that have to find this code."""
    pytest.importorskip({"joblib": "joblib", "dask": "distributed"}[executor])
    common = ["--cache", str(cache), "--seed", "3", "--sets", "syn", "--cases", "*-camera-fov1-violent"]
    common += ["--methods", "egs,pbf,elp-syn"]
    rows = []
    for one, jobs in (("serial", "1"), (executor, "2" if executor == "joblib" else "1")):
        out = tmp_path / one
        assert benchmark.main(["--out", str(out), "--executor", one, "--jobs", jobs, *common]) == 0
        rows.append((out / "rows.csv").read_bytes())
    assert rows[0] == rows[1]


def test_every_method_has_a_title_and_a_rate() -> None:
    methods = all_methods()
    assert next(iter(methods)) == "elpd"
    assert all(method.title and method.rates for method in methods.values())


def test_unknown_names_are_refused_with_the_known_ones(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        benchmark.main(["--out", str(tmp_path), "--methods", "magic"])
    assert "choose from" in capsys.readouterr().err
    assert benchmark.main(["--out", str(tmp_path), "--cases", "no-such-case"]) == 2
