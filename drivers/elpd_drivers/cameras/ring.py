"""A ring of packets in memory that two processes share: one writes, one reads, neither waits for the other.

The memory is a ``memfd``: it has no name, so nothing is left behind however either process ends. An event file
descriptor counts the packets that can be taken; taking one is a system call, which is also the memory barrier between
the two sides. The reader sees the packet where it lies and gives its place back when it takes the next.

Nothing here blocks the writer. A packet that does not fit is dropped whole, counted, and the next one that fits says
``gap_before`` and how many events went missing.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.records import Frame, ImuSample, Trigger
from elpd.units import SensorUs

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

ALIGNMENT = 64
_SLOT = struct.Struct("<14q")
_FRAME = struct.Struct("<6q")
_TRIGGER = struct.Struct("<3q")
_SAMPLE = struct.Struct("<q7d")
_SLOT_BYTES = 128
_WRITTEN, _READ, _RELEASED, _HEARTBEAT, _NOTES_VERSION, _NOTES_LENGTH = (ALIGNMENT * place for place in range(6))
"""Offsets of the single numbers in the first page, each in a cache line of its own."""

_NOTES, _NOTES_BYTES = 512, 4096 - 512
_SLOTS = 4096
_UNKNOWN = -(1 << 63)


@dataclass(frozen=True, slots=True)
class Captured:
    """What a camera library delivered, on its way into the ring.

    ``data`` is copied into the ring. ``events`` is how many events it holds, as far as that is known without decoding;
    were the packet dropped, so many would count as lost. The other fields are those of ``CameraPacket``.
    """

    data: NDArray[Any] | bytes
    received_ns: int
    complete_until_us: int | None = None
    events: int = 0
    frames: tuple[Frame, ...] = ()
    triggers: tuple[Trigger, ...] = ()
    gap_before: bool = False
    lost_events: int = 0
    backlog: int = 0
    imu: tuple[ImuSample, ...] = ()


@dataclass(frozen=True, slots=True)
class Taken:
    """A packet out of the ring: ``data`` is a view, valid until the next ``take``; frames are copies."""

    data: memoryview
    generation: int
    received_ns: int
    complete_until_us: int | None
    events: int
    frames: tuple[Frame, ...]
    triggers: tuple[Trigger, ...]
    gap_before: bool
    lost_events: int
    backlog: int
    imu: tuple[ImuSample, ...]


class RingMemory:
    """The shared memory and its layout; made by the reader, opened by the writer through the inherited descriptor.

    Parameters
    ----------
    descriptor
        Of the memory, which has the size that ``size_of`` says.
    slots
        How many packets fit at most.
    capacity
        How many bytes of packets fit at most, a multiple of 64.
    """

    def __init__(self, descriptor: int, slots: int, capacity: int) -> None:
        self.slots, self.capacity = slots, capacity
        self.map = mmap.mmap(descriptor, self.size_of(slots, capacity))
        self.view = memoryview(self.map)
        self.data_begin = _SLOTS + slots * _SLOT_BYTES
        self._numbers = np.frombuffer(self.map, np.int64, _NOTES // 8)

    @staticmethod
    def size_of(slots: int, capacity: int) -> int:
        """Return how many bytes of memory a ring takes."""
        return _SLOTS + slots * _SLOT_BYTES + capacity

    @classmethod
    def make(cls, slots: int, capacity: int) -> tuple[RingMemory, int]:
        """Make a ring and return it with its descriptor, which the caller hands to the writer and closes."""
        capacity = -(-capacity // ALIGNMENT) * ALIGNMENT
        descriptor = os.memfd_create("elpd-capture", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, cls.size_of(slots, capacity))
        return cls(descriptor, slots, capacity), descriptor

    def number(self, offset: int) -> int:
        """Return one of the single numbers (an aligned 8-byte load, whole on every machine this runs on)."""
        return int(self._numbers[offset >> 3])

    def set_number(self, offset: int, value: int) -> None:
        """Set one of the single numbers."""
        self._numbers[offset >> 3] = value

    def slot(self, packet: int) -> int:
        """Return where the header of the packet of that number lies."""
        return _SLOTS + packet % self.slots * _SLOT_BYTES

    def close(self) -> None:
        """Unmap, as soon as no view is left that somebody looks through."""
        del self._numbers
        with suppress(BufferError):  # a packet is still being looked at: the mapping goes with its last view
            self.view.release()
            self.map.close()


class RingWriter:
    """The writing side, in the capture process.

    Attributes
    ----------
    dropped_packets, dropped_events
        What did not fit, since the ring was made.
    """

    def __init__(self, memory: RingMemory, semaphore: int) -> None:
        self._memory, self._semaphore = memory, semaphore
        self._written = self._head = 0
        self._gap, self._lost = False, 0
        self._notes = b""
        self.dropped_packets = self.dropped_events = 0

    def restart(self) -> None:
        """Forget a gap that belongs to a delivery which has ended."""
        self._gap, self._lost = False, 0

    def publish(self, packet: Captured, generation: int) -> bool:
        """Copy a packet into the ring, or drop it if there is no room; say which."""
        memory = self._memory
        data = np.frombuffer(packet.data, np.uint8) if isinstance(packet.data, bytes) else _as_bytes(packet.data)
        extra = b"".join(_extras(packet))
        padded = _padded(data.size)
        size = -(-(padded + len(extra)) // ALIGNMENT) * ALIGNMENT
        at = self._head % memory.capacity
        begin = self._head if at + size <= memory.capacity else self._head + memory.capacity - at
        full = self._written - memory.number(_READ) >= memory.slots
        if full or begin + size - memory.number(_RELEASED) > memory.capacity:
            self._gap, self._lost = True, self._lost + packet.events + packet.lost_events
            self.dropped_packets += 1
            self.dropped_events += packet.events
            return False
        place = memory.data_begin + begin % memory.capacity
        if data.size:
            np.frombuffer(memory.map, np.uint8, data.size, place)[:] = data
        memory.view[place + padded : place + padded + len(extra)] = extra
        until = _UNKNOWN if packet.complete_until_us is None else packet.complete_until_us
        _SLOT.pack_into(
            memory.map,
            memory.slot(self._written),
            place,
            data.size,
            begin + size,
            generation,
            packet.received_ns,
            until,
            packet.events,
            len(packet.frames),
            len(packet.triggers),
            int(packet.gap_before or self._gap),
            packet.lost_events + self._lost,
            packet.backlog,
            len(packet.imu),
            self._written,
        )
        self._head = begin + size
        self._written += 1
        memory.set_number(_WRITTEN, self._written)
        self._gap, self._lost = False, 0
        os.eventfd_write(self._semaphore, 1)
        return True

    def beat(self, now_ns: int) -> None:
        """Say that the writer is alive."""
        self._memory.set_number(_HEARTBEAT, now_ns)

    def note(self, notes: Mapping[str, float]) -> None:
        """Leave the camera's own counters where the reader finds them at any time."""
        text = json.dumps(notes).encode()[:_NOTES_BYTES]
        if text == self._notes:
            return
        self._notes = text
        version = self._memory.number(_NOTES_VERSION)
        self._memory.set_number(_NOTES_VERSION, version + 1)
        self._memory.view[_NOTES : _NOTES + len(text)] = text
        self._memory.set_number(_NOTES_LENGTH, len(text))
        self._memory.set_number(_NOTES_VERSION, version + 2)


