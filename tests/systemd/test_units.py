"""The units as systemd itself reads and judges them, installed as they will be."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import booted
import pytest

if TYPE_CHECKING:
    from booted import Booted

pytestmark = pytest.mark.xdist_group("systemd")

SYSTEMD = Path(__file__).parents[2] / "systemd"
SERVICES = ("elpd.service", "elpd-web.service")
EXPOSURE_AT_MOST = 1.5


def test_systemd_has_nothing_to_complain_about(machine: Booted) -> None:
    done = machine("systemd-analyze", "verify", "--man=no", "elpd.service", "elpd.socket", "elpd-web.service")
    assert (done.stdout, done.stderr) == ("", "")


@pytest.mark.parametrize("wrong", ["Restrat=on-failure", "Type=notifi", "SystemCallFilter=@sytem"])
def test_a_typing_error_would_be_seen(machine: Booted, wrong: str) -> None:
    machine.write("/run/systemd/system/wrong.service", f"[Service]\nExecStart=/bin/true\n{wrong}\n")
    assert machine("systemd-analyze", "verify", "--man=no", "wrong.service", check=False).stderr != ""


@pytest.mark.parametrize("unit", SERVICES)
def test_exposure(unit: str) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd is not installed")
    told = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", SYSTEMD / unit],
        capture_output=True,
        text=True,
        check=False,
    ).stdout
    score = re.search(r"Overall exposure level for \S+: ([\d.]+)", told)
    assert score is not None, told
    assert float(score[1]) <= EXPOSURE_AT_MOST, told


@pytest.mark.parametrize("unit", SERVICES)
def test_whatever_hardening_is_left_out_has_its_reason(unit: str) -> None:
    text = (SYSTEMD / unit).read_text(encoding="utf-8")
    for name in ("MemoryDenyWriteExecute", "PrivateDevices", "PrivateNetwork", "PrivateUsers", "RestrictRealtime"):
        assert f"\n{name}=yes" in text or f"# {name}= stays off: " in text.replace("; ", "\n# "), name


def test_accounts_and_folders(machine: Booted) -> None:
    assert "elpd" in machine("id", "-nG", "elpd-web").stdout.split()
    told = machine("stat", "-c", "%n %U %G %a", "/etc/elpd", "/var/lib/elpd/runs", "/var/log/elpd").stdout
    assert told.splitlines() == [
        "/etc/elpd root root 755",
        "/var/lib/elpd/runs elpd elpd 750",
        "/var/log/elpd elpd elpd 750",
    ]


def test_udev_reads_the_rules(machine: Booted) -> None:
    if shutil.which("udevadm") is None:
        pytest.skip("udev is not installed")
    told = machine("udevadm", "test", "/sys/devices/virtual/tty/ptmx", check=False)
    lines = [line for line in (told.stdout + told.stderr).splitlines() if "70-elpd.rules" in line]
    assert lines == ["Reading rules file: /etc/udev/rules.d/70-elpd.rules"]


def test_a_booted_systemd_leaves_nothing_behind(machine: Booted) -> None:
    del machine  # skips where none can be booted
    mounts, cgroups = Path("/proc/mounts").read_bytes(), set(booted.cgroups().iterdir())
    with booted.Booted({}, {}) as other:
        assert other("cat", "/proc/1/comm").stdout == "systemd\n"
        assert set(booted.cgroups().iterdir()) > cgroups
        assert other.folder.exists()
    assert not other.folder.exists()
    assert Path("/proc/mounts").read_bytes() == mounts
    assert not any(other.folder.name in path.name for path in booted.cgroups().iterdir())
