"""Sweeps from disk: what is read, what is refused, and what is never looked at."""

from typing import Any

import cv2
import numpy as np
import pytest

from elpd.errors import FormatError, UsageError
from elpd.record.layouts import read_sweep
from elpd.records import Geometry, Roi

T = np.array([5, 10, 10, 40])
X = np.array([0, 3, 19, 7])
Y = np.array([1, 2, 14, 5])
P = np.array([1, 0, 1, 0])


def structured(t: Any = T, x: Any = X, y: Any = Y, p: Any = P, names: Any = ("t", "x", "y", "p")) -> Any:
    array = np.empty(len(t), [(names[0], "<i4"), (names[1], "u1"), (names[2], "u1"), (names[3], "i1")])
    for name, column in zip(names, (t, x, y, p), strict=True):
        array[name] = column
    return array


@pytest.fixture
def folder(tmp_path: Any) -> Any:
    np.save(tmp_path / "event.npy", structured())
    (tmp_path / "info.txt").write_text(
        "start_timestamp = 0\ngt_timestamp = 12345\ndelta_t = 1500\nROI selected: (2, 12, 4, 18)\n"
    )
    frames = tmp_path / "davis_frames_50"
    frames.mkdir()
    for t_us in (0, 20000, 100000):
        cv2.imwrite(str(frames / f"{t_us:07d}.png"), np.full((16, 20), 7, np.uint8))
    return tmp_path


def test_the_authors_folder(folder: Any) -> None:
    sweep = read_sweep(folder)
    assert sweep.t_us.tolist() == T.tolist()
    assert sweep.x.tolist() == X.tolist()
    assert sweep.on.tolist() == P.tolist()
    assert (sweep.t_us.dtype, sweep.x.dtype, sweep.on.dtype) == (np.int64, np.uint16, np.uint8)
    assert sweep.geometry == Geometry(20, 16)
    assert sweep.roi == Roi(4, 2, 14, 10)
    assert [frame.t_us for frame in sweep.frames] == [0, 20000, 100000]
    assert sweep.frames[1].load().shape == (16, 20)
    assert sweep.bin_us == 1500


def test_the_truth_is_not_read(folder: Any) -> None:
    assert "12345" not in repr(read_sweep(folder))


def test_frames_can_be_left_out_or_chosen(folder: Any) -> None:
    assert read_sweep(folder, frames="none").frames == ()
    assert read_sweep(folder, frames="none").geometry == Geometry(20, 16)
    with pytest.raises(UsageError, match="no such folder"):
        read_sweep(folder, frames="elsewhere")
    (folder / "empty").mkdir()
    with pytest.raises(FormatError, match="no frames"):
        read_sweep(folder, frames="empty")


def test_a_matrix_and_an_archive_hold_the_same(tmp_path: Any, folder: Any) -> None:
    np.save(tmp_path / "matrix.npy", np.stack([T, X, Y, P], axis=1))
    np.savez(tmp_path / "events.npz", t=T, x=X, y=Y, p=2 * P - 1)
    for name in ("matrix.npy", "events.npz"):
        sweep = read_sweep(tmp_path / name)
        assert sweep.t_us.tolist() == T.tolist()
        assert sweep.on.tolist() == P.tolist()
        assert sweep.frames == ()
        assert sweep.roi == Roi(0, 0, sweep.geometry.width, sweep.geometry.height)


def test_the_sensor_is_not_as_large_as_the_record_is_long(tmp_path: Any) -> None:
    np.savez(tmp_path / "long.npz", t=T, x=X * 10, y=Y * 10, p=P)
    np.savez(tmp_path / "short.npz", t=T[:2], x=np.array([0, 188]), y=np.array([139, 20]), p=P[:2])
    assert read_sweep(tmp_path / "long.npz").geometry == read_sweep(tmp_path / "short.npz").geometry
    assert read_sweep(tmp_path / "long.npz", size=Geometry(250, 200)).geometry == Geometry(250, 200)


def test_stamps_that_step_back_are_sorted_and_reported(tmp_path: Any) -> None:
    np.savez(tmp_path / "back.npz", t=T[::-1], x=X[::-1], y=Y[::-1], p=P[::-1])
    sweep = read_sweep(tmp_path / "back.npz")
    assert sweep.t_us.tolist() == T.tolist()
    assert "stepped back" in sweep.warnings[0]


def test_a_clock_that_was_set_back_is_refused_with_the_place(tmp_path: Any) -> None:
    t_us = np.concatenate([np.arange(0, 40_000, 20), np.arange(5_000, 45_000, 20)])
    events = {"x": np.zeros(t_us.size), "y": np.zeros(t_us.size), "p": np.arange(t_us.size) % 2}
    np.savez(tmp_path / "reset.npz", t=t_us, **events)
    with pytest.raises(FormatError, match=r"set back 1 times .* by 34980 us after 2000 of 4000 events \(at 39980 us\)"):
        read_sweep(tmp_path / "reset.npz")
    # Packets that come late by less than a word of time, and files in no order at all, are sorted.
    late = np.arange(0, 80_000, 20)
    late[1000:1100] -= 3_000
    np.savez(tmp_path / "late.npz", t=late, **events)
    np.savez(tmp_path / "shuffled.npz", t=np.random.default_rng(1).permutation(t_us), **events)
    for name in ("late.npz", "shuffled.npz"):
        sweep = read_sweep(tmp_path / name)
        assert (np.diff(sweep.t_us) >= 0).all()
        assert "stepped back" in sweep.warnings[0]


