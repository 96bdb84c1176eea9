from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import math
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis.strategies as st
import numpy as np
import pytest
import scripted_rig
from hypothesis import given, settings
from scripted_rig import packet
from scripted_rig import scripted_rig as rig_of

from elpd import ports
from elpd.errors import CameraError, FormatError, LensError, ReplayDiverged
from elpd.ports import Biases, Closeable, HardwareRoi, Latency, PixelMask
from elpd.record.abilities import ABILITIES as TAPED
from elpd.record.playback import TapeReader, replay_rig
from elpd.record.tape import TapeWriter, open_file, tape_rig
from elpd.records import (
    BiasSet,
    CameraPacket,
    CommandStamp,
    Encoding,
    Frame,
    ImuSample,
    LensFlag,
    LensReport,
    PositionEstimate,
    Roi,
    StopMode,
    StopTiming,
    Trigger,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from elpd.ports import RigParts

    Player = Callable[[Path], TapeReader]

ABILITIES = (HardwareRoi, Biases, PixelMask, Latency, Closeable)

EVENTS = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
AEDAT = np.dtype([("timestamp", "<i8"), ("x", "<i2"), ("y", "<i2"), ("polarity", "i1")], align=True)
DATA_TYPES = {Encoding.EVT2: [np.dtype("<u4")], Encoding.EVT21: [np.dtype("<u8")], Encoding.EVT3: [np.dtype("<u2")]} | {
    Encoding.ARRAY: [EVENTS, AEDAT]
}


def same(one: Any, other: Any) -> bool:
    """Equality to the last bit, arrays and nan included."""
    if isinstance(one, np.ndarray):
        alike = one.dtype == other.dtype and one.shape == other.shape
        return alike and (np.array_equal(one, other) if one.dtype.names else one.tobytes() == other.tobytes())
    if dataclasses.is_dataclass(one):
        return type(one) is type(other) and all(
            same(getattr(one, item.name), getattr(other, item.name)) for item in dataclasses.fields(one)
        )
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float):
        return type(other) is float and (
            (math.isnan(one) and math.isnan(other))
            or (one == other and math.copysign(1, one) == math.copysign(1, other))
        )
    return type(one) is type(other) and one == other


times = st.integers(-(2**62), 2**62)
floats = st.floats()
axes = st.tuples(floats, floats, floats)


@st.composite
def arrays(draw: st.DrawFn, dtype: np.dtype[Any], most: int = 40) -> Any:
    count = draw(st.integers(0, most))
    seed = draw(st.integers(0, 2**31))
    raw = np.random.default_rng(seed).integers(0, 2, count * dtype.itemsize).astype(np.uint8)
    return raw.view(dtype) if count else np.empty(0, dtype)


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    dtype = draw(st.sampled_from([np.uint8, np.uint16, np.float32]))
    height, width = draw(st.integers(0, 5)), draw(st.integers(0, 5))
    values = np.random.default_rng(draw(st.integers(0, 99))).integers(0, 256, (height, width))
    return Frame(draw(times), draw(times), draw(st.integers(0, 10**6)), values.astype(dtype))


@st.composite
def packets(draw: st.DrawFn) -> CameraPacket:
    encoding = draw(st.sampled_from(Encoding))
    return CameraPacket(
        data=draw(arrays(draw(st.sampled_from(DATA_TYPES[encoding])))),
        encoding=encoding,
        received_ns=draw(times),
        complete_until_us=draw(st.none() | times),
        frames=tuple(draw(st.lists(frames(), max_size=2))),
        triggers=tuple(draw(st.lists(st.builds(Trigger, times, st.integers(0, 9), st.booleans()), max_size=2))),
        gap_before=draw(st.booleans()),
        lost_events=draw(st.integers(0, 9)),
        backlog=draw(st.integers(0, 9)),
        imu=tuple(draw(st.lists(st.builds(ImuSample, times, axes, axes, floats), max_size=2))),
    )


stamps = st.builds(CommandStamp, st.text(max_size=8), times, times)
reports = st.builds(
    LensReport,
    floats,
    times,
    times,
    st.none() | floats,
    st.sampled_from([LensFlag.NONE, LensFlag.MOVING | LensFlag.LIMIT, LensFlag.ALARM]),
)
positions = st.builds(PositionEstimate, floats, floats)
rois = st.builds(Roi, *[st.integers(-9, 2000)] * 4)
failures = st.builds(LensError, st.text()) | st.builds(CameraError, st.text()) | st.builds(ValueError, st.text())

