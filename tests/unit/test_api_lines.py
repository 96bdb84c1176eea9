from __future__ import annotations

import json
from contextlib import suppress

import pytest
from from_schema import ANY_JSON
from hypothesis import given
from hypothesis import strategies as st

from elpd.service.decimate import Decimator
from elpd.service.lines import DEEPEST, LONGEST_LINE, LineCutter, RefusedLine, may_be_urgent, read_call
from elpd.service.messages import JogParams, SampleEvent
from elpd.service.outbox import Outbox


def refusal(line: bytes) -> RefusedLine:
    with pytest.raises(RefusedLine) as caught:
        read_call(line)
    return caught.value


# --- lines into calls --------------------------------------------------------------------------------------------


def test_a_request_is_read() -> None:
    call = read_call(b'{"id": 7, "method": "jog", "params": {"by_um": -3}}')
    assert (call.number, call.method, call.params) == (7, "jog", JogParams(by_um=-3.0))
    assert read_call(b'{"method": "stop"}').number is None
    assert read_call(b'{"jsonrpc": "2.0", "id": "a", "method": "stop", "params": null}').number == "a"


@given(st.binary(max_size=200))
def test_whatever_comes_is_a_call_or_a_refusal(line: bytes) -> None:
    with suppress(RefusedLine):
        read_call(line)


@given(ANY_JSON, ANY_JSON, ANY_JSON)
def test_whatever_json_comes_is_a_call_or_a_refusal(number: object, method: object, params: object) -> None:
    line = json.dumps({"id": number, "method": method, "params": params}).encode()
    refused = refusal(line)  # no method has such a name, or such parameters
    if isinstance(number, int) and not isinstance(number, bool) and abs(number) < 2**63:
        assert refused.number == number


@pytest.mark.parametrize(
    ("line", "kind", "told"),
    [
        (b"stop", "UsageError", "not JSON"),
        (b"[1]", "UsageError", "is an object"),
        (b"\xff\xfe", "UsageError", "not UTF-8 (byte 0: 0xff)"),
        (b'{"method": "jog", "params": {"by_um": NaN}}', "UsageError", "NaN is no number"),
        (b'{"method": "jog", "params": {"by_um": -Infinity}}', "UsageError", "-Infinity is no number"),
        (b'{"method": "jog", "params": {"by_um": 1e999}}', "UsageError", "1e999 is too large"),
        (b'{"method": "jog", "params": {"by_um": "3"}}', "UsageError", "by_um"),
        (b'{"method": "jog", "params": {"by_um": true}}', "UsageError", "by_um"),
        (b'{"method": "jog"}', "UsageError", "by_um: Field required"),
        (b'{"method": "jog", "params": [3]}', "UsageError", "params is an object"),
        (b'{"method": "jog", "params": {"by_um": ' + b"9" * 5000 + b"}}", "UsageError", "not JSON"),
        (b'{"method": "focus", "dry_run": true}', "UsageError", "unknown key 'dry_run'"),
        (b'{"method": "focus", "params": {"dry-run": true}}', "UsageError", "dry-run: unknown key"),
        (b'{"method": "move", "params": {}}', "UsageError", "move: give to_um or fraction, one of both"),
        (b'{"method": "fokus"}', "UsageError", "there is no method 'fokus'"),
        (b'{"method": {}}', "UsageError", "there is no method {}"),
        (b'{"id": 1.5, "method": "stop"}', "UsageError", "id is"),
        (b'{"id": true, "method": "stop"}', "UsageError", "id is"),
        (b'{"id": [], "method": "stop"}', "UsageError", "id is"),
        (b'{"id": 9223372036854775808, "method": "stop"}', "UsageError", "id is"),
        (b"[" * 60_000, "TooLarge", "16 levels"),
        (b'{"a":' * 10_000 + b"1" + b"}" * 10_000, "TooLarge", "16 levels"),
        (b'{"id": 4, "x": ' + b"[" * 16 + b"]" * 16 + b"}", "TooLarge", "16 levels"),
    ],
)
def test_what_is_no_request_is_refused_with_a_reason(line: bytes, kind: str, told: str) -> None:
    refused = refusal(line)
    assert refused.error.kind == kind
    assert told in str(refused.error)


def test_nesting_up_to_the_limit_is_looked_at() -> None:
    nested = b"[" * (DEEPEST - 1) + b"]" * (DEEPEST - 1)
    assert "unknown key 'x'" in str(refusal(b'{"id": 4, "x": ' + nested + b"}").error)
    wide = json.dumps({"id": 4, "x": [[]] * 1000}).encode()
    assert refusal(wide).number == 4
    assert refusal(b'{"id": 4, "x": [' + nested + b"]}").number == 4


# --- bytes into lines --------------------------------------------------------------------------------------------


