"""Writing AEDAT4 files: events, frames, edges and IMU samples, uncompressed, with the table of contents at the end.

Without compression nothing but numpy is needed to write, and every reader of AEDAT4 can read. A file whose writer was
stopped has no table; DV and ours read it packet by packet all the same.
"""

from __future__ import annotations

import struct
from array import array
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np

from elpd.errors import FormatError
from elpd.ports import WriterTraits
from elpd_drivers.formats import flat
from elpd_drivers.formats.aedat4_header import MAGIC
from elpd_drivers.formats.output import Output, columns_inside
from elpd_drivers.inertia import acceleration_g, rotation_deg_s

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import CameraPacket, Frame, Geometry, ImuSample, Trigger

EVENTS, FRAMES, EDGES, IMU = 0, 1, 2, 3
KINDS = {EVENTS: ("EVTS", "events"), FRAMES: ("FRME", "frames"), EDGES: ("TRIG", "triggers"), IMU: ("IMUS", "imu")}
WITHOUT_SIZE = {EDGES, IMU}
EVENT = np.dtype({"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "u1"], "offsets": [0, 8, 10, 12],
                  "itemsize": 16})  # fmt: skip
TYPES = {(0, True): 1, (0, False): 2, (1, True): 4, (1, False): 5,
         (2, True): 6, (2, False): 7, (3, True): 8, (3, False): 9}  # fmt: skip
EVENTS_PER_PACKET = 1 << 15
HELD_US = 50_000
"""How much sensor time of few events is gathered in one packet: a live camera's packets are too small for a table."""
MAX_SIDE = 1 << 15
NOT_FINISHED = -1