CALLS: dict[str, tuple[st.SearchStrategy[tuple[Any, ...]], st.SearchStrategy[Any]]] = {
    "clock.now_ns": (st.just(()), times),
    "clock.sleep_until": (st.tuples(times), st.none()),
    "camera.start": (st.just(()), st.none()),
    "camera.read": (st.tuples(floats), st.none() | packets()),
    "camera.stop": (st.just(()), st.none()),
    "camera.set_window": (st.tuples(st.none() | rois), st.none()),
    "camera.apply_biases": (st.tuples(st.sampled_from(BiasSet)), st.none()),
    "camera.set_mask": (st.tuples(st.lists(st.tuples(times, times), max_size=3)), st.integers(0, 3)),
    "camera.close": (st.just(()), st.none()),
    "lens.home": (st.tuples(times), reports),
    "lens.move_to": (st.tuples(times, floats), stamps),
    "lens.run": (st.tuples(floats, times), stamps),
    "lens.stop": (st.tuples(st.sampled_from(StopMode)), stamps),
    "lens.poll": (st.just(()), st.none() | reports),
    "lens.position_at": (st.tuples(times), positions),
    "lens.close": (st.just(()), st.none()),
    "aperture.open": (st.just(()), stamps),
    "aperture.close": (st.just(()), stamps),
    "aperture.transmittance": (st.tuples(arrays(np.dtype(np.float64))), arrays(np.dtype(np.float64))),
}


@st.composite
def exchanges(draw: st.DrawFn) -> tuple[str, tuple[Any, ...], Any]:
    call = draw(st.sampled_from(sorted(CALLS)))
    arguments, answers = CALLS[call]
    return call, draw(arguments), draw(answers | failures)


def ask(parts: RigParts, call: str, arguments: tuple[Any, ...]) -> Any:
    device, method = call.split(".")
    try:
        return getattr(getattr(parts, device), method)(*arguments)
    except (LensError, CameraError, ValueError) as error:
        return error


@pytest.fixture
def player() -> Iterator[Player]:
    """Open tapes that are closed when the test ends."""
    with contextlib.ExitStack() as stack:
        yield lambda directory: stack.enter_context(TapeReader(directory))


def recorded(directory: Path, answers: list[Any], **options: Any) -> tuple[TapeWriter, RigParts]:
    tape = TapeWriter(directory, **options)
    return tape, tape_rig(rig_of(answers), tape)


