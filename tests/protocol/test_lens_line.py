"""What the line between a driver and its controller may do to it, for every driver, in virtual time.

In memory, and through a real serial port's driver and the kernel's terminal, which time waits for.
"""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lens_rigs import DIALECTS, KINDS, LINES, SPEED_SPS, Rig, needs, open_rig, rig, rigs_over

from elpd.errors import LensError
from elpd.records import LensFlag, StopMode
from elpd.units import Steps

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(params=LINES, scope="module", autouse=True)
def _line(request: pytest.FixtureRequest) -> Iterator[None]:
    with rigs_over(request.param):
        yield


def running(kind: str, speed_sps: float, for_ms: float = 40) -> Rig:
    """Return a rig whose lens has been running up at that speed for so long."""
    made = open_rig(kind)
    made.lens.run(speed_sps, made.soon(3000))
    made.live(for_ms)
    return made


def test_replies_that_come_twice_do_no_harm(kind: str) -> None:
    made = running(kind, SPEED_SPS / 4, 0)
    twice = iter([True] * 4)
    made.port.faults.garble = lambda data: data * 2 if next(twice, False) else data
    made.live(300)
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)


def test_replies_that_come_late_and_out_of_order_do_no_harm(kind: str) -> None:
    for turn in range(6):
        made = running(kind, SPEED_SPS / 4, 20 + 1.7 * turn)
        seen: list[bytes] = []

        def late(data: bytes, seen: list[bytes] = seen) -> bytes:
            seen.append(data)
            if len(seen) < 3:
                return b""
            return data + seen[1] + seen[0] if len(seen) == 5 else data

        made.port.faults.garble = late
        made.live(300)
        assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)
        assert made.moving


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_silence_stops_the_motor_and_is_latched(kind: str) -> None:
    made = running(kind, SPEED_SPS)
    made.port.faults.drop_to_host = True
    begun = made.clock.now_ns()
    with pytest.raises(LensError, match="limit"):
        made.live(200)
    assert made.clock.now_ns() - begun < 100e6
    made.clock.pass_ms(made.dialect.hardest_stop_ms)
    assert not made.moving
    with pytest.raises(LensError):
        made.lens.run(SPEED_SPS, made.soon(100))


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_a_line_that_is_dead_outwards_ends_the_motion_inside_the_limits(kind: str) -> None:
    made = running(kind, SPEED_SPS)
    made.port.faults.drop_to_board = True
    with pytest.raises(LensError):
        made.live(200)
    made.clock.pass_ms(3000)
    assert not made.moving
    assert made.rotor <= 8000.01


def test_an_unplugged_port_is_noticed_at_once_and_the_position_is_unknown(kind: str) -> None:
    made = running(kind, SPEED_SPS)
    made.port.faults.disconnect_at_ns = made.clock.now_ns()
    with pytest.raises(LensError, match="gone"):
        made.live(5)
    with pytest.raises(LensError, match="gone"):
        made.lens.move_to(Steps(100), SPEED_SPS)
    made.lens.close()


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_what_was_unplugged_and_plugged_in_again_can_be_opened_and_used(kind: str) -> None:
    made = running(kind, SPEED_SPS)
    made.port.faults.disconnect_at_ns = made.clock.now_ns()
    with pytest.raises(LensError, match="gone"):
        made.live(5)
    made.lens.close()
    made.plug_in()
    made.open()
    made.live(200)
    assert not made.moving, "what was moving is stopped by whoever connects"
    rest = made.rotor
    made.live(100)
    assert made.rotor == rest, "nothing moves by itself"
    made.lens.home(made.soon(10_000))
    made.lens.move_to(Steps(1000), SPEED_SPS)
    made.live(500)
    assert made.rotor == pytest.approx(1000, abs=2.1)


@needs("remembers", "the controller reports no positions")
def test_an_adapter_that_keeps_replies_back_makes_positions_vaguer_not_wrong(kind: str) -> None:
    made = rig(kind)
    made.port.faults.latency_timer_ns = 16_000_000
    made.open(connect_ms=5000.0) if kind == "grbl" else made.open()
    made.live(300)
    made.lens.move_to(Steps(4567), SPEED_SPS)
    off_sigmas = []
    for _ in range(400):
        made.live(1)
        here = made.lens.position_at(made.clock.now_ns())
        off_sigmas.append(abs(here.steps - made.rotor) / here.sigma_steps)
    assert max(off_sigmas) < 3.0  # one motion is one draw: its errors all have one cause
    assert made.rotor == pytest.approx(4567, abs=0.01)
    assert not made.reports[-1].moving
    assert "set the adapter's latency timer" in made.lens.remarks[0]
    made.port.faults.latency_timer_ns = 0
    made.live(1000)
    assert made.lens.remarks == ()


