"""The daemon's rig breaks: a named fault, latched; the rig comes back by itself, the lens never moves by itself."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from engines import ME, Daemon

from elpd import rig
from elpd.errors import ConfigError, FaultLatchedError, LensError, UnreferencedError
from elpd.service.keeper import LAST_RETRY_S

if TYPE_CHECKING:
    from pathlib import Path

    from engines import Asked

    from elpd.config import Config
    from elpd.ports import RigParts


@pytest.fixture
def daemon(tmp_path: Path) -> Daemon:
    return Daemon(tmp_path).begin()


def test_a_lens_that_is_unplugged_while_idle_is_a_fault_and_comes_back_unreferenced(daemon: Daemon) -> None:
    daemon.truth.port.faults.disconnect_at_ns = daemon.truth.world.now_ns()
    daemon.until(lambda: daemon.status.state == "FAULT")
    fault = daemon.status.fault
    assert fault is not None
    assert fault.kind == "LensError"
    assert "device is gone" in fault.message
    assert [event.kind for event in daemon.told("fault")] == ["LensError"]
    daemon.until(lambda: daemon.status.lens.connected, 2.0)
    daemon.run(0.5)
    assert daemon.status.state == "FAULT", "a fault stays until somebody clears it"
    assert daemon.status.lens.referenced is False
    steps = daemon.steps
    with pytest.raises(FaultLatchedError, match="clear it"):
        daemon.ask("focus")
    assert daemon.do("clear").state == "READY"
    with pytest.raises(UnreferencedError, match="home it"):
        daemon.ask("focus")
    with pytest.raises(UnreferencedError):
        daemon.ask("move", to_um=1.0)
    daemon.run(1.0)
    assert daemon.steps == steps, "nothing moves by itself"
    daemon.do("home")
    assert daemon.status.lens.referenced is True
    daemon.do("move", fraction=0.3)


@pytest.mark.parametrize(("phase", "after_ms"), [("expose", 5.0), ("sweep", 20.0), ("return", 5.0)])
def test_a_lens_that_is_lost_in_a_cycle_ends_the_request_with_its_error(
    daemon: Daemon, phase: str, after_ms: float
) -> None:
    faults = daemon.truth.port.faults
    world = daemon.truth.world
    daemon.at_phase(phase, after_ms, lambda: setattr(faults, "disconnect_at_ns", world.now_ns()))
    asked = daemon.until_answered(daemon.ask("focus"))
    assert asked.kind == "LensError"
    assert daemon.status.state == "FAULT"
    assert daemon.status.counters.faults == 1
    daemon.run(1.0)
    assert daemon.status.lens.connected
    assert daemon.status.lens.referenced is False


@pytest.mark.parametrize("key", ["camera_vanishes_at_s", "camera_silent_from_s"])
def test_a_camera_that_is_lost_in_a_cycle_stops_the_lens(tmp_path: Path, key: str) -> None:
    daemon = Daemon(tmp_path, f"sim.{key}=0.15", "service.look_every_s=1000").begin()
    world, mechanism = daemon.truth.world, daemon.truth.mechanism
    asked = daemon.until_answered(daemon.ask("focus"))
    assert asked.kind == "CameraError"
    world.sleep_until(world.now_ns() + 10_000_000)
    assert mechanism.velocity_at(world.now_ns() - 5_000_000) == 0.0
    assert daemon.status.fault is not None
    daemon.until(lambda: daemon.status.camera.connected, 2.0)
    daemon.do("clear")
    daemon.do("move", fraction=0.5)  # the lens was never lost: it knows where it is


def test_a_camera_that_never_speaks_in_a_cycle_is_lost_not_a_mistake_of_the_program(tmp_path: Path) -> None:
    """The aperture opens within milliseconds: before anybody could call the camera silent."""
    daemon = Daemon(tmp_path, "sim.camera_silent_from_s=0", "service.look_every_s=1000").begin()
    asked = daemon.until_answered(daemon.ask("focus"))
    assert asked.kind == "CameraError"
    assert daemon.status.fault is not None
    assert "check its cable" in daemon.status.fault.message


def test_a_camera_that_falls_silent_while_idle_is_a_fault(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "sim.camera_silent_from_s=0.2", "service.look_every_s=0").begin()
    daemon.until(lambda: daemon.status.state == "FAULT", 5.0)
    assert daemon.status.fault is not None
    assert "no data for 1" in daemon.status.fault.message


@pytest.mark.parametrize("refusal", [LensError, ConfigError])
def test_a_rig_that_stays_away_is_tried_again_with_growing_patience(
    tmp_path: Path, refusal: type[LensError | ConfigError]
) -> None:
    attempts: list[float] = []
    daemons: list[Daemon] = []
    gone = True

    def build(config: Config) -> RigParts:
        attempts.append(daemons[0].time.now_s())
        if gone:
            raise refusal("lens port /dev/lens0: there is no such port; plug the controller in")
        return rig.build(config)

    daemon = Daemon(tmp_path, build=build)
    daemons.append(daemon)
    daemon.begin()
    assert daemon.status.state == "FAULT", "a daemon without its rig runs, and says what is missing"
    daemon.run(60.0)
    waits = [round(after - before, 3) for before, after in pairwise(attempts)]
    assert waits[0] < 0.2
    assert waits == sorted(waits)
    assert LAST_RETRY_S <= waits[-1] < LAST_RETRY_S + 0.2
    assert daemon.do("clear").state == "READY"
    daemon.run(0.2)
    assert daemon.status.state == "FAULT", "it is still away: the fault is there again"
    gone = False
    daemon.engine.clear()
    daemon.run(0.2)
    assert daemon.status.state == "READY"
    assert daemon.status.counters.faults == 2


def test_a_daemon_that_was_killed_comes_back_unreferenced_and_does_not_move(tmp_path: Path) -> None:
    first = Daemon(tmp_path).begin()
    first.ask("move", fraction=1.0)  # and then SIGKILL: nothing is said to anybody any more
    again = Daemon(tmp_path).begin()
    steps = again.steps
    again.run(2.0)
    assert again.steps == steps
    assert again.status.lens.referenced is False
    assert isinstance(again.refused("focus"), UnreferencedError)
    again.do("home")
    again.end()
    third = Daemon(tmp_path).begin()
    third.run(0.1)
    assert third.status.lens.referenced is True, "an end in order leaves nothing to doubt"


def test_a_crash_loop_moves_nothing_and_is_not_forgotten(tmp_path: Path) -> None:
    Daemon(tmp_path).begin().ask("move", fraction=1.0)  # and then SIGKILL, as after each of the next
    for _ in range(5):
        again = Daemon(tmp_path, "modes.start=continuous").begin()
        steps = again.steps
        again.run(1.0)
        assert again.steps == steps
        assert again.status.lens.referenced is False
        assert isinstance(again.refused("focus"), UnreferencedError)
        assert [warned.code for warned in again.status.warnings] == ["ended-badly"]
    again.do("home")
    assert again.status.warnings == []
    again.end()
    last = Daemon(tmp_path).begin()
    last.run(0.1)
    assert last.status.lens.referenced is True


@pytest.mark.parametrize("broken", [RuntimeError("a mistake of the driver's own"), MemoryError()])
def test_what_nobody_expects_in_a_cycle_is_a_fault_with_the_lens_at_rest(tmp_path: Path, broken: Exception) -> None:
    daemon = Daemon(tmp_path).begin()

    def fail() -> None:
        raise broken

    daemon.at_phase("sweep", 10.0, fail)
    asked = daemon.until_answered(daemon.ask("focus"))
    assert asked.kind == "InternalError"
    assert daemon.status.state == "FAULT"
    daemon.run(1.0)
    assert daemon.velocity == 0.0
    assert daemon.status.camera.connected, "the rig was opened anew"
    daemon.do("clear")
    daemon.do("home")
    assert daemon.do("focus").outcome == "FOCUSED"


def test_continuous_mode_does_not_begin_by_itself_after_a_start(tmp_path: Path) -> None:
    first = Daemon(tmp_path).begin()
    first.do("mode", mode="continuous")
    first.end()
    again = Daemon(tmp_path).begin()
    steps = again.steps
    again.run(4.0)
    assert again.do("mode").mode == "continuous"
    assert again.steps == steps
    assert "asked for" in again.do("mode").hold["waits_for"]


def test_a_process_that_was_stopped_in_a_sweep_stops_the_lens_and_says_so(daemon: Daemon) -> None:
    world = daemon.truth.world
    daemon.at_phase("sweep", 15.0, lambda: _jump(world, 0.7))
    result = daemon.do("focus")
    assert result.outcome == "CANCELLED"
    assert "stood still for 0.7 s" in result.reason
    assert daemon.velocity == 0.0
    assert daemon.status.state == "READY"


def test_a_pause_that_outlasts_the_boards_own_dead_man_is_a_fault(daemon: Daemon) -> None:
    world, mechanism = daemon.truth.world, daemon.truth.mechanism
    daemon.at_phase("sweep", 15.0, lambda: _jump(world, 3.0))
    asked = daemon.until_answered(daemon.ask("focus"))
    assert asked.kind == "LensError"
    assert mechanism.velocity_at(world.now_ns()) == 0.0
    assert daemon.status.fault is not None


def test_a_process_that_was_stopped_while_idle_forgets_the_scene(daemon: Daemon) -> None:
    daemon.do("mode", mode="continuous")
    daemon.until(lambda: daemon.status.counters.focused == 1)
    daemon.after_ms(50.0, lambda: _jump(daemon.truth.world, 5.0))
    daemon.run(6.0)
    assert [warned.code for warned in daemon.status.warnings] == ["paused"]
    assert daemon.status.state in {"READY", "FAULT"}


def test_a_reload_waits_until_the_lens_rests(daemon: Daemon) -> None:
    asked = daemon.ask("focus")
    daemon.at_phase("sweep", 10.0, lambda: daemon.engine.reload(daemon.config("focus.deadline_ms=1")))
    assert daemon.until_answered(asked).result.outcome == "FOCUSED", "by the configuration that it began with"
    assert daemon.do("focus").outcome == "DEADLINE"
    assert daemon.built == 1, "the rig stayed open: it is the same rig"
    daemon.engine.reload(daemon.config("sim.seed=4"))
    daemon.run(0.2)
    assert daemon.built == 2


def test_another_camera_waits_for_its_kernels_and_so_does_who_asks_for_focus_meanwhile(tmp_path: Path) -> None:
    prepared: list[tuple[str, list[str]]] = []

    def prepare(config: Config) -> None:
        prepared.append((config.sim.model_dump()["camera"], [warned.code for warned in daemon.status.warnings]))
        asked.append(daemon.ask("focus"))

    asked: list[Asked] = []
    daemon = Daemon(tmp_path, prepare=prepare).begin()
    assert daemon.do("focus").outcome == "FOCUSED"
    assert prepared == [], "the first configuration's are there before the daemon begins"
    daemon.engine.reload(daemon.config("sim.camera=davis346"))
    daemon.until(lambda: bool(asked))
    assert daemon.until_answered(asked[0]).result.outcome == "FOCUSED"
    assert prepared == [("davis346", ["compiling"])], "once, and said"
    assert not daemon.status.warnings


def test_a_daemon_that_is_asked_to_end_while_it_compiles_ends(tmp_path: Path) -> None:
    def prepare(config: Config) -> None:
        del config
        daemon.engine.begin_stopping()
        raise SystemExit(0)

    daemon = Daemon(tmp_path, prepare=prepare).begin()
    daemon.engine.reload(daemon.config("sim.camera=davis346"))
    daemon.engine.step()
    daemon.engine.finish_stopping()
    assert (daemon.built, daemon.status.state) == (1, "STOPPING")


def test_a_journal_that_cannot_be_written_costs_the_journal_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    daemon = Daemon(tmp_path, f"journal.directory={tmp_path / 'file'}").begin()
    result = daemon.do("focus")
    assert (result.outcome, result.run) == ("FOCUSED", None)
    assert daemon.until_answered(daemon.ask("record", seconds=0.1)).kind == "UsageError"
    assert daemon.do("runs").runs == []


def test_a_state_that_cannot_be_written_is_told_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    daemon = Daemon(tmp_path, f"state.directory={tmp_path / 'file'}", "state.profiles=false").begin()
    daemon.do("roi", set={"x": 0, "y": 0, "width": 64, "height": 64})
    assert [warned.code for warned in daemon.status.warnings] == ["state-not-saved"]
    assert daemon.do("focus").outcome in {"FOCUSED", "NO_TEXTURE", "LOW_CONFIDENCE", "NO_CROSSING"}


def test_a_state_that_is_damaged_is_told_and_the_copy_of_before_is_used(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path).begin()
    daemon.do("roi", set={"x": 0, "y": 0, "width": 64, "height": 64})
    daemon.do("roi", set={"x": 8, "y": 8, "width": 64, "height": 64})
    path = tmp_path / "state" / "service.json"
    path.write_bytes(path.read_bytes()[:-20])
    again = Daemon(tmp_path).begin()
    assert again.do("roi").roi.x == 0
    assert {warned.code for warned in again.status.warnings} == {"state-damaged", "ended-badly"}


def test_old_runs_go_when_all_together_are_too_large(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, "journal.budget_mb=0.9").begin()
    names = [daemon.do("focus", by=ME).run for _ in range(4)]
    left = [one.name for one in daemon.do("runs").runs]
    assert left[0] == names[-1]
    assert len(left) < 4
    size = sum(file.stat().st_size for file in (tmp_path / "runs").rglob("*") if file.is_file())
    assert size <= 0.9e6 or len(left) == 1


def _jump(world: object, seconds: float) -> None:
    """Let the world's time pass at once, as it does for a process that is stopped."""
    world._now += round(seconds * 1e9)  # type: ignore[attr-defined]