@settings(max_examples=150, deadline=None)
@given(script=st.lists(exchanges(), max_size=12), flush_every=st.integers(1, 5))
def test_what_was_answered_is_answered_again(
    script: list[tuple[str, tuple[Any, ...], Any]], flush_every: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    directory = tmp_path_factory.mktemp("tape")
    tape, parts = recorded(directory, [answer for _, _, answer in script])
    for number, (call, arguments, answer) in enumerate(script):
        assert ask(parts, call, arguments) is answer
        if number % flush_every == 0:
            tape.flush()
    tape.close()

    with TapeReader(directory) as reader:
        replayed = replay_rig(reader)
        for call, arguments, answer in script:
            again = ask(replayed, call, arguments)
            if isinstance(answer, Exception):
                assert (type(again), str(again)) == (type(answer), str(answer))
            else:
                assert same(again, answer), (call, answer, again)
        assert reader.remaining() == 0
        assert reader.truncated is None


def test_properties_come_back(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [])
    tape.close()
    for rig in (parts, replay_rig(player(tmp_path))):
        assert rig.camera.geometry == scripted_rig.GEOMETRY
        assert rig.lens.limits == scripted_rig.LIMITS
        assert rig.lens.capabilities == scripted_rig.CAPABILITIES
        assert rig.aperture is not None
        assert rig.aperture.opening_ms == 20.0
        assert rig.um_per_step == 0.3125
        assert isinstance(rig.camera, Latency)
        assert rig.camera.min_latency_us == 83.5


@pytest.mark.parametrize("camera", [scripted_rig.Camera, scripted_rig.AbleCamera])
@pytest.mark.parametrize("lens", [scripted_rig.Lens, scripted_rig.CloseableLens])
def test_optional_abilities_are_those_of_the_device(player: Player, tmp_path: Path, camera: Any, lens: Any) -> None:
    true = rig_of(camera=camera, lens=lens, aperture=None)
    tape = TapeWriter(tmp_path)
    taped = tape_rig(true, tape)
    tape.close()
    replayed = replay_rig(player(tmp_path))
    for rig in (taped, replayed):
        assert rig.aperture is None
        for ability in ABILITIES:
            for device in ("clock", "camera", "lens"):
                assert isinstance(getattr(rig, device), ability) == isinstance(getattr(true, device), ability)


def test_a_packet_is_kept_although_its_view_ends_with_the_next_read(player: Player, tmp_path: Path) -> None:
    buffer = packet(1)
    kept = buffer.data.copy()
    tape, parts = recorded(tmp_path, [buffer])
    parts.camera.read(0.1)
    buffer.data[:] = 0
    tape.close()
    again = replay_rig(player(tmp_path)).camera.read(0.1)
    assert again is not None
    assert np.array_equal(again.data, kept)
    assert again.data.flags.writeable
    assert again.data.flags.c_contiguous


def test_evt3_words_are_a_valid_raw_file(tmp_path: Path) -> None:
    one, two = packet(1), packet(2)
    tape, parts = recorded(tmp_path, [one, two])
    parts.camera.read(0.1)
    parts.camera.read(0.1)
    tape.close()
    raw = (tmp_path / "events.raw").read_bytes()
    header, words = raw.split(b"% end\n", 1)
    assert header == b"% evt 3.0\n% format EVT3;height=48;width=64\n% geometry 64x48\n"
    assert words == one.data.tobytes() + two.data.tobytes()


def test_bytes_between_the_fields_do_not_reach_the_file(tmp_path: Path) -> None:
    files = []
    for noise in (0x00, 0xFF):
        data = np.full(5 * AEDAT.itemsize, noise, np.uint8).view(AEDAT)
        for name in AEDAT.names or ():
            data[name] = 3
        tape, parts = recorded(tmp_path / str(noise), [CameraPacket(data, Encoding.ARRAY, 0)])
        parts.camera.read(0.1)
        tape.close()
        files.append((tmp_path / str(noise) / "events.bin").read_bytes())
    assert files[0] == files[1]
    assert len(files[0]) == 5 * AEDAT.itemsize


def test_a_different_argument_is_a_divergence_that_says_what_and_where(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [None, CommandStamp("run", 1, 2), CommandStamp("stop", 3, 4)])
    parts.camera.start()
    parts.lens.run(100.0, 5)
    parts.lens.stop(StopMode.ABRUPT)
    tape.close()
    reader = player(tmp_path)
    rig = replay_rig(reader)
    rig.camera.start()
    with pytest.raises(ReplayDiverged) as diverged:
        rig.lens.run(math.nextafter(100.0, 200.0), 5)
    assert str(diverged.value) == "at call 2: recorded lens.run[100.0,5], asked lens.run[100.00000000000001,5]"
    with pytest.raises(ReplayDiverged, match="at call 2"):  # latched: an orderly retreat adds no findings of its own
        rig.lens.stop(StopMode.ABRUPT)


def test_asking_on_after_the_end_is_a_divergence(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [7])
    parts.clock.now_ns()
    tape.close()
    rig = replay_rig(player(tmp_path))
    assert rig.clock.now_ns() == 7
    with pytest.raises(
        ReplayDiverged, match=r"after call 1: recorded nothing \(the run had ended\), asked clock.now_ns"
    ):
        rig.clock.now_ns()


# Per ability: how a cycle uses it, and what the device then answers.
USES: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "camera.HardwareRoi": (lambda rig: rig.camera.set_window(Roi(1, 2, 3, 4)), None),
    "camera.Biases": (lambda rig: rig.camera.apply_biases(BiasSet.EXPOSE), None),
    "camera.PixelMask": (lambda rig: rig.camera.set_mask([(1, 2)]), 1),
    "camera.TriggerInput": (lambda rig: rig.camera.enable_trigger(on=True), None),
    "camera.RateLimit": (lambda rig: rig.camera.limit_rate(2.5), None),
    "camera.Temperature": (lambda rig: rig.camera.temperature_c(), float("nan")),
    "camera.Inertial": (lambda rig: rig.camera.enable_imu(on=False), None),
    "camera.Counters": (lambda rig: rig.camera.counters, scripted_rig.EveryCamera.counters),
    "camera.Reopens": (lambda rig: rig.camera.reopen(), True),
    "camera.Latency": (lambda rig: rig.camera.min_latency_us, 83.5),
    "camera.Identified": (lambda rig: rig.camera.serial, "00000499"),
    "camera.Remarks": (lambda rig: rig.camera.remarks, ("use a port of its own",)),
    "camera.Closeable": (lambda rig: rig.camera.close(), None),
    "lens.TakesMarks": (lambda rig: (rig.lens.mark_channel, rig.lens.mark(5))[1], True),
    "lens.LearnsStops": (
        lambda rig: (rig.lens.learn_stops({StopMode.ABRUPT: StopTiming(1.5, 0.1)}), rig.lens.capabilities)[1],
        dataclasses.replace(scripted_rig.CAPABILITIES, stop_onset_ms=1.5),
    ),
    "lens.Outputs": (lambda rig: rig.lens.set_output(rig.lens.outputs[0], on=True), CommandStamp("iris", 1, 2)),
    "lens.Identified": (lambda rig: rig.lens.serial, "L7"),
    "lens.Remarks": (lambda rig: rig.lens.remarks, ("the adapter is slow",)),
    "lens.Closeable": (lambda rig: rig.lens.close(), None),
    "clock.Paced": (lambda rig: rig.clock.lag_s, 0.25),
    "clock.Closeable": (lambda rig: rig.clock.close(), None),
}
NO_DEVICES = {"Scenery", "WritableFormat"}
"""A simulator's truth and a file's format: what they can do is on no tape."""


