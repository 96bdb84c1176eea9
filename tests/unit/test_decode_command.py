"""``elpd decode`` as a program that people and other programs call."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from elpd_drivers.formats.raw import write_raw

from elpd import cli
from elpd.events.evt3_encode import Evt3Encoder
from elpd.records import Geometry

FIELDS = (
    "format width height events on first_us last_us triggers frames imu rate_controller "
    "digest lost lost_reason warnings"
)
EMPTY_DIGEST = "6b4e03423667"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["elpd", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), out, err

    return call


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "r.raw"
    encoder = Evt3Encoder(64)
    words = [
        encoder.encode(np.arange(5) * 10, np.arange(5), np.arange(5), np.array([1, 1, 0, 1, 0])).copy(),
        encoder.encode_trigger(60, 2, rising=True),
    ]
    write_raw(path, Geometry(64, 48), words, {})
    return path


def test_json_has_every_field_and_nothing_else_is_on_stdout(run: Any, recording: Path) -> None:
    code, out, err = run("decode", str(recording), "--json")
    answer = json.loads(out)
    assert (code, err) == (0, "")
    assert list(answer) == FIELDS.split()
    assert (answer["format"], answer["width"], answer["height"]) == ("EVT3", 64, 48)
    assert (answer["events"], answer["on"], answer["first_us"], answer["last_us"]) == (5, 3, 0, 40)
    assert answer["triggers"] == [{"t_us": 60, "id": 2, "rising": True}]
    assert answer["rate_controller"] is None


def test_people_get_lines(run: Any, recording: Path) -> None:
    code, out, _ = run("decode", str(recording))
    assert code == 0
    assert "r.raw: EVT3, 64x48" in out
    assert "60 us, channel 2, rising" in out


def test_a_recording_without_events_says_so(run: Any, tmp_path: Path) -> None:
    write_raw(tmp_path / "r.raw", Geometry(64, 48), [], {})
    code, out, _ = run("decode", str(tmp_path / "r.raw"), "--json")
    answer = json.loads(out)
    assert (code, answer["events"], answer["first_us"]) == (0, 0, None)
    assert set(answer["digest"].values()) == {EMPTY_DIGEST}
    assert answer["warnings"] == ["the file holds no events"]


def test_what_is_missing_or_odd_is_told(run: Any, tmp_path: Path) -> None:
    words = np.array([0x2001, 0x8001, 0x0001, 0x2001, 0x2050, 0x9999, 0x1000, 0x0300, 0x2001], np.uint16)
    path = tmp_path / "r.raw"
    write_raw(path, Geometry(64, 48), [words], {})
    path.write_bytes(path.read_bytes() + b"\x01")
    code, out, _ = run("decode", str(path), "--json")
    answer = json.loads(out)
    assert (code, answer["events"], answer["lost"]) == (0, 1, 3)
    assert len(answer["lost_reason"]) == 2
    assert answer["warnings"] == ["1 padding words (0x9999)", "1 reserved words"]


def test_events_that_the_rate_controller_dropped_are_lost(run: Any, tmp_path: Path) -> None:
    words = np.array([0x8001, 0xE014, 0xF009, 0xF000, 0x7000, 0xE016, 0xF004, 0xF000, 0x7000], np.uint16)
    write_raw(tmp_path / "r.raw", Geometry(64, 48), [words], {})
    answer = json.loads(run("decode", str(tmp_path / "r.raw"), "--json")[1])
    assert answer["rate_controller"] == {"before": 9, "after": 4}
    assert answer["lost"] == 5


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.raw", None, "cannot be read"),
        ("empty.raw", b"", "is empty"),
        ("notes.txt", b"focus was at 12 mm\n", "no format that is installed here"),
        ("davis.aedat", b"#!AER-DAT2.0\r\n\x00\x00", "RAW (EVT2, EVT2.1, EVT3)"),
        ("cut.dat", b"% Data file containing CD events.\n% Version 2\n\x00", "NPY, NPZ"),
        ("later.raw", b"% evt 4.0\n% end\n", "'4.0'"),
    ],
)
def test_a_file_that_cannot_be_read_is_a_usage_error(
    run: Any, tmp_path: Path, name: str, content: bytes | None, message: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    code, out, err = run("decode", str(tmp_path / name), "--json")
    answer = json.loads(out)
    assert code == 2
    assert answer["outcome"] is None
    assert answer["error"]["kind"] == "FormatError"
    assert message in answer["error"]["message"]
    assert err.count("\n") == 1


def test_a_directory_is_not_a_file(run: Any, tmp_path: Path) -> None:
    code, out, err = run("decode", str(tmp_path))
    assert (code, out) == (2, "")
    assert "is a directory" in err
