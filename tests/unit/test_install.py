"""tools/install into a folder: everything in its place, nothing twice, nothing of the user's lost."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SYSTEMD = ROOT / "systemd"


@dataclass(frozen=True)
class Said:
    code: int
    out: str
    err: str


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "root"
    folder.mkdir()
    return folder


def install(root: Path, *options: str) -> Said:
    command = [sys.executable, ROOT / "tools" / "install", "--root", root, "--no-venv", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=dict(os.environ))
    assert "Traceback" not in done.stderr
    return Said(done.returncode, done.stdout, done.stderr)


def tree(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_everything_is_where_systemd_and_udev_look_for_it(root: Path) -> None:
    assert install(root).code == 0
    found = tree(root)
    for place, source in {
        "etc/systemd/system/elpd.service": "elpd.service",
        "etc/systemd/system/elpd.socket": "elpd.socket",
        "etc/systemd/system/elpd-web.service": "elpd-web.service",
        "etc/sysusers.d/elpd.conf": "elpd.sysusers",
        "etc/tmpfiles.d/elpd.conf": "elpd.tmpfiles",
        "etc/udev/rules.d/70-elpd.rules": "70-elpd.rules",
    }.items():
        assert found[place] == (SYSTEMD / source).read_bytes()
        assert (root / place).stat().st_mode & 0o777 == 0o644
    assert found["etc/elpd/elpd.toml"] == (ROOT / "config" / "elpd.toml").read_bytes()


def test_every_unit_and_rule_of_the_folder_is_installed(root: Path) -> None:
    install(root)
    assert {path.read_bytes() for path in SYSTEMD.iterdir()} <= set(tree(root).values())


def test_a_second_time_changes_nothing_and_says_so(root: Path) -> None:
    install(root)
    before = {
        path: path.stat().st_mtime_ns for path in root.rglob("*") if path.is_file() and path.name != "installed.json"
    }
    again = install(root)
    assert again.out.count("  same  ") == len(before)
    assert not any(word in again.out for word in ("  write  ", "  replace", "  remove"))
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_dry_run_says_what_it_would_do_and_does_nothing(root: Path) -> None:
    told = install(root, "--dry-run")
    assert told.code == 0
    assert "/etc/systemd/system/elpd.service" in told.out
    assert list(root.iterdir()) == []
    assert [line for line in install(root).out.splitlines() if line.startswith("  write")] == [
        line for line in told.out.splitlines() if line.startswith("  write")
    ]


def test_an_edited_configuration_is_kept_and_the_new_one_is_beside_it(root: Path) -> None:
    install(root)
    config = root / "etc/elpd/elpd.toml"
    config.write_text('rig = "hardware"\n', encoding="utf-8")
    for _ in range(2):
        told = install(root, "--config", str(ROOT / "config" / "sim.toml"))
        assert "it was edited" in told.out
        assert config.read_text(encoding="utf-8") == 'rig = "hardware"\n'
        assert (root / "etc/elpd/elpd.toml.new").read_bytes() == (ROOT / "config" / "sim.toml").read_bytes()


def test_a_configuration_that_nobody_edited_follows_the_program(root: Path) -> None:
    install(root)
    install(root, "--config", str(ROOT / "config" / "sim.toml"))
    assert (root / "etc/elpd/elpd.toml").read_bytes() == (ROOT / "config" / "sim.toml").read_bytes()
    assert not (root / "etc/elpd/elpd.toml.new").exists()


def test_a_configuration_from_before_is_taken_for_edited(root: Path) -> None:
    (root / "etc/elpd").mkdir(parents=True)
    (root / "etc/elpd/elpd.toml").write_text("# mine\n", encoding="utf-8")
    assert install(root).code == 0
    assert (root / "etc/elpd/elpd.toml").read_text(encoding="utf-8") == "# mine\n"


def filled(root: Path) -> Path:
    install(root)
    recording = root / "var/lib/elpd/runs/one/events.raw"
    recording.parent.mkdir(parents=True)
    recording.write_bytes(b"precious")
    (root / "etc/systemd/system/other.service").touch()
    return recording


def test_uninstalling_leaves_configuration_and_recordings(root: Path) -> None:
    recording = filled(root)
    told = install(root, "--uninstall")
    assert told.code == 0
    assert set(tree(root)) == {
        "etc/elpd/elpd.toml", "etc/systemd/system/other.service", str(recording.relative_to(root)),
    }  # fmt: skip
    assert "kept: /etc/elpd, /var/lib/elpd" in told.out


def test_purging_leaves_nothing_of_ours(root: Path) -> None:
    filled(root)
    assert install(root, "--uninstall", "--purge").code == 0
    assert set(tree(root)) == {"etc/systemd/system/other.service"}


def test_uninstalling_dry_leaves_all(root: Path) -> None:
    filled(root)
    before = tree(root)
    assert install(root, "--uninstall", "--purge", "--dry-run").code == 0
    assert tree(root) == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--uninstall",), "nothing to uninstall"),
        (("--config", "/nowhere.toml"), "/nowhere.toml"),
        (("--lens", "/dev/ttyNOWHERE"), "no such port"),
        (("--purge",), "--uninstall"),
    ],
)
def test_what_cannot_be_done_is_refused_and_nothing_is_written(
    root: Path, options: tuple[str, ...], words: str
) -> None:
    told = install(root, *options)
    assert told.code == 2
    assert words in told.err
    assert tree(root) == {}