@given(st.lists(st.binary(max_size=30).filter(lambda line: b"\n" not in line)), st.data())
def test_lines_do_not_depend_on_how_they_arrive(lines: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(line + b"\n" for line in lines)
    cutter, told, at = LineCutter(), [], 0
    while at < len(stream):
        step = data.draw(st.integers(1, 40))
        told += cutter.feed(memoryview(stream)[at : at + step])
        at += step
    assert told == [line for line in lines if line.strip()]


@pytest.mark.parametrize("chunk", [1 << 10, 1 << 14, 1 << 20])
def test_a_line_past_the_limit_is_told_once_and_skipped(chunk: int) -> None:
    stream = b"a\n" + b"x" * 1_000_000 + b"\nb\n"
    cutter, told = LineCutter(), []
    for at in range(0, len(stream), chunk):
        told += cutter.feed(stream[at : at + chunk])
        assert len(cutter._rest) <= LONGEST_LINE + chunk
    assert told == [b"a", None, b"b"]


def test_the_limit_is_the_documented_one() -> None:
    assert list(LineCutter().feed(b"x" * (LONGEST_LINE - 1) + b"\n")) == [b"x" * (LONGEST_LINE - 1)]
    assert list(LineCutter().feed(b"x" * LONGEST_LINE + b"\n")) == [None]


def test_what_may_be_urgent_is_seen() -> None:
    assert may_be_urgent(b'{"method":"stop"}')
    assert may_be_urgent(b'{"method": "cancel"}')
    assert not may_be_urgent(b'{"method":"focus","params":{}}')


# --- what waits to be read ---------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.integers(1, 40), st.booleans(), st.integers(0, 2))))
def test_what_waits_is_bounded_and_in_order_and_answers_are_kept(pushed: list[tuple[int, bool, int]]) -> None:
    box = Outbox(bound_bytes=100)
    told: list[bytes] = []
    answers: list[bytes] = []
    dropped = 0
    for seq, (size, droppable, taken) in enumerate(pushed, 1):
        line = f"{seq} ".encode().ljust(size, b"x")
        said = box.push(line, droppable=droppable, seq=seq)
        if said < 0:
            assert not droppable
            assert sum(map(len, answers)) > 100
            return  # the client is dropped
        dropped += said
        if not droppable:
            answers.append(line)
        for _ in range(taken):
            out = box.pop()
            if out is not None:
                told.append(out)
                if out in answers:
                    answers.remove(out)
        assert box.waiting_bytes <= 100 + max((len(line) for line in answers), default=0)
    while (out := box.pop()) is not None:
        told.append(out)
    gaps = [json.loads(line) for line in told if b"dropped" in line]
    kept = [int(line.split()[0]) for line in told if b"dropped" not in line]
    numbers = [json.loads(line)["seq"] if b"dropped" in line else int(line.split()[0]) for line in told]
    assert numbers == sorted(set(numbers))
    assert {seq for seq, (_, droppable, _) in enumerate(pushed, 1) if not droppable} <= set(kept)
    assert len(pushed) - len(kept) == dropped == sum(gap["count"] for gap in gaps)
    assert box.waiting_bytes == len(box) == 0


def test_the_oldest_samples_go_first() -> None:
    box = Outbox(bound_bytes=30)
    for line in (b"first sample", b"an answer", b"next one"):
        box.push(line, droppable=line != b"an answer", seq=7)
    assert box.push(b"newest", droppable=True) == 1
    gap = b'{"event":"dropped","seq":7,"count":1}\n'
    assert [box.pop(), box.pop(), box.pop(), box.pop()] == [gap, b"an answer", b"next one", b"newest"]


def test_one_large_answer_may_wait_and_a_second_may_not() -> None:
    box = Outbox(bound_bytes=30)
    assert box.push(b"x" * 1000, droppable=False) == 0
    assert box.push(b"a sample", droppable=True) == 1
    assert box.push(b"another answer", droppable=False) == -1


# --- samples for eyes --------------------------------------------------------------------------------------------


def samples(path_um: list[float], spacing_us: int = 1000) -> list[SampleEvent]:
    return [
        SampleEvent(t_us=spacing_us * index, position_um=um, elp=0, score=0.0, events=0)
        for index, um in enumerate(path_um)
    ]


def test_so_many_samples_a_second_pass() -> None:
    decimator = Decimator(rate_hz=100.0)
    told = [sent.t_us for sample in samples(list(range(100))) for sent in decimator.take(sample)]
    assert told == list(range(0, 100_000, 10_000))
    assert [sample.t_us for sample in decimator.held()] == [99_000]
    assert decimator.held() == []


@given(st.lists(st.floats(-100, 100), max_size=60), st.sampled_from([10.0, 100.0, 300.0, 1000.0]))
def test_the_turning_points_are_never_left_out(path_um: list[float], rate_hz: float) -> None:
    decimator = Decimator(rate_hz)
    told = [sent.t_us for sample in samples(path_um) for sent in decimator.take(sample)]
    assert told == sorted(set(told))
    upward: bool | None = None
    for index in range(1, len(path_um)):
        if path_um[index] == path_um[index - 1]:
            continue
        turned, upward = (
            upward is not None and (path_um[index] > path_um[index - 1]) is not upward,
            (path_um[index] > path_um[index - 1]),
        )
        assert not turned or 1000 * (index - 1) in told


def test_a_clock_that_jumps_back_does_not_silence_the_curve() -> None:
    decimator = Decimator(rate_hz=10.0)
    first, second = samples([0.0, 1.0], spacing_us=1_000_000)
    assert decimator.take(second) == [second]
    assert decimator.take(first) == [first]