def test_every_ability_of_the_seams_is_taped() -> None:
    optional = {name for name, kind in vars(ports).items() if getattr(kind, "_is_runtime_protocol", False)}
    assert {name for abilities in TAPED.values() for name in abilities} == optional - NO_DEVICES
    assert {f"{device}.{name}" for device, abilities in TAPED.items() for name in abilities} == USES.keys()


@pytest.mark.parametrize("ability", USES)
def test_what_an_ability_answered_is_answered_again(player: Player, tmp_path: Path, ability: str) -> None:
    use, answer = USES[ability]
    true = rig_of([answer], scripted_rig.EveryCamera, scripted_rig.EveryLens, clock=scripted_rig.PacedClock)
    tape = TapeWriter(tmp_path)
    assert same(use(tape_rig(true, tape)), answer)
    tape.close()
    reader = player(tmp_path)
    assert same(use(replay_rig(reader)), answer)
    assert reader.remaining() == 0


def test_a_tape_from_before_these_abilities_were_on_it_is_read(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [7])
    parts.clock.now_ns()
    tape.close()
    path = tmp_path / "tape.jsonl"
    head, *calls = path.read_text().splitlines(keepends=True)
    facts = json.loads(head)
    for name in ("serials", "outputs", "mark_channel", "steps_to_um"):
        del facts["facts"][name]
    path.write_text("".join([json.dumps(facts) + "\n", *calls]))
    assert replay_rig(player(tmp_path)).clock.now_ns() == 7


class StrangeError(LensError):
    """What a stranger's driver might raise."""


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        (StrangeError("lost"), LensError("lost")),
        (KeyError("x"), KeyError("x")),
        (KeyboardInterrupt(), KeyboardInterrupt()),
        (UnicodeDecodeError("ascii", b"\xff", 0, 1, "no"), ValueError("'ascii' codec can't decode byte 0xff")),
        (OSError(errno.EIO, "Input/output error"), OSError("[Errno 5] Input/output error")),
    ],
)
def test_a_failure_is_raised_again_as_the_nearest_class_known(
    player: Player, tmp_path: Path, raised: BaseException, expected: BaseException
) -> None:
    tape, parts = recorded(tmp_path, [raised])
    with pytest.raises(type(raised)):
        parts.camera.read(0.1)
    tape.close()
    with pytest.raises(type(expected)) as again:
        replay_rig(player(tmp_path)).camera.read(0.1)
    assert str(again.value).startswith(str(expected))


