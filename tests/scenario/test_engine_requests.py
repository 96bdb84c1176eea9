"""The daemon asked by people: one answer each, one thing at a time, and a stop before everything."""

from __future__ import annotations

from pathlib import Path

import pytest
from engines import ME, SOMEBODY, Daemon

from elpd.errors import BusyError, FaultLatchedError, UnavailableError, UnreferencedError, UsageError
from elpd.records import StopMode


@pytest.fixture
def daemon(tmp_path: Path) -> Daemon:
    return Daemon(tmp_path).begin()


def test_a_focus_request_ends_in_focus_and_everybody_hears_of_it(daemon: Daemon) -> None:
    result = daemon.do("focus")
    assert result.outcome == "FOCUSED"
    assert abs(result.truth["final_error_um"]) < 6.0
    assert [event.state for event in daemon.told("state")] == ["READY", "FOCUSING", "READY"]
    assert [event.run for event in daemon.told("result")] == [result.run]
    assert daemon.told("phase")[-1].phase == "done"
    assert len(daemon.told("sample")) > 20
    status = daemon.status
    assert (status.state, status.phase, status.counters.focused) == ("READY", None, 1)
    assert status.last is not None
    assert status.last.run == result.run
    assert {"cycle", "sweep", "stop command", "sensor to host", "host to loop"} <= set(status.latency)
    assert 166.0 <= status.latency["sensor to host"].p50_us < 400.0, "the least latency, and what batching adds"
    assert status.lens.position_um == pytest.approx(result.final_um, abs=0.4)
    assert [one.name for one in daemon.do("runs").runs] == [result.run]
    assert daemon.do("run", name=result.run).result["outcome"] == "FOCUSED"


def test_moves_homes_and_jogs_end_where_they_were_sent(daemon: Daemon) -> None:
    assert daemon.do("move", fraction=0.5).position_um == pytest.approx(1250.0, abs=0.4)
    assert daemon.do("jog", by_um=-100.0).position_um == pytest.approx(1150.0, abs=0.4)
    assert daemon.do("home").position_um == pytest.approx(0.0, abs=0.4)
    assert daemon.status.lens.referenced is True
    assert daemon.until_answered(daemon.ask("move", to_um=9999.0)).kind == "UsageError"
    assert daemon.status.state == "READY"


def test_a_second_motion_is_refused_and_the_first_goes_on(daemon: Daemon) -> None:
    first = daemon.ask("focus")
    with pytest.raises(BusyError, match="focus"):
        daemon.ask("move", to_um=100.0, by=SOMEBODY)
    assert daemon.until_answered(first).result.outcome == "FOCUSED"
    assert daemon.status.counters.refused == 1


@pytest.mark.parametrize(("phase", "after_ms"), [("expose", 10.0), ("sweep", 20.0), ("return", 10.0)])
def test_a_stop_leaves_at_once_and_the_lens_stays_where_it_stops(daemon: Daemon, phase: str, after_ms: float) -> None:
    stopped: list[tuple[int, float]] = []

    def stop() -> None:
        daemon.engine.stop()
        stopped.append((daemon.truth.world.now_ns(), daemon.steps))

    daemon.at_phase(phase, after_ms, stop)
    result = daemon.do("focus")
    assert result.outcome == "CANCELLED"
    assert "left where it stopped" in result.reason
    at_ns, steps = stopped[0]
    assert daemon.truth.mechanism.velocity_at(at_ns + 5_000_000) == 0.0
    assert abs(daemon.steps - steps) * daemon.parts.um_per_step < 50.0, "no way back to the start"
    daemon.run(1.0)
    assert daemon.velocity == 0.0


def test_a_cancelled_cycle_goes_back_to_its_declared_place(daemon: Daemon) -> None:
    start = daemon.steps
    daemon.at_phase("sweep", 20.0, daemon.engine.cancel)
    assert daemon.do("focus").outcome == "CANCELLED"
    assert abs(daemon.steps - start) <= 1.0
    assert daemon.status.counters.cancelled == 1