@pytest.mark.parametrize(
    "line",
    [
        "ROI selected: (2, 12, 4, 18)",
        "ROI selected: [2, 12, 4, 18]",
        "roi = 2 12 4 18",
        "ROI selected: (2.0, 12.0, 4.0, 18.0)",
        "ROI selected: (np.int64(2), np.int64(12), np.int64(4), np.int64(18))\r",
    ],
)
def test_the_region_is_found_however_it_was_printed(folder: Any, line: Any) -> None:
    (folder / "info.txt").write_text(f"start_timestamp = 0\n{line}\ndelta_t = 1500\n")
    sweep = read_sweep(folder)
    assert sweep.roi == Roi(4, 2, 14, 10)
    assert sweep.bin_us == 1500
    assert sweep.warnings == ()


@pytest.mark.parametrize(
    ("line", "reason"), [("(2, 12, 4)", "not four numbers"), ("none", "not four"), ("(-2, 9, 4, 18)", "does not fit")]
)
def test_a_region_that_cannot_be_used_is_reported(folder: Any, line: Any, reason: Any) -> None:
    (folder / "info.txt").write_text(f"ROI selected: {line}\n")
    sweep = read_sweep(folder)
    assert sweep.roi == Roi(0, 0, 20, 16)
    assert reason in sweep.warnings[0]


def test_a_frame_is_named_by_its_time_whole_or_not(folder: Any) -> None:
    frames = folder / "davis_frames_50"
    (frames / "0020000.png").rename(frames / "20000.25.png")
    (frames / "0100000.png").rename(frames / "1.000000e+05.png")
    cv2.imwrite(str(frames / "mean.png"), np.zeros((16, 20), np.uint8))
    assert [frame.t_us for frame in read_sweep(folder).frames] == [0, 20001, 100000]


def test_frames_of_another_time_are_reported(folder: Any) -> None:
    np.save(folder / "event.npy", structured(t=T + 200_000))
    assert "none of the 3 frames (0 .. 100000 us)" in read_sweep(folder).warnings[0]
    np.save(folder / "event.npy", structured())
    assert read_sweep(folder).warnings == ()


def test_seconds_are_not_taken_for_microseconds(tmp_path: Any) -> None:
    t = np.linspace(0.0, 1.0, 1001)
    x = np.zeros(t.size, int)
    np.savez(tmp_path / "seconds.npz", t=t, x=x, y=x, p=x)
    with pytest.raises(FormatError, match="probably seconds"):
        read_sweep(tmp_path / "seconds.npz")
    np.savez(tmp_path / "fractions.npz", t=1e6 * t + 0.25, x=x, y=x, p=x)
    assert read_sweep(tmp_path / "fractions.npz").t_us[-1] == 1_000_000


def test_a_region_that_does_not_fit_is_reported_and_not_used(folder: Any) -> None:
    (folder / "info.txt").write_text("ROI selected: (0, 400, 0, 400)")
    sweep = read_sweep(folder)
    assert sweep.roi == Roi(0, 0, 20, 16)
    assert "does not fit" in sweep.warnings[0]


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: np.save(path, structured()[:0]), "no events"),
        (lambda path: np.save(path, np.zeros((3, 7))), "four columns"),
        (lambda path: np.save(path, structured(names=("a", "b", "c", "d"))), "are needed"),
        (lambda path: np.save(path, structured(x=np.array([0, 3, 200, 7]))), "outside"),
        (lambda path: np.save(path, np.array([[1.0, np.nan, 2.0, 0.0]])), "finite"),
        (lambda path: path.write_text("not numpy"), "not a numpy file"),
        (lambda path: path.write_bytes(b""), "not a numpy file"),
    ],
)
def test_bad_events_are_refused_with_a_reason(folder: Any, write: Any, message: Any) -> None:
    write(folder / "event.npy")
    with pytest.raises(FormatError, match=message):
        read_sweep(folder)


def test_what_is_no_sweep_is_refused(tmp_path: Any) -> None:
    with pytest.raises(UsageError, match="no such file"):
        read_sweep(tmp_path / "nothing")
    with pytest.raises(FormatError, match=r"no event\.npy"):
        read_sweep(tmp_path)
    (tmp_path / "notes.txt").write_text("hello, world, this is text")
    with pytest.raises(FormatError, match="no format"):
        read_sweep(tmp_path / "notes.txt")
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 and then nothing")
    with pytest.raises(FormatError, match=r"not an \.npz"):
        read_sweep(tmp_path / "broken.npz")
    np.savez(tmp_path / "half.npz", t=T, x=X)
    with pytest.raises(FormatError, match="y, p are missing"):
        read_sweep(tmp_path / "half.npz")
    np.savez(tmp_path / "ragged.npz", t=T, x=X, y=Y, p=P[:2])
    with pytest.raises(FormatError, match="differ in length"):
        read_sweep(tmp_path / "ragged.npz")