def put_aside_beside_the_port(made: Rig, side: str, seed: int) -> None:
    """Let 20 to 400 ms pass, one time in ten, "before" or "after" each "read" or "write"."""
    draw, awake_until = Random(seed), made.soon(0)
    when, what = side.split()
    port_does = made.port.read_available if what == "read" else made.port.write

    def put_aside() -> None:
        nonlocal awake_until
        if draw.random() < 0.1 and made.clock.now_ns() >= awake_until:
            made.clock.pass_ms(draw.uniform(20, 400))
            awake_until = made.soon(20)

    def beside(*data: bytes) -> bytes | None:
        if when == "before":
            put_aside()
        done = port_does(*data)
        if when == "after":
            put_aside()
        return done

    setattr(made.port, "read_available" if what == "read" else "write", beside)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
@pytest.mark.parametrize("side", ["before read", "after read", "before write", "after write"])
@pytest.mark.parametrize("seed", [1, 2, 15])
def test_a_thread_that_is_put_aside_beside_the_port_loses_no_position(kind: str, side: str, seed: int) -> None:
    """On a busy machine the scheduler takes hundreds of milliseconds between two lines of any program."""
    made = open_rig(kind)
    made.live(20)
    put_aside_beside_the_port(made, side, seed)
    for velocity in (SPEED_SPS / 8, -SPEED_SPS / 8, SPEED_SPS / 8):
        made.lens.run(velocity, made.soon(1500))
        made.live(600)
    made.lens.stop(StopMode.RAMPED)
    made.live(1000)
    assert not made.moving
    estimate = made.lens.position_at(made.clock.now_ns())
    assert estimate.sigma_steps < 1.5
    assert estimate.steps == pytest.approx(made.rotor, abs=4 * estimate.sigma_steps)


@pytest.mark.parametrize("side", ["before read", "after read", "before write", "after write"])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_thread_that_is_put_aside_beside_the_port_homes_all_the_same(kind: str, side: str, seed: int) -> None:
    made = open_rig(kind)
    put_aside_beside_the_port(made, side, seed)
    report = made.lens.home(made.soon(60_000))
    assert LensFlag.REFERENCED in report.flags
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=3.2)


def test_wrong_checksums_are_never_believed(kind: str) -> None:
    spoil = DIALECTS[kind].spoil
    if spoil is None:
        pytest.skip("the protocol has no checksums")
    made = rig(kind, **DIALECTS[kind].config)
    made.open(**DIALECTS[kind].settings)
    made.live(20)
    wrong = iter(range(3))
    made.port.faults.garble = lambda data: data if next(wrong, None) is None else spoil(data)
    made.live(150)
    assert {report.steps for report in made.reports} == {3200.0}
    made.port.faults.garble = spoil
    with pytest.raises(LensError, match="limit"):
        made.live(200)


def test_a_few_damaged_replies_do_no_harm(kind: str) -> None:
    made = running(kind, SPEED_SPS / 4, 0)
    damaged = iter([True, True])
    made.port.faults.garble = lambda data: bytes(255 - b for b in data) if next(damaged, False) else data
    made.live(300)
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(made.rotor, abs=8)


@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_nothing_but_garbage_stops_the_motor(kind: str) -> None:
    made = running(kind, SPEED_SPS)
    made.port.faults.garble = lambda data: b"\xa5" * (len(data) + 1)
    with pytest.raises(LensError):
        made.live(300)
    made.clock.pass_ms(made.dialect.hardest_stop_ms)
    assert not made.moving


@needs("remembers", "the controller does not remember where it is")
def test_what_an_earlier_session_had_asked_for_does_not_confuse_the_next(kind: str) -> None:
    made = rig(kind)
    made.port.write(made.dialect.question)
    made.open()
    made.live(20)
    assert made.lens.position_at(made.clock.now_ns()).steps == pytest.approx(3200, abs=1.7)


@settings(max_examples=25, deadline=None)
@given(data=st.binary(max_size=60))
@needs("stops", "the controller cannot be stopped, nor told anything else, while it moves")
def test_any_bytes_from_the_line_end_in_a_lens_error_or_nothing(kind: str, data: bytes) -> None:
    made = running(kind, SPEED_SPS / 8, 20)
    first = iter([True])
    made.port.faults.garble = lambda d: data + d if next(first, False) else d
    try:
        made.live(60)
    except LensError:
        made.clock.pass_ms(made.dialect.hardest_stop_ms)
        assert not made.moving


@needs("remembers", "the controller reports no positions")
@pytest.mark.parametrize("late_ms", [3, 11, 14, 18, 22, 28])
def test_an_answer_that_comes_after_the_question_was_asked_again_is_as_old_as_it_is(kind: str, late_ms: int) -> None:
    made = running(kind, SPEED_SPS / 4, 100)
    made.reports.clear()
    says, late = made.board.take_output, [late_ms * 1_000_000]

    def held_up() -> list[tuple[int, bytes]]:
        return [(ready_ns + (late.pop() if late else 0), data) for ready_ns, data in says()]

    made.board.take_output = held_up
    made.live(200)
    assert len(made.reports) > 10
    for report in made.reports:
        low, high = made.truth([int(report.earliest_ns), int(report.latest_ns)])
        assert low - 4 <= report.steps <= high + 4
