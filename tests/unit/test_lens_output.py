"""An iris on an output of the lens's own controller: every driver against its board."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from lens_rigs import Rig, open_rig

from elpd.config import load
from elpd.errors import ConfigError, LensError, UsageError
from elpd.motion.lens_output import aperture_on_lens
from elpd.ports import Outputs
from elpd.records import StopMode
from elpd.rig import build

SWITCHED = {"avr": "iris", "grbl": "coolant", "tmcl": "out1", "zaber": "do2"}


def iris_of(rig: Rig, **more: Any) -> Any:
    return aperture_on_lens({"output": SWITCHED[rig.kind], "opening_ms": 20, **more}, rig.lens)


@pytest.mark.parametrize("kind", SWITCHED)
def test_it_opens_and_closes_and_the_lens_goes_on(kind: str) -> None:
    rig = open_rig(kind)
    iris, name = iris_of(rig), SWITCHED[kind]
    before = rig.clock.now_ns()
    stamp = iris.open()
    assert before <= stamp.begun_ns <= stamp.done_ns
    rig.live(60)
    assert rig.board.outputs[name]
    rig.lens.move_to(3600, 6000.0)
    rig.live_until(lambda: not rig.lens._motor.under_way)
    assert rig.rotor == pytest.approx(3600, abs=1)
    iris.close()
    rig.live(60)
    assert not rig.board.outputs[name]
    iris_of(rig, inverted=True).open()
    rig.live(60)
    assert not rig.board.outputs[name]


@pytest.mark.parametrize("kind", ["avr", "tmcl", "zaber"])
def test_it_switches_while_the_lens_moves(kind: str) -> None:
    rig = open_rig(kind)
    rig.lens.run(6000.0, rig.soon(2000))
    rig.live(40)
    iris_of(rig).open()
    rig.live(40)
    assert rig.moving
    assert rig.board.outputs[SWITCHED[kind]]
    rig.lens.stop(StopMode.RAMPED)
    rig.live(100)
    assert not rig.moving


def test_grbl_switches_at_rest_only() -> None:
    rig = open_rig("grbl")
    rig.lens.run(6000.0, rig.soon(2000))
    with pytest.raises(LensError, match="at rest only"):
        iris_of(rig).open()


def test_a_lost_command_is_said_again() -> None:
    rig = open_rig("avr")
    write, lost = rig.port.write, []

    def lossy(data: bytes) -> None:
        if len(data) > 2 and data[2] == 7 and not lost:
            lost.append(data)
            return
        write(data)

    rig.port.write = lossy  # type: ignore[method-assign]
    iris_of(rig).open()
    rig.live(60)
    assert len(lost) == 1
    assert rig.board.iris_open


def test_an_iris_that_never_obeys_is_a_fault() -> None:
    rig = open_rig("avr")
    write = rig.port.write
    rig.port.write = lambda data: None if data[2:3] == b"\7" else write(data)  # type: ignore[method-assign,assignment]
    iris_of(rig).open()
    with pytest.raises(LensError, match="does not obey"):
        rig.live(100)


def test_boards_refuse_outputs_that_they_do_not_have() -> None:
    rig = open_rig("grbl")
    rig.lens.set_output("iris", on=True)  # Kurokesu's; this is a plain GRBL
    with pytest.raises(LensError, match="error:20"):
        rig.live(30)
    with pytest.raises(UsageError, match=r"no output is called 'do9'.*do1, do2"):
        open_rig("zaber").lens.set_output("do9", on=True)


def test_wrong_tables_are_refused() -> None:
    rig = open_rig("zaber")
    for table, words in (
        ({"output": "do7", "opening_ms": 20}, "controller has do1, do2, do3, do4"),
        ({"output": "do1"}, r"opening_ms is None.*solenoid"),
        ({"output": "do1", "opening_ms": -3}, "opening_ms is -3"),
        ({"output": "do1", "opening_ms": 20, "inverted": "yes"}, "true or false"),
        ({"outputs": "do1"}, "unknown key"),
    ):
        with pytest.raises(ConfigError, match=words):
            aperture_on_lens(table, rig.lens)
    tic = open_rig("tic").lens
    with pytest.raises(ConfigError, match="a Tic drives its motor"):
        aperture_on_lens({"output": "do1", "opening_ms": 20}, tic)
    with pytest.raises(UsageError, match="no outputs"):
        tic.set_output("do1", on=True)


def test_what_it_passes_is_an_iris_until_it_is_calibrated() -> None:
    iris = iris_of(open_rig("zaber"))
    assert iris.transmittance(np.array([-5.0, 10_000.0, 1e6])).tolist() == [0.0, 0.25, 1.0]
    assert isinstance(iris.lens, Outputs)


def test_the_rig_hands_the_lens_over() -> None:
    table = ["sim.board=zaber", "sim.width=32", "sim.height=32", "aperture.driver=lens-output", "aperture.output=do1"]
    parts = build(load(overrides=[*table, "aperture.opening_ms=25", "state.profiles=false"]))
    assert parts.aperture is not None
    assert parts.aperture.opening_ms == 25
    assert parts.aperture.open().command == "do1 on"
    with pytest.raises(ConfigError, match="a Tic drives"):
        build(load(overrides=["sim.board=tic", "aperture.driver=lens-output", "aperture.output=do1"]))