class RingReader:
    """The reading side, in the controller."""

    def __init__(self, memory: RingMemory, semaphore: int) -> None:
        self._memory, self._semaphore = memory, semaphore
        self._taken = 0
        self._release_to = 0
        self._notes: dict[str, float] = {}

    def take(self) -> Taken | None:
        """Return the next packet, or ``None`` if there is none. Gives the place of the one before back."""
        try:
            os.eventfd_read(self._semaphore)
        except BlockingIOError:
            self._give_back()
            return None
        self._give_back()
        memory = self._memory
        header = _SLOT.unpack_from(memory.map, memory.slot(self._taken))
        (place, size, end, generation, received_ns, until, events) = header[:7]
        (frames, triggers, gap, lost, backlog, imu, number) = header[7:]
        assert number == self._taken, f"packet {number} lies where {self._taken} belongs"
        self._taken += 1
        self._release_to = end
        at = place + _padded(size)
        edges, at = _read_triggers(memory.map, at, triggers)
        samples, at = _read_imu(memory.map, at, imu)
        return Taken(
            data=memory.view[place : place + size].toreadonly(),
            generation=generation,
            received_ns=received_ns,
            complete_until_us=None if until == _UNKNOWN else until,
            events=events,
            frames=_read_frames(memory.map, at, frames),
            triggers=edges,
            gap_before=bool(gap),
            lost_events=lost,
            backlog=backlog,
            imu=samples,
        )

    @property
    def heartbeat_ns(self) -> int:
        """When the writer last said that it was alive; 0 if never."""
        return self._memory.number(_HEARTBEAT)

    @property
    def waiting(self) -> int:
        """How many packets wait in the ring."""
        return self._memory.number(_WRITTEN) - self._taken

    def notes(self) -> dict[str, float]:
        """Return the camera's own counters as the writer last left them."""
        memory = self._memory
        version = memory.number(_NOTES_VERSION)
        if version % 2 == 0:
            text = bytes(memory.view[_NOTES : _NOTES + memory.number(_NOTES_LENGTH)])
            if text and memory.number(_NOTES_VERSION) == version:
                self._notes = json.loads(text)
        return dict(self._notes)

    def _give_back(self) -> None:
        self._memory.set_number(_RELEASED, self._release_to)
        self._memory.set_number(_READ, self._taken)


