"""A tape as a rig: devices that answer what they answered, provided that they are asked what they were asked.

Time on a tape is what the recorded clock said, so a replay needs no waiting and no threads. A question that differs
from the recorded one, in its method or in any argument down to the last bit of a float, ends the replay with
``ReplayDiverged``; the first divergence is latched, so that an orderly retreat (stop the lens, stop the camera) raises
the same finding again instead of inventing new ones.
"""

from __future__ import annotations

import builtins
import json
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, Self

import cv2
import numpy as np

from elpd import errors, records
from elpd.errors import FormatError, ReplayDiverged
from elpd.record.codec import number, to_json
from elpd.record.double import RigFacts
from elpd.record.seams import build_doubles
from elpd.record.tape import ARRAYS_FILE, TAPE_FILE, TAPE_FORMAT, digest
from elpd.units import HostNs, SensorUs, Steps

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    from elpd.ports import RigParts

_SHOWN = 160  # characters of a question that a message repeats
_WITHOUT_ANSWER = ".close"  # giving devices back is the caller's business, not the cycle's


class _Stream(NamedTuple):
    file: BinaryIO
    encoding: records.Encoding
    dtype: np.dtype[Any]


class TapeReader:
    """Questions and answers from a run's folder, in order.

    Parameters
    ----------
    directory
        A folder that ``TapeWriter`` wrote.

    Raises
    ------
    FormatError
        If there is no tape, or it is not one of ours, or it is damaged in the middle.

    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        path = directory / TAPE_FILE
        try:
            self._file = path.open(encoding="ascii")
        except OSError as error:
            raise FormatError(
                f"{path}: cannot be read ({error.strerror}); a run without a tape cannot replay"
            ) from None
        self._streams: dict[int, _Stream] = {}
        self._arrays: BinaryIO | None = None
        self._line_number = 0
        self._asked = 0
        self._polls = 0
        self._cancelled = 0
        self._next: dict[str, Any] | None = None
        self.end: dict[str, Any] | None = None
        self._divergence: ReplayDiverged | None = None
        try:
            self.facts = self._header()
            self._advance()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def asked(self) -> int:
        """How many calls have been answered."""
        return self._asked

    @property
    def truncated(self) -> str | None:
        """Why the tape ends early, known once it has been read to its end."""
        if self.end is None:
            return "the tape ends without its closing line: the recording was cut off"
        return str(self.end["truncated"]) if self.end["truncated"] else None

    @property
    def divergence(self) -> ReplayDiverged | None:
        """The first question that differed, if one did."""
        return self._divergence

    def ask(self, call: str, /, *arguments: Any) -> Any:
        """Answer as recorded. Raises what was raised, or ``ReplayDiverged``."""
        return self._answered(call, arguments)

    def ask_array(self, call: str, argument: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Answer the one call that takes an array, known by its digest."""
        answer: NDArray[np.float64] = self._answered(call, (digest(argument),))
        return answer

    def cancelled(self) -> int:
        """Answer as the recorded ``cancelled`` did at the same poll."""
        self._polls += 1
        line = self._next
        if line is not None and line["call"] == "cancelled" and line["args"] == [self._polls]:
            self._cancelled = int(line["answer"])
            self._advance()
        return self._cancelled

    def packets(self) -> Iterator[records.CameraPacket]:
        """Yield every packet that is left, whatever else was asked in between."""
        while self._next is not None:
            line = self._next
            if line["call"] == "camera.read" and line.get("answer") is not None:
                yield self._packet(line["answer"])
            self._advance()

    def remaining(self) -> int:
        """Read to the end; return how many recorded calls nobody asked for, not counting those that close devices."""
        count = 0
        while self._next is not None:
            count += not self._next["call"].endswith(_WITHOUT_ANSWER)
            self._advance()
        return count

    def close(self) -> None:
        """Close the files. Idempotent."""
        self._file.close()
        for stream in self._streams.values():
            stream.file.close()
        if self._arrays is not None:
            self._arrays.close()

    # --- questions ---------------------------------------------------------------------------------------------

    def _answered(self, call: str, arguments: tuple[Any, ...]) -> Any:
        line = self._next
        asked = to_json(arguments)
        if line is None or line["call"] != call or to_json(line["args"]) != asked:
            self._diverge(line, call, asked)
        self._asked += 1
        decode = _DECODERS.get(call)
        if "raised" in line:
            self._advance()
            raise _exception(*line["raised"])
        answer = line["answer"]
        if call == "camera.read" and answer is not None:
            answer = self._packet(answer)
        elif call == "aperture.transmittance":
            answer = self._array(answer)
        elif decode is not None and answer is not None:
            answer = decode(answer)
        self._advance()
        return answer

    def _diverge(self, line: dict[str, Any] | None, call: str, asked: str) -> NoReturn:
        if self._divergence is None:
            if line is None:
                recorded = f"nothing ({self.truncated or 'the run had ended'})"
                place = f"after call {self._asked}"
            else:
                recorded = _clip(f"{line['call']}{to_json(line['args'])}")
                place = f"at call {line['n']}"
            self._divergence = ReplayDiverged(f"{place}: recorded {recorded}, asked {_clip(call + asked)}")
        raise self._divergence

    # --- lines -------------------------------------------------------------------------------------------------

    def _header(self) -> RigFacts:
        line = self._line()
        if line is None or "tape" not in line:
            raise FormatError(f"{self._directory / TAPE_FILE}: is no tape: its first line has no format number")
        if line["tape"] != TAPE_FORMAT:
            raise FormatError(
                f"{self._directory / TAPE_FILE}: tape format {line['tape']}, this elpd reads {TAPE_FORMAT}; "
                "replay it with the elpd that its run.json names"
            )
        return _facts(line["facts"])

    def _advance(self) -> None:
        """Find the next call of the cycle's own thread, opening streams on the way."""
        while (line := self._line()) is not None:
            if "stream" in line:
                self._open_stream(line)
            elif "end" in line:
                self.end = line
                break
            elif not line.get("outside", False):
                self._next = line
                return
        self._next = None

    def _line(self) -> dict[str, Any] | None:
        text = self._file.readline()
        self._line_number += 1
        if not text.endswith("\n"):  # the end, or a last line that was cut off
            return None
        try:
            line: dict[str, Any] = json.loads(text)
        except json.JSONDecodeError as error:
            raise FormatError(f"{self._directory / TAPE_FILE}:{self._line_number}: is damaged ({error})") from None
        return line

    def _open_stream(self, line: dict[str, Any]) -> None:
        path = self._directory / line["file"]
        try:
            file = path.open("rb")
        except OSError as error:
            raise FormatError(f"{path}: cannot be read ({error.strerror}); the tape refers to it") from None
        file.seek(line["begins"])
        self._streams[line["stream"]] = _Stream(file, records.Encoding(line["encoding"]), _dtype(line["dtype"]))

    # --- what does not fit on a line ---------------------------------------------------------------------------

    def _packet(self, line: dict[str, Any]) -> records.CameraPacket:
        stream = self._streams[line["stream"]]
        complete_until = line["complete_until_us"]
        return records.CameraPacket(
            data=self._values(stream.file, stream.dtype, line["count"]),
            encoding=stream.encoding,
            received_ns=HostNs(line["received_ns"]),
            complete_until_us=None if complete_until is None else SensorUs(complete_until),
            frames=tuple(self._frame(frame) for frame in line.get("frames", ())),
            triggers=tuple(records.Trigger(*trigger) for trigger in line.get("triggers", ())),
            gap_before=line.get("gap_before", False),
            lost_events=line.get("lost_events", 0),
            backlog=line.get("backlog", 0),
            imu=tuple(_sample(*row) for row in line.get("imu", ())),
        )

    def _array(self, line: dict[str, Any]) -> NDArray[Any]:
        if self._arrays is None:
            self._arrays = (self._directory / ARRAYS_FILE).open("rb")
        count = int(np.prod(line["shape"], dtype=np.int64))
        return self._values(self._arrays, np.dtype(line["dtype"]), count).reshape(line["shape"])

    def _values(self, file: BinaryIO, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        """Read the next *count* values into an array of their own: kernels want it writeable and aligned."""
        values = np.empty(count, dtype)
        read = file.readinto(values.view(np.uint8)) if values.nbytes else 0  # type: ignore[attr-defined]
        if read != values.nbytes:
            raise FormatError(f"{file.name}: ends {values.nbytes - read} bytes before the tape does; it was cut off")
        return values

    def _frame(self, line: dict[str, Any]) -> records.Frame:
        path = self._directory / line["file"]
        if path.suffix == ".png":
            pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        else:
            pixels = np.load(path, allow_pickle=False)
        if pixels is None:
            raise FormatError(f"{path}: is no picture any more; the tape refers to it")
        return records.Frame(
            t_us=SensorUs(line["t_us"]),
            available_us=SensorUs(line["available_us"]),
            exposure_us=line["exposure_us"],
            pixels=pixels,
        )


def replay_rig(tape: TapeReader) -> RigParts:
    """Return the recorded rig: the same properties and abilities, answers from the tape, no truth."""
    return build_doubles(tape.facts, tape)


def _report(line: dict[str, Any]) -> records.LensReport:
    return records.LensReport(
        steps=number(line["steps"]),
        earliest_ns=HostNs(line["earliest_ns"]),
        latest_ns=HostNs(line["latest_ns"]),
        velocity_sps=number(line["velocity_sps"]),
        flags=records.LensFlag(line["flags"]),
    )


def _sample(t_us: int, *measured: Any) -> records.ImuSample:
    ax, ay, az, gx, gy, gz, celsius = (number(value) for value in measured)
    return records.ImuSample(SensorUs(t_us), (ax, ay, az), (gx, gy, gz), celsius)


def _stamp(line: dict[str, Any]) -> records.CommandStamp:
    return records.CommandStamp(line["command"], HostNs(line["begun_ns"]), HostNs(line["done_ns"]))


def _position(line: dict[str, Any]) -> records.PositionEstimate:
    return records.PositionEstimate(number(line["steps"]), number(line["sigma_steps"]))


def _capabilities(line: dict[str, Any]) -> records.LensCapabilities:
    return records.LensCapabilities(**{name: number(value) for name, value in line.items()})


_DECODERS: dict[str, Callable[[Any], Any]] = {
    "lens.home": _report,
    "lens.poll": _report,
    "lens.move_to": _stamp,
    "lens.run": _stamp,
    "lens.stop": _stamp,
    "lens.position_at": _position,
    "lens.set_output": _stamp,
    "lens.learn_stops": _capabilities,
    "lens.remarks": tuple,
    "camera.remarks": tuple,
    "camera.temperature_c": number,
    "camera.counters": lambda counts: {name: number(value) for name, value in counts.items()},
    "clock.lag_s": number,
    "aperture.open": _stamp,
    "aperture.close": _stamp,
}


def _facts(line: dict[str, Any]) -> RigFacts:
    limits, capabilities = line["limits"], line["capabilities"]
    return RigFacts(
        geometry=records.Geometry(**line["geometry"]),
        limits=records.LensLimits(
            min_steps=Steps(limits["min_steps"]),
            max_steps=Steps(limits["max_steps"]),
            max_speed_sps=number(limits["max_speed_sps"]),
            acceleration_sps2=number(limits["acceleration_sps2"]),
        ),
        capabilities=_capabilities(capabilities),
        um_per_step=number(line["um_per_step"]),
        steps_to_um=tuple((number(steps), number(um)) for steps, um in line.get("steps_to_um", ())),
        opening_ms=number(line["opening_ms"]),
        min_latency_us=number(line["min_latency_us"]),
        mark_channel=line.get("mark_channel"),
        serials=line.get("serials", {}),
        outputs=tuple(line.get("outputs", ())),
        abilities={device: tuple(names) for device, names in line["abilities"].items()},
    )


def _dtype(description: Any) -> np.dtype[Any]:
    return np.lib.format.descr_to_dtype(_descr(description))


def _descr(part: Any) -> Any:
    """Give a dtype's description its tuples back, which JSON turned into lists."""
    if not isinstance(part, list):
        return part
    if all(isinstance(item, int) for item in part):  # the shape of a sub-array
        return tuple(part)
    return [tuple(_descr(item) for item in field) for field in part]


def _exception(kind: str, message: str) -> BaseException:
    """Build what was raised, or the nearest base that takes one message."""
    named = getattr(errors, kind, None) or getattr(builtins, kind)
    for base in named.__mro__:
        try:
            error = base(message)
        except TypeError:  # such as UnicodeDecodeError, which takes five arguments
            continue
        if isinstance(error, BaseException):
            return error
    return RuntimeError(message)


def _clip(text: str) -> str:
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"
