"""Errands: home, go there, go so much further, stop; each to rest, by report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from command_line import Answer, caller
from lens_rigs import KINDS, UM_PER_STEP, Rig, needs, open_rig

from elpd.errors import LensError, UsageError
from elpd.motion.errand import Errands
from elpd.scale import LensScale

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SPEED_UM_S = 4000.0


def errands(rig: Rig, cancelled: Callable[[], bool] = lambda: False) -> Errands:
    return Errands(rig.clock, rig.lens, LensScale(UM_PER_STEP), cancelled)


@pytest.mark.parametrize("kind", KINDS)
def test_a_move_ends_at_rest_where_it_was_sent(kind: str) -> None:
    rig = open_rig(kind)
    arrival = errands(rig).move_to(1300.0, SPEED_UM_S)
    assert not rig.moving
    assert arrival.um == pytest.approx(1300.0, abs=UM_PER_STEP)
    assert rig.rotor * UM_PER_STEP == pytest.approx(1300.0, abs=UM_PER_STEP)
    assert arrival.referenced
    assert not arrival.cancelled
    assert 300.0 / SPEED_UM_S * 1000 < arrival.duration_ms < 500.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_place_between_whole_micrometres_is_reached_too(kind: str) -> None:
    rig = open_rig(kind)
    arrival = errands(rig).move_to(1096.44, SPEED_UM_S)
    assert rig.rotor * UM_PER_STEP == pytest.approx(1096.44, abs=UM_PER_STEP)
    assert arrival.um == pytest.approx(1096.44, abs=1.0)  # GRBL reports micrometres


@pytest.mark.parametrize("kind", KINDS)
def test_a_jog_is_relative_and_refused_whole_beyond_a_limit(kind: str) -> None:
    rig = open_rig(kind)
    job = errands(rig)
    assert job.jog(-20.0, SPEED_UM_S).um == pytest.approx(980.0, abs=UM_PER_STEP)
    before = rig.rotor
    with pytest.raises(UsageError, match="outside the travel"):
        job.jog(5000.0, SPEED_UM_S)
    with pytest.raises(UsageError, match="nan um"):
        job.move_to(float("nan"), SPEED_UM_S)
    assert rig.rotor == before


@pytest.mark.parametrize("kind", KINDS)
def test_a_jog_from_nobody_knows_where_says_so_however_far_it_leads(kind: str) -> None:
    rig = open_rig(kind, referenced=False)
    before = rig.rotor
    for by_um in (-5.0, 5000.0):
        with pytest.raises(LensError, match="cannot jog by um, its position is unknown; home it first"):
            errands(rig).jog(by_um, SPEED_UM_S)
    assert rig.rotor == before


@pytest.mark.parametrize("kind", KINDS)
def test_homing_gives_a_reference_and_its_deadline_is_kept(kind: str) -> None:
    rig = open_rig(kind, referenced=False)
    assert errands(rig).home(10_000.0).referenced
    rig = open_rig(kind, referenced=False)
    with pytest.raises(LensError, match="deadline"):
        errands(rig).home(20.0)
    rig.live(1500.0, lambda: None)
    assert not rig.moving, "a homing that was given up does not go on"


@pytest.mark.parametrize("kind", KINDS)
@needs("stops", "the controller cannot be stopped while it moves")
def test_an_errand_that_is_cancelled_stops_on_its_way(kind: str) -> None:
    rig = open_rig(kind)
    from_ns = rig.clock.now_ns()
    arrival = errands(rig, lambda: rig.clock.now_ns() > from_ns + 30_000_000).move_to(2000.0, SPEED_UM_S)
    assert arrival.cancelled
    assert not rig.moving
    assert 1010.0 < arrival.um < 1900.0
    assert arrival.steps == pytest.approx(rig.rotor, abs=1e-3)


def test_an_errand_that_is_cancelled_waits_for_what_cannot_be_stopped() -> None:
    rig = open_rig("theia")
    from_ns = rig.clock.now_ns()
    arrival = errands(rig, lambda: rig.clock.now_ns() > from_ns + 30_000_000).move_to(2400.0, 640.0)
    assert arrival.cancelled
    assert arrival.duration_ms > 1900.0, "longer than a lens that stops is waited for"
    assert not rig.moving
    assert arrival.um == 2400.0


def test_stop_says_where_and_may_be_asked_twice() -> None:
    rig = open_rig("tic")
    rig.lens.run(SPEED_UM_S / UM_PER_STEP, rig.soon(1000.0))
    rig.live(40.0)
    assert rig.moving
    first = errands(rig).stop()
    assert not rig.moving
    assert first.um == pytest.approx(rig.rotor * UM_PER_STEP, abs=UM_PER_STEP)
    assert errands(rig).stop().steps == first.steps


def test_a_lens_that_never_rests_is_a_fault_and_not_a_wait() -> None:
    rig = open_rig("tic")
    rig.live(20.0)
    rig.lens.poll = lambda: None  # reports no more
    before_ns = rig.clock.now_ns()
    with pytest.raises(LensError, match="not at rest within"):
        errands(rig).move_to(1100.0, SPEED_UM_S)
    assert rig.clock.now_ns() - before_ns < 2_000_000_000


def test_an_unreferenced_lens_refuses_a_place_and_says_what_to_do() -> None:
    rig = open_rig("tic", referenced=False)
    with pytest.raises(LensError, match="home it first"):
        errands(rig).move_to(1100.0, SPEED_UM_S)


@pytest.fixture
def elpd(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Answer]:
    return caller(capsys, monkeypatch, tmp_path)


def test_the_commands_speak_json(elpd: Callable[..., Answer]) -> None:
    fields = {"outcome", "position_um", "position_steps", "from_um", "referenced", "duration_ms", "limits_um"}
    for arguments in (["home"], ["move", "700"], ["jog", "-20"], ["jog", "+20", "--speed", "1000"], ["stop"]):
        answer = elpd(*arguments, "--foreground", "--json")
        assert answer.code == 0, answer.err
        assert fields <= set(answer.json)
        assert answer.json["outcome"] == "OK"
    assert elpd("move", "700", "--foreground", "--json").json["position_um"] == pytest.approx(700.0, abs=UM_PER_STEP)
    assert elpd("jog", "-20", "--foreground").code == 0


def test_the_commands_refuse_what_makes_no_sense(elpd: Callable[..., Answer]) -> None:
    assert elpd("move", "700", "--json").json["error"]["kind"] == "BusyError"
    assert elpd("move", "700").code == 4
    assert elpd("move", "1e9", "--foreground", "--json").json["error"]["kind"] == "UsageError"
    assert elpd("move", "here", "--foreground").code == 2
    assert elpd("move", "700", "--speed", "0", "--foreground").code == 2
    assert elpd("home", "--limit", "0.01", "--foreground").code == 3