def _padded(size: int) -> int:
    return -(-size // 8) * 8


def _as_bytes(data: NDArray[Any]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(data).view(np.uint8)


def _extras(packet: Captured) -> Iterator[bytes]:
    for edge in packet.triggers:
        yield _TRIGGER.pack(edge.t_us, edge.id, edge.rising)
    for one in packet.imu:
        yield _SAMPLE.pack(one.t_us, *one.acceleration_m_s2, *one.rotation_rad_s, one.temperature_c)
    for frame in packet.frames:
        height, width = frame.pixels.shape
        depth = frame.pixels.itemsize
        yield _FRAME.pack(frame.t_us, frame.available_us, frame.exposure_us, height, width, depth)
        pixels = np.ascontiguousarray(frame.pixels).tobytes()
        yield pixels + bytes(_padded(len(pixels)) - len(pixels))


def _read_triggers(memory: mmap.mmap, at: int, count: int) -> tuple[tuple[Trigger, ...], int]:
    edges = []
    for _ in range(count):
        t_us, channel, rising = _TRIGGER.unpack_from(memory, at)
        edges.append(Trigger(SensorUs(t_us), channel, bool(rising)))
        at += _TRIGGER.size
    return tuple(edges), at


def _read_imu(memory: mmap.mmap, at: int, count: int) -> tuple[tuple[ImuSample, ...], int]:
    end = at + count * _SAMPLE.size
    rows = _SAMPLE.iter_unpack(memory[at:end])
    return tuple(ImuSample(SensorUs(t), (ax, ay, az), (gx, gy, gz), c) for t, ax, ay, az, gx, gy, gz, c in rows), end


def _read_frames(memory: mmap.mmap, at: int, count: int) -> tuple[Frame, ...]:
    frames = []
    for _ in range(count):
        t_us, available_us, exposure_us, height, width, depth = _FRAME.unpack_from(memory, at)
        at += _FRAME.size
        pixels = np.frombuffer(memory, f"<u{depth}", height * width, at).reshape(height, width).copy()
        frames.append(Frame(SensorUs(t_us), SensorUs(available_us), exposure_us, pixels))
        at += _padded(height * width * depth)
    return tuple(frames)