class Aedat4Writer:
    """An AEDAT4 file being written."""

    def __init__(self, path: Path, geometry: Geometry, facts: Mapping[str, str]) -> None:
        if not (0 < geometry.width < MAX_SIDE and 0 < geometry.height < MAX_SIDE):
            raise FormatError(f"{path}: a sensor of {geometry.width}x{geometry.height} does not fit 15-bit addresses")
        self._geometry = geometry
        self._contents = _Contents()
        self._held: list[NDArray[Any]] = []
        self._held_events = 0
        self._other_channels = self._deep_frames = self._other_frames = 0
        self._source = next((facts[key] for key in ("source", "serial_number") if facts.get(key)), "elpd")
        self._output = Output(path)
        self._output.append(MAGIC, self._header(NOT_FINISHED))

    @property
    def traits(self) -> WriterTraits:
        """Events, trigger edges, frames and IMU samples, of any time."""
        return WriterTraits(triggers=True, frames=True, imu=True)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was written in another way than it came."""
        found = (
            (self._other_channels, "trigger edges of channels that AEDAT4 does not have were written as channel 0"),
            (self._deep_frames, "frames of 16 bits were written with their upper 8"),
            (self._other_frames, "frames of another size than the sensor's were left out"),
        )
        return tuple(f"{count} {text}" for count, text in found if count)

    def write(self, packet: CameraPacket) -> None:
        """Append events, edges, frames and IMU samples. See ``RecordingWriter.write``."""
        t, x, y, p = columns_inside(packet, self._geometry)
        if t.size:
            events = np.zeros(t.size, EVENT)
            events["t"], events["x"], events["y"], events["on"] = t, x, y, p
            self._held.append(events)
            self._held_events += t.size
            span_us = abs(int(t[-1]) - int(self._held[0]["t"][0]))
            if self._held_events >= EVENTS_PER_PACKET or span_us >= HELD_US:
                self._write_events()
        if packet.triggers or packet.frames or packet.imu:
            self._write_events()
        if packet.triggers:
            self._write_edges(packet.triggers)
        for frame in packet.frames:
            self._write_frame(frame)
        if packet.imu:
            self._write_imu(packet.imu)

    def close(self, *, complete: bool = True) -> None:
        """Finish: append the table of contents, unless the file was cut short. Idempotent."""
        if self._output.closed:
            return
        try:
            self._write_events()
            self._finish(complete=complete)
        finally:
            self._output.close()

    def _finish(self, *, complete: bool) -> None:
        if complete:
            at = self._output.size
            self._output.append(flat.build(b"FTAB", {0: self._contents}))
            self._output.patch(len(MAGIC), self._header(at))

    def _header(self, table_at: int) -> bytes:
        text = _description(self._geometry, self._source).encode()
        return flat.build(b"IOHE", {1: ("q", table_at), 2: flat.Vector(text + b"\0", len(text))})

    def _append(self, stream: int, fields: flat.Fields, count: int, first_us: int, last_us: int) -> None:
        """Append one packet and note it for the table."""
        data = flat.build(KINDS[stream][0].encode(), fields)
        self._output.append(struct.pack("<ii", stream, len(data)), data)
        self._contents.add(self._output.size - len(data), stream, len(data), count, first_us, last_us)

    def _write_events(self) -> None:
        """Write what is held."""
        if not self._held:
            return
        # As plain bytes: joining structured arrays would drop their padding.
        held = np.concatenate([events.view(f"V{EVENT.itemsize}") for events in self._held]).view(EVENT)
        self._held, self._held_events = [], 0
        for begin in range(0, held.size, EVENTS_PER_PACKET):
            events = held[begin : begin + EVENTS_PER_PACKET]
            vector = flat.Vector(events.tobytes(), events.size)
            self._append(EVENTS, {0: vector}, events.size, int(events["t"][0]), int(events["t"][-1]))

    def _write_edges(self, edges: tuple[Trigger, ...]) -> None:
        rows: list[flat.Fields] = []
        for edge in edges:
            self._other_channels += (edge.id, True) not in TYPES
            kind = TYPES.get((edge.id, edge.rising), TYPES[0, edge.rising])
            rows.append({0: ("q", edge.t_us), 1: ("b", kind)})
        self._append(EDGES, {0: rows}, len(edges), edges[0].t_us, edges[-1].t_us)

    def _write_imu(self, samples: tuple[ImuSample, ...]) -> None:
        rows: list[flat.Fields] = []
        for one in samples:
            measured = (one.temperature_c, *acceleration_g(one.acceleration_m_s2), *rotation_deg_s(one.rotation_rad_s))
            rows.append({0: ("q", one.t_us), **{k: ("f", value) for k, value in enumerate(measured, start=1)}})
        self._append(IMU, {0: rows}, len(samples), samples[0].t_us, samples[-1].t_us)

    def _write_frame(self, frame: Frame) -> None:
        if frame.pixels.shape != (self._geometry.height, self._geometry.width):
            self._other_frames += 1
            return
        pixels = frame.pixels
        if pixels.dtype.itemsize > 1:
            self._deep_frames += 1
            pixels = (pixels >> 8).astype(np.uint8)
        begin = frame.t_us - frame.exposure_us // 2
        fields: flat.Fields = {
            0: ("q", begin),
            1: ("q", begin),
            2: ("q", frame.available_us),
            3: ("q", begin),
            4: ("q", begin + frame.exposure_us),
            5: ("b", 0),
            6: ("h", self._geometry.width),
            7: ("h", self._geometry.height),
            10: flat.Vector(np.ascontiguousarray(pixels).tobytes(), pixels.size),
            11: ("q", frame.exposure_us),
        }
        self._append(FRAMES, fields, 1, begin, begin)


class _Contents:
    """The table of contents, packed: long recordings have many packets."""

    def __init__(self) -> None:
        self._rows = array("q")

    def add(self, at: int, stream: int, size: int, count: int, first_us: int, last_us: int) -> None:
        """Note a packet whose *size* bytes begin at byte *at*."""
        self._rows.extend((at, stream | size << 32, count, first_us, last_us))  # stream and size are a struct of i32

    def __len__(self) -> int:
        return len(self._rows) // 5

    def __iter__(self) -> Iterator[flat.Fields]:
        for begin in range(0, len(self._rows), 5):
            yield {k: ("q", value) for k, value in enumerate(self._rows[begin : begin + 5])}


def _description(geometry: Geometry, source: str) -> str:
    """Return the streams' description in DV's XML."""
    nodes = []
    for number, (kind, name) in KINDS.items():
        size = {"sizeX": geometry.width, "sizeY": geometry.height} if number not in WITHOUT_SIZE else {}
        info = "".join(f'<attr key="{key}" type="int">{value}</attr>' for key, value in size.items())
        attributes = {
            "compression": "NONE",
            "originalModuleName": "elpd",
            "originalOutputName": name,
            "typeDescription": name,
            "typeIdentifier": kind,
        }
        own = "".join(f'<attr key="{key}" type="string">{value}</attr>' for key, value in attributes.items())
        nodes.append(
            f'<node name="{number}" path="/outInfo/{number}/">{own}<node name="info" path="/outInfo/{number}/info/">'
            f'{info}<attr key="source" type="string">{escape(" ".join(source.split()))}</attr></node></node>'
        )
    return f'<dv version="2.0"><node name="outInfo" path="/outInfo/">{"".join(nodes)}</node></dv>'
