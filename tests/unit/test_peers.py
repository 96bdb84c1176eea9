"""Other people's readers on the files that we write: each format that one of them knows, event by event.

Which pairs there are, and why not the others, stands in ``tools/docs/formats.md``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scripted_rig
from event_files import edge, many, packet, write_all

from elpd.events.evt3_encode import Evt3Encoder
from elpd.record.files import writable_formats
from elpd.record.tape import TapeWriter, tape_rig
from elpd.records import CameraPacket, Encoding, Geometry
from elpd.units import HostNs

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    Columns = Sequence[Any]

SIZE = Geometry(1280, 720)
COLUMNS = many(20_000, geometry=SIZE, step_us=3)
EVT3_TURN_US = 1 << 12


def by_evt3(module: Any, path: Path, _: str) -> Columns:
    found = module.decode_file(str(path))
    return [getattr(found, name) for name in "txyp"]


def by_faery(module: Any, path: Path, _: str) -> Columns:
    found = np.concatenate(list(module.events_stream_from_file(path, dimensions_fallback=(SIZE.width, SIZE.height))))
    return [found[name] for name in ("t", "x", "y", "on")]


def by_expelliarmus(module: Any, path: Path, word: str) -> Columns:
    found = module.Wizard(encoding=word).read(path)
    return [found[name] for name in "txyp"]


def by_evutils(_: Any, path: Path, __: str) -> Columns:
    with import_module("evutils.io").EventReader(str(path)) as reader:
        found = reader.read_all()
    return [found[name] for name in "txyp"]


def by_aedat(module: Any, path: Path, _: str) -> Columns:
    found = np.concatenate([one["events"] for one in module.Decoder(path) if "events" in one])
    return [found[name] for name in ("t", "x", "y", "on")]


def by_dv_processing(module: Any, path: Path, _: str) -> Columns:
    recording = module.io.MonoCameraRecording(str(path))
    batches = []
    while (batch := recording.getNextEventBatch()) is not None:
        batches.append(batch.numpy().copy())
    found = np.concatenate(batches)
    return [found[name] for name in ("timestamp", "x", "y", "polarity")]


READERS: dict[str, Callable[[Any, Path, str], Columns]] = {
    "evt3": by_evt3,
    "faery": by_faery,
    "expelliarmus": by_expelliarmus,
    "evutils": by_evutils,
    "aedat": by_aedat,
    "dv_processing": by_dv_processing,
}
PAIRS = {
    "evt3": ("evt3", "faery", "evutils"),
    "evt2": ("faery", "expelliarmus", "evutils"),
    "evt2.1-legacy": ("evutils",),
    "dat": ("faery", "expelliarmus", "evutils"),
    "aedat4": ("aedat", "dv_processing", "faery", "evutils"),
    "csv": ("faery", "evutils"),
    "npz": ("evutils",),
}


def written(folder: Path, word: str) -> Path:
    writes, suffix = writable_formats()[word]
    path = folder / f"r{suffix}"
    write_all(writes.create(path, word, SIZE, {}), [column.tolist() for column in COLUMNS], [7000])
    return path


@pytest.mark.parametrize(("word", "peer"), [(word, peer) for word, peers in PAIRS.items() for peer in peers])
def test_a_peer_reads_every_event(tmp_path: Path, word: str, peer: str) -> None:
    module = pytest.importorskip(peer)
    theirs = READERS[peer](module, written(tmp_path, word), word)
    for ours, other, name in zip(COLUMNS, theirs, "txyp", strict=True):
        known = np.ones(ours.size, np.bool_)
        if (word, peer, name) == ("evt3", "evutils", "t"):
            # It goes on with the time before where a new TIME_HIGH is not followed by a TIME_LOW, which then is zero.
            known = COLUMNS[0] % EVT3_TURN_US != 0
        assert (ours == np.asarray(other))[known].all(), name


def test_evt3_finds_every_edge(tmp_path: Path) -> None:
    evt3 = pytest.importorskip("evt3")
    edges = [edge(5010, 6), edge(5020, 6, rising=False), edge(50_000, 1)]
    writes, _ = writable_formats()["evt3"]
    writer = writes.create(tmp_path / "r.raw", "evt3", SIZE, {})
    writer.write(packet(COLUMNS, triggers=edges))
    writer.close()
    events, triggers = evt3.decode_file_with_triggers(str(tmp_path / "r.raw"))
    assert (np.asarray(events.t) == COLUMNS[0]).all()
    theirs = zip(*(np.asarray(getattr(triggers, name)).tolist() for name in ("timestamp", "id", "value")), strict=True)
    assert list(theirs) == [(one.t_us, one.id, int(one.rising)) for one in edges]


@pytest.mark.parametrize("peer", ["evt3", "faery", "evutils"])
def test_the_words_of_a_recorded_run_are_a_file_that_peers_read(tmp_path: Path, peer: str) -> None:
    module = pytest.importorskip(peer)
    encoder, pieces = Evt3Encoder(SIZE.width), np.array_split(np.arange(COLUMNS[0].size), 5)
    packets = [
        CameraPacket(encoder.encode(*(column[piece] for column in COLUMNS)).copy(), Encoding.EVT3, HostNs(0))
        for piece in pieces
    ]
    tape = TapeWriter(tmp_path)
    parts = scripted_rig.scripted_rig(packets, camera=Large)
    taped = tape_rig(parts, tape)
    for _ in packets:
        taped.camera.read(0.1)
    tape.close()
    t, x, y, p = READERS[peer](module, tmp_path / "events.raw", "evt3")
    for ours, other in zip(COLUMNS[1:], (x, y, p), strict=True):
        assert (ours == np.asarray(other)).all()
    assert len(t) == len(x)


class Large(scripted_rig.AbleCamera):
    geometry = SIZE
