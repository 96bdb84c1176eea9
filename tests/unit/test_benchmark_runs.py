"""A benchmark run: who works on it, how it is interrupted and taken up again, and what it then says of its goals."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import acceptance
import benchmark
import numpy as np
import pytest
from benchmarks import runner
from benchmarks.calibration import calibrations, draw_calibration, half_normal_quantiles
from benchmarks.executors import edition
from benchmarks.goals import verdicts
from benchmarks.limit import SignLimit, sign_sigma_um
from benchmarks.live import read_live
from benchmarks.retina import RetinaEvents
from benchmarks.rows import Row
from benchmarks.runner import Task
from benchmarks.scoring import scores
from benchmarks.shutter import Shutter
from benchmarks.verdict import MET, NOT_MET, SO_FAR, UNMEASURED, Verdict, tell

from elpd.errors import FormatError
from elpd.records import Roi


def row(case: str = "syn-a-fov1-static", **more: Any) -> Row:
    set_name, _, motion = case.rsplit("-", 3)[0], None, case.rsplit("-", 1)[1]
    plain: dict[str, Any] = {
        "case": case, "seed": 1, "set_name": set_name, "scene": "a", "fov": 1, "motion": motion, "method": "elpd",
        "rate": "50", "events": 9, "error_um": 0.5, "sigma_um": 0.5, "decided_um": 20.0, "focusing_ms": 1.0,
        "sharpest_um": 0.0, "limit_um": 0.5, "cpu_ms": 1.0, "reason": "", "details": {"direction": "approaching"},
    }  # fmt: skip
    return Row(**(plain | more))


# --- who works ---------------------------------------------------------------------------------------------------


def arithmetic(task: Task) -> list[Row]:
    """A worker without a simulator: what it answers follows from the case and the method alone."""
    return [
        row(task.case.name, set_name=task.case.set_name, motion=task.case.motion, seed=task.case.seed,
            method=name, rate=rate, error_um=float(len(task.case.name) + len(name)))
        for name, rate in task.wanted
    ]  # fmt: skip


def patient(task: Task) -> list[Row]:
    """Another answer; its times differ from run to run, as times do."""
    rows = arithmetic(task)
    taken = float(np.random.default_rng().uniform(1.0, 2.0))
    return [replace(one, case=task.case.name, error_um=len(task.case.name) + 0.25, cpu_ms=taken) for one in rows]


COMMON = ["--cases", "syn-*-fov1-*", "--sets", "syn", "--methods", "egs,pbf"]


@contextmanager
def scheduler_for(executor: str) -> Iterator[list[str]]:
    """Start a cluster for dask whose workers are threads of this process: quick, and the protocol is the real one."""
    if executor != "dask":
        yield []
        return
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        dashboard_address="127.0.0.1:0",
        host="127.0.0.1",
        protocol="tcp://",
    ) as cluster:
        yield ["--scheduler", cluster.scheduler_address]


def test_rows_do_not_depend_on_who_was_faster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "run_task", patient)
    found = []
    for executor in ("serial", "dask"):
        out = tmp_path / executor
        with scheduler_for(executor) as more:
            assert benchmark.main(["--out", str(out), "--executor", executor, "--jobs", "2", *more, *COMMON]) == 0
        found.append((out / "rows.csv").read_bytes())
    assert found[0].count(b"\n") == 1 + 2 * 21
    assert found[1] == found[0]


def test_workers_of_another_edition_and_schedulers_that_do_not_answer_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("benchmarks.executors.CONNECT_S", 0.2)
    common = ["--out", str(tmp_path / "out"), "--executor", "dask", *COMMON]
    assert benchmark.main([*common, "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "no dask scheduler at tcp://127.0.0.1:9" in capsys.readouterr().err
    monkeypatch.setattr("benchmarks.executors.CONNECT_S", 20)
    with distributed.LocalCluster(
        n_workers=0, processes=False, dashboard_address="127.0.0.1:0", host="127.0.0.1", protocol="tcp://"
    ) as cluster:
        common += ["--scheduler", cluster.scheduler_address]
        assert benchmark.main(common) == 2
        assert "no workers" in capsys.readouterr().err
        cluster.scale(1)
        with distributed.Client(cluster) as client:
            client.wait_for_workers(1)
        seen: list[dict[str, Any]] = []

        def changing() -> dict[str, Any]:
            seen.append(edition() | {"cases": len(seen)})
            return seen[-1]

        monkeypatch.setattr("benchmarks.executors.edition", changing)
        assert benchmark.main(common) == 2
        assert "give it the same version" in capsys.readouterr().err
    assert benchmark.main(["--out", str(tmp_path / "x"), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "--executor dask" in capsys.readouterr().err


# --- interrupted, and taken up again -----------------------------------------------------------------------------


@pytest.mark.parametrize("executor", ["serial", "joblib", "dask"])
def test_an_interrupted_run_keeps_what_was_whole_and_goes_on_from_there(
    executor: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip({"joblib": "joblib", "dask": "distributed"}.get(executor, "json"))
    arguments = ["--out", str(tmp_path), "--executor", executor, "--jobs", "2", *COMMON]
    keep, kept = runner._keep, []

    def interrupted(work: Any, rows: Any) -> None:
        if len(kept) == 5:
            raise KeyboardInterrupt
        keep(work, rows)
        kept.append(work.task.case.name)

    monkeypatch.setattr(runner, "run_task", arithmetic)
    with monkeypatch.context() as patched:
        patched.setattr(runner, "_keep", interrupted)
        with scheduler_for(executor) as more:
            assert benchmark.main([*arguments, *more]) == benchmark.INTERRUPTED
    assert "5 cases are kept, go on with --resume" in capsys.readouterr().err
    assert not (tmp_path / "rows.csv").exists()

    done = []

    def noting(task: Task) -> list[Row]:
        done.append(task.case.name)
        return patient(task)

    monkeypatch.setattr(runner, "run_task", noting)
    assert benchmark.main([*arguments, "--executor", "serial", "--resume"]) == 0
    assert "5 of 21 cases were finished before" in capsys.readouterr().out
    assert len(done) == 16
    assert not set(done) & set(kept)
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert len(rows) == 42
    # What was known is what the first run had found, not what the second would have.
    assert {one["case"] for one in rows if one["error_um"] % 1.0 == 0.0} == set(kept)


def test_a_folder_of_another_seed_or_other_code_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runner, "run_task", patient)
    arguments = ["--out", str(tmp_path), "--executor", "serial", *COMMON]
    assert benchmark.main(arguments) == 0
    assert benchmark.main([*arguments, "--resume"]) == 0
    capsys.readouterr()
    for more, told in ((["--seed", "2"], "seeds [1], and this is [2]"), (["--seeds", "2"], "and this is [1, 2]")):
        assert benchmark.main([*arguments, "--resume", *more]) == 2
        assert told in capsys.readouterr().err
    monkeypatch.setattr("benchmarks.folder.code_digest", lambda: "0123456789ab")
    assert benchmark.main([*arguments, "--resume"]) == 2
    assert "--redo" in capsys.readouterr().err
    assert benchmark.main([*arguments, "--resume", "--redo", "egs,pbf"]) == 0
    (tmp_path / "run.json").unlink()
    assert benchmark.main([*arguments, "--resume"]) == 2
    assert "no run.json" in capsys.readouterr().err


# --- what is said of the goals -----------------------------------------------------------------------------------


def named(table: list[Verdict], begin: str) -> Verdict:
    (found,) = [one for one in table if one.goal.startswith(begin)]
    return found


def all_of(motion: str, error_um: float | None, set_name: str = "syn", rate: str = "50", **more: Any) -> list[Row]:
    cases = benchmark.cases_of(set_name, 1, f"*-{motion}")
    return [
        row(one.name, set_name=set_name, motion=motion, rate=rate, error_um=error_um, **more) for one in cases
    ]  # fmt: skip


def test_a_goal_is_met_only_by_all_its_sweeps() -> None:
    rows = all_of("static", 0.9)
    table = verdicts(rows)
    assert named(table, "syn static, 50 fps").verdict == MET
    assert named(table, "syn static, 20 fps").verdict == UNMEASURED
    assert named(verdicts(rows[:5]), "syn static, 50 fps").verdict == MET + SO_FAR
    # A mean over some sweeps may yet change; an answer that must not be given has been given.
    assert named(verdicts(all_of("static", 1.1)[:5]), "syn static, 50 fps").verdict == NOT_MET + SO_FAR
    assert named(verdicts([replace(rows[0], error_um=20.0)]), "syn static, 50 fps").verdict == NOT_MET
    assert named(verdicts([*rows[1:], replace(rows[0], error_um=20.0)]), "syn static, 50").verdict == NOT_MET
    assert named(verdicts([*rows[1:], replace(rows[0], error_um=None)]), "syn static, 50").verdict == NOT_MET
    assert named(verdicts(all_of("static", 1.1)), "syn static, 50 fps").verdict == NOT_MET
    assert named(verdicts(all_of("static", None)), "syn static, 50 fps").verdict == NOT_MET
    # Elsewhere a sweep without an answer is counted apart.
    rig = all_of("static", 0.4, "davis-bright")
    apart = named(verdicts([*rig[1:], replace(rig[0], error_um=None)]), "davis-bright static")
    assert (apart.verdict, apart.missed) == (MET, 1)
    assert named(verdicts(rig + all_of("static", 9.0, "davis-bright", method="pbf")), "davis-bright static").beside == (
        "paper: ELP 0.29 in hindsight; here: pbf 9.0"
    )


def test_a_goal_is_held_against_one_pass_and_against_whole_cycles_apart() -> None:
    one_pass = all_of("dynamic", None, "davis-bright", focusing_ms=None)
    crossed = all_of("dynamic", 0.5, "davis-bright", method="elpd-cycle", again_ms=80.0, focusing_ms=240.0)
    crossed[0] = replace(crossed[0], again_ms=0.0, focusing_ms=150.0)
    table = verdicts(one_pass + crossed)
    once, cycles = (one for one in table if one.goal.startswith("davis-bright dynamic"))
    assert (once.verdict, once.missed, once.other) == (NOT_MET, 7, "")
    assert (cycles.source, cycles.verdict, cycles.missed) == ("whole cycles", MET, 0)
    assert cycles.other == "to focus 240 ms, 6 of 7 crossed again, for 80 ms of it"
    assert {one.source for one in table if one.goal.startswith("abstentions in shake")} == {once.source, cycles.source}
    _, score = scores(one_pass + crossed)
    assert (score.method, score.crossed_again, score.again_ms) == ("elpd-cycle", 6, 80.0)
    truth = {one.name: one.answers for one in calibrations(one_pass + crossed)}
    assert truth == {"whole cycles, all sets": 7, "whole cycles, davis-bright dynamic, 50": 7}


def test_abstentions_early_stops_false_answers_and_directions_are_counted() -> None:
    shaken = all_of("shake", 1.0, "davis-bright", decided_um=-7.0)
    table = verdicts(shaken)
    assert named(table, "davis-bright shake").verdict == NOT_MET
    assert named(table, "davis-bright shake").early == 7
    assert named(table, "abstentions in shake").verdict == MET + SO_FAR
    assert (
        named(verdicts([replace(one, error_um=None) for one in shaken]), "abstentions in").verdict == NOT_MET + SO_FAR
    )
    nothing = [replace(one, seed=seed) for seed in range(6) for one in all_of("static", None, "nothing")]
    nothing += [replace(one, seed=seed) for seed in range(20) for one in all_of("static", 1.0, "flicker")]
    assert named(verdicts(nothing), "flat, cap").verdict == MET
    assert named(verdicts([*nothing, row("nothing-wall-fov1-static")]), "flat, cap").verdict == NOT_MET
    static = [replace(one, seed=seed) for seed in range(8) for one in all_of("static", 1.0)]
    assert named(verdicts(static), "first direction wrong, static").verdict == MET
    turned = replace(static[0], details={"direction": "receding"})
    assert named(verdicts([turned, *static[1:]]), "first direction wrong, static").verdict == NOT_MET
    assert any(line.startswith("not met") and "1 wrong" in line for line in tell(verdicts([turned, *static[1:]])))


def cycle(**more: Any) -> dict[str, Any]:
    phases = [{"name": "expose", "ms": 40.0}, {"name": "sweep", "ms": 70.0}, {"name": "return", "ms": 20.0}]
    return {
        "outcome": "FOCUSED", "start_um": -200.0, "final_error_um": 0.5, "reversals": 0, "duration_ms": 130.0,
        "phases": phases, "first_direction_wrong": False, "stopped_early": False,
    } | more  # fmt: skip


def live_file(path: Path, cycles: list[dict[str, Any]], **more: Any) -> Path:
    settings = {"camera": "evk4", "motion": "static", "board": "tic", "brightness": 1.0, "speed_um_s": 4000.0}
    path.write_text(json.dumps({"settings": settings | {"depth_of_focus_um": 6.0} | more, "rows": cycles}))
    return path


def test_whole_cycles_stand_beside_the_estimates(tmp_path: Path) -> None:
    live = read_live(live_file(tmp_path / "tic.json", [cycle() for _ in range(200)]))
    table = verdicts([], [live])
    assert named(table, "evk4-bright static, at rest").verdict == MET
    assert named(table, "evk4-bright static, temporal map").verdict == UNMEASURED
    assert named(table, "first direction wrong, static, from both").verdict == MET
    assert named(table, "200 um to rest").other.startswith("median 90 ms")
    slow = cycle(phases=[{"name": "sweep", "ms": 101.0}], final_error_um=7.0, first_direction_wrong=True)
    table = verdicts([], [read_live(live_file(tmp_path / "slow.json", [slow] * 20, motion="moderate"))])
    assert named(table, "evk4-bright dynamic, at rest").outside == 20
    assert named(table, "200 um to rest").verdict == NOT_MET
    wrong = read_live(live_file(tmp_path / "wrong.json", [cycle(outcome="LOW_CONFIDENCE", final_error_um=None), slow]))
    assert named(verdicts([], [wrong]), "first direction wrong, static, from both").verdict == NOT_MET
    assert named(verdicts([], [wrong]), "abstentions at rest").verdict == NOT_MET + SO_FAR
    dim = read_live(live_file(tmp_path / "dim.json", [cycle()], brightness=0.3))
    assert named(verdicts([], [dim]), "evk4-dark static, at rest").verdict == MET + SO_FAR
    (tmp_path / "other.json").write_text("[1, 2]")
    for name in ("other.json", "none.json"):
        with pytest.raises(FormatError, match="acceptance"):
            read_live(tmp_path / name)


def test_the_first_direction_is_judged_by_where_focus_was() -> None:
    def swept(begun_um: float, ended_um: float, end: str) -> dict[str, Any]:
        return {"begun_um": begun_um, "ended_um": ended_um, "end": end, "sign": 1 if ended_um > begun_um else -1}

    wrong = acceptance.first_direction_wrong
    assert wrong([swept(0.0, 10.0, "passed")], 8.0) is False
    assert wrong([swept(0.0, 10.0, "behind")], 200.0) is True
    assert wrong([swept(0.0, 10.0, "behind")], -200.0) is False
    assert wrong([swept(0.0, 10.0, "passed")], -200.0) is True
    assert wrong([swept(0.0, 900.0, "rule")], -200.0) is True
    assert wrong([swept(0.0, 50.0, "rule")], 200.0) is False
    assert wrong([], 8.0) is None
    assert acceptance.stopped_early([swept(0.0, 100.0, "passed")], 110.0, 6.0)
    assert not acceptance.stopped_early([swept(0.0, 120.0, "passed")], 110.0, 6.0)
    assert acceptance.stopped_early([swept(200.0, 120.0, "passed")], 110.0, 6.0)


def test_cycles_of_the_simulated_rig_become_a_file_that_the_goals_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = ["--set", "sim.width=160", "--set", "sim.height=120", "--seeds", "1", "--start-um", "-200"]
    monkeypatch.setattr("sys.argv", ["acceptance.py", *small, "--json", str(tmp_path / "live.json")])
    assert acceptance.main() == 0
    live = read_live(tmp_path / "live.json")
    assert live.settings["depth_of_focus_um"] == 6.0
    assert live.rows[0]["first_direction_wrong"] is False
    found = named(verdicts([], [live]), "evk4-bright static, at rest")
    assert found.trials == 1
    assert found.mae_um == abs(live.rows[0]["final_error_um"])


# --- is a standard error true? -----------------------------------------------------------------------------------


def test_true_sigmas_have_an_rms_of_one_and_false_ones_show() -> None:
    rng = np.random.default_rng(4)
    for claimed, rms, beyond in ((1.0, 1.0, 0.046), (0.5, 2.0, 0.317)):
        rows = [row(error_um=float(error), sigma_um=claimed) for error in rng.standard_normal(4_000)]
        rows += [row(error_um=50.0, method="pbf", sigma_um=None), row("nothing-wall-fov1-static", error_um=9.0)]
        every, only = calibrations(rows)
        assert (every.name, only.name, every.answers) == ("one pass, all sets", "one pass, syn static, 50", 4_000)
        assert every.rms == pytest.approx(rms, rel=0.04)
        assert every.beyond_two == pytest.approx(beyond, abs=0.02)
    assert "rms" in draw_calibration(rows, "true?")
    quantiles = half_normal_quantiles(2_001)
    assert quantiles[1_000] == pytest.approx(0.6745, abs=1e-3)


# --- the statistical limit ---------------------------------------------------------------------------------------


def test_no_estimate_from_signs_beats_the_limit_and_the_best_one_reaches_it() -> None:
    """Draw signs whose chance turns over at a place, find that place by maximum likelihood, many times."""
    position_um = np.arange(-45.0, 45.0, 0.5)
    events = np.full(position_um.size, 40.0)
    rho = -0.6 * np.tanh(position_um / 8.0)
    limit_um = sign_sigma_um(position_um, events, rho, 6.0)
    rng = np.random.default_rng(7)
    places = np.linspace(-6.0, 6.0, 481)
    chance = 0.5 * (1.0 - 0.6 * np.tanh((position_um - places[:, None]) / 8.0))
    plus = rng.binomial(40, 0.5 * (1.0 + rho), (400, position_um.size))
    likelihood = plus @ np.log(chance).T + (40 - plus) @ np.log(1.0 - chance).T
    found = places[likelihood.argmax(axis=1)]
    assert found.std() == pytest.approx(limit_um, rel=0.12)
    # Four times the events, half the scatter; a curve that does not turn over says nothing.
    assert sign_sigma_um(position_um, 4.0 * events, rho, 6.0) == pytest.approx(0.5 * limit_um, rel=1e-6)
    assert np.isnan(sign_sigma_um(position_um, events, np.zeros(position_um.size), 6.0))


def test_the_limit_counts_signs_against_the_picture_of_the_moment() -> None:
    limit = SignLimit(Roi(0, 0, 32, 32))
    y, x = np.mgrid[0:32, 0:32]
    picture = (100.0 + 60.0 * np.sin(x / 3.0)).astype(np.float32)
    bright = picture > 130.0
    columns = x[bright].astype(np.uint16), y[bright].astype(np.uint16)
    t_us = np.zeros(columns[0].size, dtype=np.int64)
    for k in range(-8, 8):
        # Bright ridges brighten before focus and darken after it.
        on = np.full(t_us.size, 1 if k < 0 else 0, dtype=np.uint8)
        limit.add(RetinaEvents(t_us, *columns, on), picture, k + 0.5)
    sharp_um = limit.sigma_um(6.0)
    assert 0.0 < sharp_um < 0.5
    assert np.isnan(SignLimit(Roi(0, 0, 32, 32)).sigma_um(6.0))


# --- exposures ---------------------------------------------------------------------------------------------------


def test_a_frame_is_the_mean_of_its_exposure_and_as_old_as_its_read_out() -> None:
    shutter = Shutter(exposure_us=1_000, read_out_us=500, step_us=250)
    assert shutter.reach_us == 1_500
    with pytest.raises(ValueError, match="only 0 pictures"):
        shutter.exposed()
    # Brightness is the time in ms: the mean over the exposure is its middle, which is 1 ms old.
    for t_us in range(0, 4_001, 250):
        shutter.see(np.full((2, 2), t_us / 1e3, dtype=np.float32))
    np.testing.assert_allclose(shutter.exposed(), 3.0, rtol=1e-6)
    instant = Shutter(0, 0, 250)
    instant.see(np.full((2, 2), 7.0, dtype=np.float32))
    np.testing.assert_array_equal(instant.exposed(), 7.0)
    with pytest.raises(ValueError, match="multiples of 250"):
        Shutter(300, 0, 250)
