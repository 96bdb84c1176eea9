"""The only seams: Protocols that hardware, simulators, recordings and test doubles fill.

A seam is right when its test double fits in twenty lines, so each has at most six methods. Whoever writes a driver, or
needs one, imports from here; to read, they lie apart: ``devices`` that every rig has, ``abilities`` that some devices
have, ``rigs`` as entry points deliver them, and event ``files``. Nothing else belongs here: what a seam hands over is
in ``elpd.records``.
"""

from elpd.ports.abilities import (
    Biases,
    Closeable,
    Counters,
    HardwareRoi,
    Identified,
    Inertial,
    Latency,
    LearnsStops,
    Outputs,
    PixelMask,
    RateLimit,
    Remarks,
    Reopens,
    TakesMarks,
    Temperature,
    TriggerInput,
)
from elpd.ports.devices import Aperture, BytePort, Clock, EventCamera, Lens, RunSink
from elpd.ports.files import RecordingFormat, RecordingReader, RecordingWriter, WritableFormat, WriterTraits
from elpd.ports.rigs import Board, Discovery, FoundDevice, Paced, RigParts, RunningBoard, Scenery, Truth

__all__ = [
    "Aperture",
    "Biases",
    "Board",
    "BytePort",
    "Clock",
    "Closeable",
    "Counters",
    "Discovery",
    "EventCamera",
    "FoundDevice",
    "HardwareRoi",
    "Identified",
    "Inertial",
    "Latency",
    "LearnsStops",
    "Lens",
    "Outputs",
    "Paced",
    "PixelMask",
    "RateLimit",
    "RecordingFormat",
    "RecordingReader",
    "RecordingWriter",
    "Remarks",
    "Reopens",
    "RigParts",
    "RunSink",
    "RunningBoard",
    "Scenery",
    "TakesMarks",
    "Temperature",
    "TriggerInput",
    "Truth",
    "WritableFormat",
    "WriterTraits",
]
