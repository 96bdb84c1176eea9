from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scripted_rig import AbleCamera, scripted_rig

from elpd.config import Config
from elpd.errors import FormatError
from elpd.record.journal import RunWriter
from elpd.record.run_sweep import read_run_sweep
from elpd.records import CameraPacket, Encoding, Frame, Roi

if TYPE_CHECKING:
    from pathlib import Path

EVENTS = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])


def packet(first_us: int, **fields: Any) -> CameraPacket:
    """Return ten events, 100 us apart."""
    data = np.zeros(10, EVENTS)
    data["t"] = first_us + 100 * np.arange(10)
    data["x"] = np.arange(10)
    data["on"] = np.arange(10) % 2 == 0
    return CameraPacket(data, Encoding.ARRAY, received_ns=0, **fields)


def run_of(directory: Path, windows: int = 3, **notes: dict[str, Any]) -> Path:
    """Record an opening at 0 ms, a pause at 30 ms, a sweep from 50 ms in windows of 1 ms, and a way back after it."""
    picture = Frame(49_000, 49_500, 200, np.full((48, 64), 7, np.uint8))
    late = Frame(90_000, 90_500, 200, np.full((48, 64), 9, np.uint8))
    packets = [packet(0), packet(30_000, frames=(picture,)), *(packet(50_000 + 1000 * n) for n in range(3))]
    packets.append(packet(90_000, frames=(late,)))
    config = Config.model_validate({"journal": {"directory": directory}})
    with RunWriter.begin(config, {}, scripted_rig(packets, camera=AbleCamera)) as run:
        for _ in packets:
            run.parts.camera.read(0.002)
        for event, fields in notes.items():
            run.note(event, **fields)
        for number in range(windows):
            begin_us = 50_000 + 1000 * number
            run.note("window", begin_us=begin_us, end_us=begin_us + 1000, position_um=4.0 * number)
        run.finish({})
    assert run.path is not None
    return run.path


def test_only_the_opening_and_the_sweep_are_taken(tmp_path: Path) -> None:
    found = read_run_sweep(run_of(tmp_path, map={"open_us": 500}, roi={"roi": [8, 4, 32, 16]}))
    assert found.aperture_us == (500, 20_500)
    assert found.begin_us == 50_000
    assert found.sweep.roi == Roi(8, 4, 32, 16)
    assert found.sweep.t_us.tolist() == [*range(500, 1000, 100), *range(50_000, 53_000, 100)]
    assert found.sweep.on.tolist() == [0, 1, 0, 1, 0, *([1, 0] * 15)]
    assert found.path_t_us.tolist() == [50_500.0, 51_500.0, 52_500.0]
    assert found.path_um.tolist() == [0.0, 4.0, 8.0]


def test_frames_of_the_sweep_come_with_it(tmp_path: Path) -> None:
    (frame,) = read_run_sweep(run_of(tmp_path)).sweep.frames
    assert frame.t_us == 49_000
    assert (frame.load() == 7).all()


def test_without_an_aperture_or_a_region_the_whole_sensor_is_swept(tmp_path: Path) -> None:
    found = read_run_sweep(run_of(tmp_path))
    assert found.aperture_us is None
    assert found.sweep.roi == Roi(0, 0, 64, 48)
    assert found.sweep.t_us[0] == 50_000


def test_a_run_that_never_swept_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"never swept \(1 windows noted\)"):
        read_run_sweep(run_of(tmp_path, windows=1))
