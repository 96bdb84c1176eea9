"""Our own firmware on a simulated ATmega328P: what its pins do, and what no bytes can make them do."""

from __future__ import annotations

import random

import pytest
from elpd_drivers.lenses import avr_wire as wire
from elpd_drivers.sim.boards import avr
from elpd_drivers.sim.lens import LensMechanics, SimulatedLens
from hypothesis import given, settings
from hypothesis import strategies as st

MS = 1_000_000
pytestmark = pytest.mark.skipif(avr.hindrance() is not None, reason=str(avr.hindrance()))


class Bench:
    """A board in the middle of its travel, and one question after the other."""

    def __init__(self, *, dead_man_ms: int = 500, sync_steps: int = 0) -> None:
        lens = SimulatedLens(LensMechanics(um_per_step=1.0, travel_um=4000.0, backlash_um=0.0), start_um=2000.0)
        self.board = avr.AvrBoard(lens, avr.AvrConfig(referenced=True))
        self.now = 0
        self.frames = wire.Frames()
        assert self.ask(wire.CONFIGURE, wire.configure(640_000, 16_000, 0, 4000, dead_man_ms, sync_steps)).status == 0

    def send(self, data: bytes) -> None:
        for byte in data:
            self.now += self.board.byte_ns
            self.board.receive(bytes((byte,)), self.now)

    def live(self, ms: float) -> None:
        self.now += round(ms * MS)
        self.board.advance_to(self.now)

    def ask(self, command: int, payload: bytes = b"", sequence: int = 77) -> wire.Reply:
        self.frames.feed(b"".join(part for _, part in self.board.take_output()))
        self.send(wire.encode(sequence, command, payload))
        self.live(3)
        replies = self.frames.feed(b"".join(part for _, part in self.board.take_output()))
        return next(reply for reply in replies if reply.sequence == sequence and reply.command == command)


def _intact_command(data: bytes) -> bool:
    """Say whether any frame in *data* would pass its check."""
    for part in data.split(b"\xfe")[1:]:
        body = bytearray()
        flip = False
        for byte in part.split(b"\xff")[0]:
            if byte == 0xFD:
                flip = True
                continue
            body.append(byte ^ 0x20 if flip else byte)
            flip = False
        if len(body) >= 4 and wire.crc16(bytes(body[:-2])) == int.from_bytes(body[-2:], "little"):
            return True
    return False


@settings(max_examples=25, deadline=None)
@given(data=st.binary(max_size=120))
def test_no_bytes_but_a_valid_frame_make_a_step_and_it_answers_afterwards(data: bytes) -> None:
    bench = Bench()
    bench.send(data)
    bench.live(5)
    if not _intact_command(data):
        assert bench.board.steps_made == 0
    assert bench.ask(wire.STATUS).status == wire.OK


@settings(max_examples=25, deadline=None)
@given(where=st.integers(0, 100), bit=st.integers(0, 7))
def test_one_wrong_bit_in_a_command_moves_nothing(where: int, bit: int) -> None:
    frame = bytearray(wire.encode(5, wire.GO, wire.go(2100, 8000)))
    frame[where % len(frame)] ^= 1 << bit
    bench = Bench()
    bench.send(bytes(frame))
    bench.live(5)
    assert bench.board.steps_made == 0
    assert bench.ask(wire.STATUS).position == 2000


def test_the_dead_man_brakes_when_nobody_speaks_and_says_so() -> None:
    bench = Bench(dead_man_ms=50)
    asked = bench.now
    bench.ask(wire.GO, wire.go(4000, 4000))
    bench.live(200)
    assert 50 * MS < bench.board.last_step_ns - asked < 75 * MS
    reply = bench.ask(wire.STATUS)
    assert reply.flags & wire.DEAD_MAN
    assert not reply.flags & wire.MOVING
    assert reply.position == bench.board.pin_position < 4000


def test_stamps_tell_the_times_of_steps_through_many_turns_of_its_timer() -> None:
    chance = random.Random(23)
    bench = Bench()
    offsets_us = []
    for _ in range(40):
        bench.ask(wire.GO, wire.go(chance.randrange(4001), chance.randrange(4000, 16_001)))
        bench.live(chance.uniform(20.0, 200.0))
        bench.send(wire.HALT)
        bench.live(2)
        reply = bench.ask(wire.STATUS)
        assert reply.position == bench.board.pin_position
        offsets_us.append(bench.board.last_step_ns / 1000 - reply.step_stamp / 2)
    assert bench.now > 100 * 32 * MS
    assert max(offsets_us) - min(offsets_us) < 10.0


def test_sync_makes_an_edge_every_so_many_steps() -> None:
    bench = Bench(sync_steps=50)
    before = bench.board.sync_edges
    bench.ask(wire.GO, wire.go(2530, 8000))
    bench.live(150)
    assert bench.board.pin_position == 2530
    assert bench.board.sync_edges - before == 10


def test_sync_marks_the_same_places_from_either_side() -> None:
    bench = Bench(sync_steps=50)
    bench.ask(wire.GO, wire.go(2130, 8000))
    bench.live(150)
    bench.board.take_sync_edges()
    marks = []
    for target in (2310, 1985, 2025):
        bench.ask(wire.GO, wire.go(target, 4000))
        for _ in range(1500):
            before = bench.board.pin_position
            bench.live(0.1)
            marks += [(before, bench.board.pin_position)] * len(bench.board.take_sync_edges())
    places = [next(at for at in range(min(way) - 1, max(way) + 2) if at % 50 == 0) for way in marks]
    assert places == [2150, 2200, 2250, 2300, 2300, 2250, 2200, 2150, 2100, 2050, 2000, 2000]


def test_the_iris_pin_follows_its_command() -> None:
    bench = Bench()
    for wanted in (True, False):
        assert bench.ask(wire.IRIS, bytes((wanted,))).status == wire.OK
        assert bench.board.iris_open == wanted
        assert bool(bench.ask(wire.STATUS).flags & wire.IRIS_OPEN) == wanted
    assert bench.ask(wire.IRIS, b"\2").status == wire.RANGE