def test_a_stop_from_another_thread_is_on_the_tape_and_not_asked_for_again(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [1, CommandStamp("stop", 0, 0), 2])
    parts.clock.now_ns()
    supervisor = threading.Thread(target=parts.lens.stop, args=(StopMode.ABRUPT,))
    supervisor.start()
    supervisor.join()
    parts.clock.now_ns()
    tape.close()
    assert '"outside":true' in (tmp_path / "tape.jsonl").read_text()
    rig = replay_rig(player(tmp_path))
    assert (rig.clock.now_ns(), rig.clock.now_ns()) == (1, 2)


def test_cancelling_is_replayed_at_the_same_poll(player: Player, tmp_path: Path) -> None:
    answers = iter([False, False, False, True, True])
    tape, parts = recorded(tmp_path, [1, 2])
    cancelled = tape.watch(lambda: next(answers))

    def poll(rig: RigParts, cancelled: Any) -> list[bool]:
        polls = [cancelled()]
        rig.clock.now_ns()
        polls += [cancelled(), cancelled(), cancelled()]
        rig.clock.now_ns()
        return [*polls, cancelled()]

    before = poll(parts, cancelled)
    tape.close()
    reader = player(tmp_path)
    assert poll(replay_rig(reader), reader.cancelled) == before == [False, False, False, True, True]


def test_past_the_memory_limit_the_tape_ends_and_the_run_goes_on(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [packet(1, 1000), packet(2, 1000), 5], memory_limit_bytes=3000)
    assert parts.camera.read(0.1) is not None
    assert parts.camera.read(0.1) is not None
    assert parts.clock.now_ns() == 5
    assert tape.waiting_bytes <= 3000
    tape.close()
    assert tape.truncated is not None
    assert "journal.memory_mb" in tape.truncated
    reader = player(tmp_path)
    rig = replay_rig(reader)
    assert rig.camera.read(0.1) is not None
    with pytest.raises(ReplayDiverged, match="memory_mb"):
        rig.camera.read(0.1)
    assert reader.truncated == tape.truncated


def test_a_full_device_ends_the_tape_and_not_the_run(player: Player, tmp_path: Path) -> None:
    def full(path: Path, mode: str, /) -> Any:
        path.touch()
        return open_file(path if path.suffix == ".jsonl" else Path("/dev/full"), mode)

    tape, parts = recorded(tmp_path, [packet(1, 100_000), 5, 6], opener=full)
    parts.camera.read(0.1)
    tape.flush()
    assert tape.truncated is not None
    assert "No space left on device" in tape.truncated
    assert parts.clock.now_ns() == 5
    tape.flush()
    assert parts.clock.now_ns() == 6
    tape.close()
    assert "cut off" in str(player(tmp_path).truncated)


def test_a_tape_cut_at_any_byte_reads_to_the_cut(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [1, 2, 3])
    for _ in range(3):
        parts.clock.now_ns()
    tape.close()
    whole = (tmp_path / "tape.jsonl").read_bytes()
    header_ends = whole.index(b"\n") + 1
    for length in range(len(whole)):
        (tmp_path / "tape.jsonl").write_bytes(whole[:length])
        if length < header_ends:
            with pytest.raises(FormatError, match="is no tape"):
                player(tmp_path)
            continue
        reader = player(tmp_path)
        rig = replay_rig(reader)
        complete = whole[header_ends:length].count(b"\n")
        assert [rig.clock.now_ns() for _ in range(min(3, complete))] == [1, 2, 3][:complete]
        assert (reader.truncated is None) == (complete == 4)
        reader.close()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("tape.jsonl", b'{"tape":99}\n', "tape format 99"),
        ("tape.jsonl", b"nonsense\n", "is damaged"),
        ("other", b"", "cannot be read"),
    ],
)
def test_what_is_no_tape_is_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError, match=message):
        TapeReader(tmp_path)


def test_missing_packet_data_are_named(player: Player, tmp_path: Path) -> None:
    tape, parts = recorded(tmp_path, [packet(1)])
    parts.camera.read(0.1)
    tape.close()
    raw = tmp_path / "events.raw"
    raw.write_bytes(raw.read_bytes()[:-6])
    with pytest.raises(FormatError, match=r"events\.raw: ends 6 bytes before"):
        replay_rig(player(tmp_path)).camera.read(0.1)


def test_a_tape_holds_one_rig(tmp_path: Path) -> None:
    tape, _ = recorded(tmp_path, [])
    with pytest.raises(ValueError, match="one rig"):
        tape_rig(rig_of(), tape)
    tape.close()