def test_a_stop_during_a_move_ends_it_there(daemon: Daemon) -> None:
    asked = daemon.ask("move", fraction=1.0)
    daemon.after_ms(50.0, daemon.engine.stop)
    assert daemon.until_answered(asked).result.outcome == "CANCELLED"
    assert asked.result.position_um < 2400.0
    assert daemon.velocity == 0.0


def test_a_stop_during_homing_leaves_the_lens_unreferenced_and_nothing_latched(daemon: Daemon) -> None:
    daemon.do("move", fraction=0.8)
    asked = daemon.ask("home")
    daemon.after_ms(100.0, daemon.engine.stop)
    assert daemon.until_answered(asked).kind == "Unreferenced"
    daemon.run(1.0)
    assert daemon.status.state == "READY"
    with pytest.raises(UnreferencedError, match="home it"):
        daemon.ask("focus")
    daemon.do("home")
    assert daemon.do("focus").outcome in {"FOCUSED", "NO_CROSSING"}


def test_what_was_cancelled_before_its_turn_never_moves(daemon: Daemon) -> None:
    before = daemon.steps
    focus = daemon.ask("focus")
    assert daemon.engine.cancel().cancelled
    assert daemon.until_answered(focus).result.outcome == "CANCELLED"
    move = daemon.ask("move", fraction=0.1)
    daemon.engine.stop()
    assert daemon.until_answered(move).kind == "Cancelled"
    assert daemon.steps == before


def test_a_region_outside_the_sensor_is_refused_before_anything_moves(daemon: Daemon) -> None:
    before = daemon.steps
    asked = daemon.ask("focus", roi={"x": 300, "y": 0, "width": 100, "height": 100})
    assert daemon.until_answered(asked).kind == "UsageError"
    assert daemon.steps == before
    assert daemon.status.state == "READY"


def test_regions_are_clamped_named_and_kept(daemon: Daemon, tmp_path: Path) -> None:
    answer = daemon.do("roi", set={"x": 200, "y": -20, "width": 500, "height": 200})
    assert answer.roi.model_dump() == {"x": 200, "y": 0, "width": 120, "height": 180}
    daemon.do("roi", set={"x": 0, "y": 0, "width": 64, "height": 64}, name="corner")
    assert set(daemon.do("roi").named) == {"corner"}
    assert isinstance(daemon.refused("roi", set={"x": 400, "y": 0, "width": 50, "height": 50}), UsageError)
    assert isinstance(daemon.refused("roi", name="nowhere"), UsageError)
    result = daemon.do("focus")
    assert result.details["roi"] == [200, 0, 120, 180]
    daemon.end()
    again = Daemon(tmp_path).begin()
    assert again.do("roi").roi == answer.roi
    again.do("roi", set=None)
    assert again.do("roi").roi is None
    again.do("roi", name="corner", delete=True)
    assert again.do("roi").named == {}


def test_a_preset_brings_the_lens_back(daemon: Daemon) -> None:
    focused = daemon.do("focus")
    daemon.do("preset", action="save", name="product 1")
    daemon.do("move", fraction=0.9)
    answer = daemon.do("preset", action="apply", name="product 1")
    assert answer.position_um == pytest.approx(focused.final_um, abs=0.4)
    assert abs(daemon.truth.carriage_error_um()) < 6.0, "the play was taken up on the way"
    assert daemon.until_answered(daemon.ask("preset", action="apply", name="none")).kind == "UsageError"
    assert [one.name for one in daemon.do("preset", action="list").presets] == ["product 1"]
    daemon.do("preset", action="delete", name="product 1")
    assert daemon.do("preset", action="list").presets == []


def test_a_focus_may_begin_at_a_preset(daemon: Daemon) -> None:
    daemon.do("focus")
    daemon.do("jog", by_um=-150.0)
    daemon.do("preset", action="save", name="near")
    daemon.do("home")
    assert daemon.do("focus", preset="near").outcome == "FOCUSED"


