"""What the daemon does by itself: focuses when sharpness was lost, follows a temperature, gives way to everybody."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from engines import SOMEBODY, Daemon

from elpd.service.threads import FOCUS_LIMIT_S, FORGOTTEN_AFTER_LOOKS, Supervisor
from elpd.timebase import MonotonicClock

if TYPE_CHECKING:
    from pathlib import Path


KNOCK_UM = 60.0
TABLE = "temperature.table=[[0.0, 0.0], [40.0, -80.0]]"


@pytest.fixture
def watching(tmp_path: Path) -> Daemon:
    """A daemon in continuous mode that has focused."""
    daemon = Daemon(tmp_path, "journal.enabled=false").begin()
    daemon.do("mode", mode="continuous")
    daemon.until(lambda: daemon.status.counters.focused == 1)
    return daemon


def knock(daemon: Daemon, by_um: float = KNOCK_UM) -> None:
    daemon.truth.drift.shift(daemon.truth.world.now_ns(), by_um, 50.0)


def test_a_scene_that_stays_sharp_is_left_alone(watching: Daemon) -> None:
    steps = watching.steps
    watching.run(8.0)
    assert watching.status.counters.focused == 1
    assert watching.steps == steps


def test_a_knock_is_focused_away_after_the_hold_off(watching: Daemon) -> None:
    watching.run(2.5)
    knock(watching)
    assert abs(watching.truth.carriage_error_um()) < 6.0 or watching.run(0.1) is None
    watching.until(lambda: watching.status.counters.focused == 2, 5.0)
    assert abs(watching.truth.carriage_error_um()) < 6.0
    assert watching.do("mode").hold["loss"] == 0.0


def test_two_knocks_at_once_wait_for_the_hold_off(watching: Daemon) -> None:
    watching.run(0.5)
    knock(watching)
    watching.run(1.0)
    assert watching.status.counters.focused == 1
    assert watching.do("mode").hold["waits_for"] == "the end of the hold-off"
    watching.until(lambda: watching.status.counters.focused == 2, 3.0)


def test_nothing_moves_by_itself_while_somebody_holds_the_lease(watching: Daemon) -> None:
    watching.run(2.5)
    watching.do("lease", action="acquire", seconds=3.0, by=SOMEBODY)
    knock(watching)
    steps = watching.steps
    watching.run(2.5)
    assert watching.steps == steps
    assert watching.do("mode").hold["defocused"] is True
    watching.until(lambda: watching.status.counters.focused == 2, 3.0)


def test_a_place_that_somebody_chose_is_kept(watching: Daemon) -> None:
    watching.run(2.5)
    watching.do("move", fraction=0.2)
    knock(watching)
    steps = watching.steps
    watching.run(4.0)
    assert watching.steps == steps
    assert "moved the lens" in watching.do("mode").hold["waits_for"]


def test_after_a_stop_it_waits_to_be_asked(watching: Daemon) -> None:
    watching.run(2.5)
    knock(watching)
    watching.at_phase("sweep", 5.0, watching.engine.stop)
    watching.until(lambda: watching.status.counters.cancelled == 1, 5.0)
    steps = watching.steps
    watching.run(4.0)
    assert watching.steps == steps
    watching.do("mode", mode="continuous")
    watching.until(lambda: watching.status.counters.focused == 2, 5.0)


def test_somebodys_request_ends_its_own_cycle_and_comes_first(watching: Daemon) -> None:
    watching.run(2.5)
    knock(watching)
    asked = []
    watching.at_phase("sweep", 5.0, lambda: asked.append(watching.ask("move", fraction=0.9)))
    watching.until(lambda: bool(asked), 5.0)
    assert watching.until_answered(asked[0]).result.outcome == "OK"
    assert watching.steps * watching.parts.um_per_step == pytest.approx(2250.0, abs=1.0)


def test_a_scene_without_texture_is_given_up_on(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "sim.scene=flat", "journal.enabled=false", "modes.hold_off_s=0.01").begin()
    daemon.do("mode", mode="continuous")
    daemon.run(10.0)
    assert sum(daemon.status.counters.not_focused.values()) == 7
    assert "after 7 cycles" in daemon.do("mode").hold["waits_for"]


def test_a_schedule_checks_again(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "journal.enabled=false").begin()
    daemon.do("mode", mode="scheduled", period_s=5.0)
    daemon.run(16.5)
    assert daemon.status.counters.focused == 3


def test_a_temperature_moves_the_lens_by_the_table_and_no_further_than_allowed(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, TABLE, "temperature.max_step_um=20", "journal.enabled=false").begin()
    assert daemon.do("temperature", celsius=20.0).offset_um is None, "nothing was focused yet"
    focus_um = daemon.do("focus").final_um
    daemon.run(1.0)
    assert daemon.status.lens.position_um == pytest.approx(focus_um, abs=0.4)
    assert daemon.do("temperature", celsius=25.0).offset_um == pytest.approx(-10.0)
    daemon.run(1.0)
    assert daemon.status.lens.position_um == pytest.approx(focus_um - 10.0, abs=0.4)
    assert daemon.do("temperature", celsius=26.0).offset_um == pytest.approx(-12.0)
    daemon.run(1.0)
    assert daemon.status.lens.position_um == pytest.approx(focus_um - 10.0, abs=0.4), "2 um are not worth a move"
    daemon.do("temperature", celsius=35.0)
    places = [event.position_um for event in daemon.told("position") if event.moving is False]
    daemon.run(2.0)
    assert daemon.status.lens.position_um == pytest.approx(focus_um - 30.0, abs=0.4)
    assert places


def test_a_temperature_moves_nothing_while_focusing_held_or_in_manual_mode(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, TABLE, "journal.enabled=false").begin()
    daemon.do("temperature", celsius=20.0)
    daemon.do("focus")
    daemon.at_phase("sweep", 5.0, lambda: daemon.ask("temperature", celsius=30.0))
    result = daemon.do("focus")
    assert abs(result.truth["final_error_um"]) < 6.0, "the cycle went its own way"
    daemon.do("lease", action="acquire", seconds=5.0)
    steps = daemon.steps
    daemon.do("temperature", celsius=20.0)
    daemon.run(1.0)
    assert daemon.steps == steps
    daemon.do("lease", action="release")
    daemon.do("mode", mode="manual")
    daemon.run(1.0)
    assert daemon.steps == steps
    daemon.do("mode", mode="one-shot")
    daemon.run(1.0)
    assert daemon.steps != steps


def test_a_focus_thread_that_hangs_has_its_lens_stopped_and_no_watchdog_fed(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path).begin()
    clock = [100.0]
    beats = daemon.engine.heartbeats
    beats._now_s = lambda: clock[0]
    beats.expect("focus", FOCUS_LIMIT_S)
    notifier = FakeNotifier()
    supervisor = Supervisor(daemon.engine, notifier, lambda: 0.0)  # type: ignore[arg-type]
    supervisor.look()
    assert notifier.fed == 1
    asked = daemon.ask("move", fraction=1.0)
    assert daemon.engine.place.take() is asked.job
    daemon.parts.lens.run(2000.0, daemon.truth.world.now_ns() + 2_000_000_000)
    daemon.truth.world.sleep_until(daemon.truth.world.now_ns() + 20_000_000)
    assert daemon.velocity != 0.0
    clock[0] += FOCUS_LIMIT_S + 0.1
    supervisor.look()
    supervisor.look()
    daemon.truth.world.sleep_until(daemon.truth.world.now_ns() + 10_000_000)
    assert daemon.velocity == 0.0
    assert notifier.fed == 1
    assert daemon.status.fault is not None
    assert daemon.status.fault.kind == "Hang"
    assert daemon.status.counters.faults == 1
    assert asked.job.cancelled
    beats.beat("focus")
    supervisor.look()
    assert notifier.fed == 2


def test_a_focus_thread_that_is_slow_while_nothing_is_done_is_no_fault(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path).begin()
    clock = [100.0]
    daemon.engine.heartbeats._now_s = lambda: clock[0]
    daemon.engine.heartbeats.expect("focus", FOCUS_LIMIT_S)
    notifier = FakeNotifier()
    clock[0] += FOCUS_LIMIT_S + 0.1
    Supervisor(daemon.engine, notifier, lambda: 0.0).look()  # type: ignore[arg-type]
    assert notifier.fed == 0
    assert daemon.status.state == "READY"


def test_a_starved_machine_is_no_hang(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path).begin()
    clock, in_line = [100.0], [0.0]
    beats = daemon.engine.heartbeats
    beats._now_s = lambda: clock[0]
    beats.expect("focus", FOCUS_LIMIT_S)
    notifier = FakeNotifier()
    supervisor = Supervisor(daemon.engine, notifier, lambda: in_line[0])  # type: ignore[arg-type]
    supervisor.look()
    asked = daemon.ask("move", fraction=1.0)
    assert daemon.engine.place.take() is asked.job
    daemon.parts.lens.run(2000.0, daemon.truth.world.now_ns() + 2_000_000_000)
    daemon.truth.world.sleep_until(daemon.truth.world.now_ns() + 20_000_000)
    clock[0] += FOCUS_LIMIT_S + 0.5
    in_line[0] += FOCUS_LIMIT_S
    supervisor.look()
    assert notifier.fed == 2, "nobody ends a process for what the machine does"
    assert daemon.status.fault is None
    assert [one.code for one in daemon.status.warnings] == ["overloaded"]
    assert not asked.job.cancelled
    assert daemon.velocity != 0.0, "this lens's time stands still while nobody computes it"
    clock[0] += 1.0
    supervisor.look()
    assert daemon.status.fault is not None, "the second that followed was its own"
    assert daemon.status.fault.kind == "Hang"
    beats.beat("focus")
    for _ in range(FORGOTTEN_AFTER_LOOKS):
        supervisor.look()
    assert not daemon.status.warnings


def test_a_lens_that_moves_by_itself_is_stopped_on_a_starved_machine(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path).begin()
    clock, in_line = [100.0], [0.0]
    daemon.engine.heartbeats._now_s = lambda: clock[0]
    daemon.engine.heartbeats.expect("focus", FOCUS_LIMIT_S)
    supervisor = Supervisor(daemon.engine, FakeNotifier(), lambda: in_line[0])  # type: ignore[arg-type]
    supervisor.look()
    asked = daemon.ask("move", fraction=1.0)
    assert daemon.engine.place.take() is asked.job
    daemon.parts.lens.run(2000.0, daemon.truth.world.now_ns() + 2_000_000_000)
    daemon.truth.world.sleep_until(daemon.truth.world.now_ns() + 20_000_000)
    assert daemon.engine.keeper.parts is not None
    daemon.engine.keeper.parts = replace(daemon.engine.keeper.parts, clock=MonotonicClock())
    clock[0] += FOCUS_LIMIT_S + 0.5
    in_line[0] += FOCUS_LIMIT_S
    supervisor.look()
    daemon.truth.world.sleep_until(daemon.truth.world.now_ns() + 10_000_000)
    assert daemon.velocity == 0.0
    assert daemon.status.fault is None
    assert asked.job.cancelled
    assert "overloaded" in (asked.job.why_cancelled or "")


class FakeNotifier:
    fed = 0

    def alive(self) -> None:
        self.fed += 1


FAR = ("sim.scene=random", "sim.seed=705", "journal.enabled=false")
"""Focus lies 1.7 mm from the reference, where a picture shows nothing of the scene."""


def test_a_lens_that_was_homed_far_away_is_brought_to_focus(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, *FAR).begin()
    daemon.do("home")
    daemon.do("mode", mode="continuous")
    daemon.until(lambda: daemon.status.counters.focused == 1)
    assert daemon.status.counters.not_focused == {"NO_CROSSING": 1}, "from the reference, and then from elsewhere"
    assert abs(daemon.truth.carriage_error_um()) < 6.0


def test_where_there_is_no_focus_the_travel_is_searched_once_and_the_lens_put_back(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "sim.scene=flat", "journal.enabled=false", "modes.hold_off_s=0.01").begin()
    daemon.do("home")
    daemon.do("mode", mode="continuous")
    seen = []
    daemon.engine.listen(lambda event: seen.append(daemon.status.lens.position_um) if event.event == "result" else None)
    daemon.run(10.0)
    assert [round(place) for place in seen] == [0, 625, 1875, 0, 0, 0, 0]
    assert "at places all over the lens's travel" in daemon.do("mode").hold["waits_for"]


def test_a_search_over_the_travel_gives_way_to_a_stop(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "sim.scene=flat", "journal.enabled=false", "modes.hold_off_s=0.01").begin()
    daemon.do("home")
    daemon.do("mode", mode="continuous")
    daemon.until(lambda: sum(daemon.status.counters.not_focused.values()) == 1)
    daemon.after_ms(50.0, lambda: daemon.engine.stop() and None)
    daemon.run(3.0)
    at_um = daemon.status.lens.position_um
    assert at_um is not None
    assert 10.0 < at_um < 615.0, "on the way to the first place"
    assert sum(daemon.status.counters.not_focused.values()) == 1
    assert "somebody stopped the lens" in daemon.do("mode").hold["waits_for"]
