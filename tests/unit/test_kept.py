"""What outlives the daemon: whole or not at all, whatever the disk does, and a copy of before for when it rots."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from elpd.errors import UsageError
from elpd.service import store
from elpd.service.kept import Kept
from elpd.service.messages import Preset, RoiBox

FIRST, SECOND = {"roi": None, "name": "first"}, {"roi": [1, 2], "name": "zwölf"}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "state.json"
    assert store.read(path) == (None, None)
    store.write(path, FIRST)
    store.write(path, SECOND)
    assert store.read(path) == (SECOND, None)
    assert sorted(one.name for one in path.parent.iterdir()) == ["state.json", "state.json.before"]


def test_a_file_cut_off_at_any_byte_falls_back_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    store.write(path, FIRST)
    store.write(path, SECOND)
    whole = path.read_bytes()
    for length in range(len(whole) - 1):  # the last byte is a newline, which nothing needs
        path.write_bytes(whole[:length])
        content, complaint = store.read(path)
        assert content == FIRST, length
        assert complaint is not None
        assert "copy of before" in complaint


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    store.write(path, FIRST)
    path.write_bytes(path.read_bytes().replace(b"first", b"fisrt"))
    assert store.read(path) == (
        None,
        f"{path}: damaged or cut off, and there is no good copy of before; defaults are used",
    )


def test_a_damaged_file_never_replaces_a_good_copy(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    store.write(path, FIRST)
    store.write(path, SECOND)
    path.write_bytes(b"\0" * 100)
    store.write(path, {"name": "third"})
    path.write_bytes(b"")
    assert store.read(path)[0] == FIRST


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_disk_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    path = tmp_path / "state.json"
    store.write(path, FIRST)

    def fail(*_: Any) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(*((os, "fsync") if call == "fsync" else (Path, "replace")), fail)
    with pytest.raises(OSError, match="Input/output error"):
        store.write(path, SECOND)
    monkeypatch.undo()
    assert store.read(path)[0] == FIRST
    assert [one.name for one in tmp_path.iterdir()] == ["state.json"]


def test_power_that_fails_between_the_renames_costs_the_newest_alone(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    store.write(path, FIRST)
    path.replace(store.before(path))
    content, complaint = store.read(path)
    assert content == FIRST
    assert complaint is not None
    assert "missing" in complaint


def test_presets_and_regions_are_kept(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    box = RoiBox(x=1, y=2, width=30, height=40)
    kept.save_preset(Preset(name="a", position_um=12.5, roi=box, approach=1, saved_at="2026-01-01T00:00:00Z"))
    kept.set_roi(box)
    kept.set_roi(box, "corner")
    kept.change(mode="continuous")
    kept.save()
    again = Kept(tmp_path)
    assert again.content == kept.content
    assert again.complaint is None
    with pytest.raises(UsageError, match="there are: a"):
        again.preset("b")
    with pytest.raises(UsageError, match="there are: corner"):
        again.delete_roi("b")


def test_a_file_of_a_newer_daemon_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    store.write(tmp_path / "service.json", {"mode": "manual", "colour": "blue"})
    assert Kept(tmp_path).content.mode == "manual"
    store.write(tmp_path / "service.json", {"mode": "dancing"})
    kept = Kept(tmp_path)
    assert kept.content.mode is None
    assert kept.complaint is not None


def test_nothing_is_written_where_nothing_has_changed(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.save()
    assert list(tmp_path.iterdir()) == []


def test_what_could_not_be_written_is_tried_again(tmp_path: Path) -> None:
    blocked = tmp_path / "state"
    blocked.write_text("a file where a folder should be")
    kept = Kept(blocked)
    kept.change(mode="manual")
    with pytest.raises(OSError):
        kept.save()
    blocked.unlink()
    kept.save()
    assert Kept(blocked).content.mode == "manual"