def test_a_lease_keeps_others_out_but_never_a_stop(daemon: Daemon) -> None:
    daemon.do("lease", action="acquire", seconds=10.0)
    with pytest.raises(BusyError, match="holds the lease"):
        daemon.ask("move", to_um=10.0, by=SOMEBODY)
    with pytest.raises(BusyError, match="holds the lease"):
        daemon.ask("mode", mode="continuous", by=SOMEBODY)
    assert daemon.do("mode", by=SOMEBODY).mode == "one-shot", "looking is free"
    assert daemon.ask("stop", by=SOMEBODY).result.stopped
    daemon.do("move", to_um=10.0)
    daemon.run(10.5)
    daemon.do("move", to_um=20.0, by=SOMEBODY)
    daemon.do("lease", action="acquire", seconds=10.0)
    daemon.engine.gone(ME)
    daemon.do("move", to_um=10.0, by=SOMEBODY)
    assert isinstance(daemon.refused("lease", action="renew"), BusyError)


@pytest.mark.parametrize(("policy", "outcome"), [("finish", "FOCUSED"), ("cancel", "CANCELLED")])
def test_whoever_goes_away_said_what_becomes_of_the_request(daemon: Daemon, policy: str, outcome: str) -> None:
    asked = daemon.ask("focus", on_disconnect=policy)
    daemon.at_phase("sweep", 10.0, lambda: daemon.engine.gone(ME))
    assert daemon.until_answered(asked).result.outcome == outcome


def test_pictures_of_each_kind(daemon: Daemon) -> None:
    assert daemon.until_answered(daemon.ask("map", kind="frame")).kind == "UsageError"
    daemon.do("focus", dry_run=True)
    for form in ("jpeg", "png", "png16"):
        picture = daemon.do("map", kind="map", format=form, max_width=100)
        assert (picture.width, picture.height, picture.sensor) == (100, 75, {"width": 320, "height": 240})
    daemon.run(2.0)
    assert daemon.do("map", kind="events").kind == "events"


def test_a_dry_run_keeps_its_map_for_the_next_focus(daemon: Daemon) -> None:
    before = daemon.steps
    assert daemon.do("focus", dry_run=True).outcome == "CANCELLED"
    assert daemon.steps == before
    result = daemon.do("focus", reference="last", roi={"x": 100, "y": 10, "width": 150, "height": 120})
    assert result.outcome == "FOCUSED"
    assert daemon.until_answered(daemon.ask("focus", reference="/nowhere.png")).kind == "UsageError"


def test_events_are_recorded_without_motion(daemon: Daemon) -> None:
    before = daemon.steps
    answer = daemon.do("record", seconds=0.05, name="quiet room")
    assert Path(answer.path).name == "quiet-room"
    assert answer.events > 0
    assert answer.bytes > 0
    assert daemon.steps == before
    assert daemon.do("runs").runs[0].kept


def test_in_manual_mode_autofocus_never_moves_the_lens(daemon: Daemon) -> None:
    daemon.do("mode", mode="manual")
    before = daemon.steps
    assert isinstance(daemon.refused("focus"), UsageError)
    daemon.run(1.0)
    assert daemon.steps == before
    daemon.do("move", to_um=100.0)


def test_before_it_is_ready_and_after_it_ends_nothing_is_taken(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path)
    assert daemon.status.state == "STARTING"
    assert isinstance(daemon.refused("focus"), UnavailableError)
    daemon.begin()
    asked = daemon.ask("move", fraction=1.0)
    daemon.after_ms(30.0, daemon.engine.begin_stopping)
    daemon.until_answered(asked)
    assert asked.result.outcome == "CANCELLED"
    assert isinstance(daemon.refused("focus"), UnavailableError)
    daemon.engine.finish_stopping()
    assert daemon.status.state == "STOPPING"


def test_a_fault_refuses_until_it_is_cleared(daemon: Daemon) -> None:
    daemon.engine.situation.latch("LensError", "lens: it smokes")
    assert isinstance(daemon.refused("focus"), FaultLatchedError)
    assert daemon.status.state == "FAULT"
    answer = daemon.do("clear")
    assert answer.cleared.message == "lens: it smokes"
    assert answer.state == "READY"
    daemon.do("move", to_um=100.0)
    assert daemon.engine.keeper.stop_lens(StopMode.RAMPED) is None


def test_metrics_tell_the_state(daemon: Daemon) -> None:
    assert 'elpd_state{state="READY"} 1.0' in daemon.do("metrics").text
