from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from elpd.cli import check, inspection
from elpd.cli.inspection import Finding, Status

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install somebody else's package, with drivers that break in several ways."""
    info = tmp_path / "strange_lens-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: strange-lens\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(
        "[elpd.lenses]\n"
        "strange_absent = strange_absent:open_lens\n"
        "strange_broken = strange_broken:open_lens\n"
        "strange_exits = strange_exits:open_lens\n"
        "strange_good = strange_good:open_lens\n"
        "[elpd.discovery]\n"
        "strange = strange_good:look\n"
        "strange_blind = strange_good:refuse\n"
    )
    (tmp_path / "strange_broken.py").write_text("raise RuntimeError('firmware of another century')\n")
    (tmp_path / "strange_exits.py").write_text("raise SystemExit(3)\n")
    (tmp_path / "strange_good.py").write_text(
        "from elpd.ports import FoundDevice\n"
        "def open_lens(settings, clock): ...\n"
        "def look(): return [FoundDevice('lens', 'Strange', '/dev/strange0'),\n"
        "                    FoundDevice('lens', 'Locked', '/dev/strange1', 'unlock it')]\n"
        "def refuse(): raise OSError(5, 'no bus')\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def by_name(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.name: finding for finding in findings}


@pytest.mark.usefixtures("stranger")
def test_a_broken_driver_is_named_with_its_reason_and_breaks_nothing_else() -> None:
    found = by_name(inspection.drivers(("elpd.lenses",)))
    assert found["lenses: strange_good"].status is Status.OK
    assert found["lenses: strange_absent"].data["error"] == "ModuleNotFoundError: No module named 'strange_absent'"
    assert found["lenses: strange_exits"].data["error"] == "SystemExit: 3"
    broken = found["lenses: strange_broken"]
    assert broken.status is Status.NOTE
    assert broken.found == "RuntimeError: firmware of another century (strange-lens 1.2)"
    assert broken.next_step is not None
    assert "import strange_broken" in broken.next_step


@pytest.mark.usefixtures("stranger")
def test_what_is_plugged_in_comes_through_the_discoveries() -> None:
    found = [finding for finding in inspection.devices() if "strange" in finding.found or "strange" in finding.name]
    assert [(finding.status, finding.found, finding.next_step) for finding in found] == [
        (Status.OK, "/dev/strange0  Strange", None),
        (Status.PROBLEM, "/dev/strange1  Locked", "unlock it"),
        (Status.NOTE, "cannot look: [Errno 5] no bus", None),
    ]


def test_every_kernel_of_the_rooms_is_counted() -> None:
    compiled, cache = inspection.kernels()
    assert compiled.status is Status.OK
    assert compiled.data["seconds"] >= 0.0
    assert cache.name == "cache"


def test_trying_for_privileges_leaves_the_scheduler_as_it_was() -> None:
    before = os.sched_getscheduler(0)
    findings = inspection.real_time()
    assert [finding.name for finding in findings] == ["SCHED_FIFO", "mlockall"]
    assert all(finding.status is not Status.PROBLEM for finding in findings)
    assert all((finding.next_step is None) == finding.data["allowed"] for finding in findings)
    assert os.sched_getscheduler(0) == before


def test_a_refused_privilege_says_what_it_costs() -> None:
    finding = inspection._privilege("SCHED_FIFO", lambda: "Operation not permitted", "allow rtprio")
    assert finding.found == "not allowed (Operation not permitted)"
    assert finding.next_step == "allow rtprio"


def test_a_configuration_is_read_and_its_drivers_looked_up(tmp_path: Path) -> None:
    good = tmp_path / "good.toml"
    good.write_text('rig = "sim"\n')
    assert inspection.configuration(good, ()).found == 'valid, rig = "sim"'
    good.write_text('rig = "sim"\n[focus]\ndeadlin_ms = 1\n')
    wrong = inspection.configuration(good, ())
    assert wrong.status is Status.PROBLEM
    assert "good.toml:3: focus.deadlin_ms: unknown key" in wrong.found
    absent = inspection.configuration(None, ("lens.driver=steam",))
    assert absent.status is Status.PROBLEM
    assert absent.found.startswith("lens.driver is 'steam'; installed: ")


RESULT = {"outcome": "FOCUSED", "reason": "", "duration_ms": 412.4, "truth": {"final_error_um": -0.31}}


def test_the_self_test_passes_only_in_focus() -> None:
    good = inspection.self_test(lambda: RESULT)
    assert good.status is Status.OK
    assert good.found.startswith("FOCUSED in 412 ms of simulated time, 0.31 um from true focus (")
    lost = inspection.self_test(lambda: {**RESULT, "outcome": "NO_CROSSING", "reason": "nothing seen"})
    assert (lost.status, lost.found) == (Status.PROBLEM, "NO_CROSSING: nothing seen")

    def broken() -> dict[str, Any]:
        raise ZeroDivisionError("of course")

    assert inspection.self_test(broken).found == "ZeroDivisionError: of course"


@pytest.mark.parametrize(
    ("sections", "code"),
    [
        ((), 0),
        (("drivers", "devices"), 0),
        (("configuration",), 2),
        (("configuration", "self-test"), 3),
        (("kernels",), 3),
    ],
)
def test_exit_codes(sections: tuple[str, ...], code: int) -> None:
    findings = [Finding(section, "x", Status.PROBLEM, "broken") for section in sections]
    assert check.exit_code([Finding("versions", "elpd", Status.OK, "1"), *findings]) == code


@pytest.mark.usefixtures("stranger")
def test_the_command_answers_people_and_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inspection, "focus_simulated", lambda: RESULT)
    told = CliRunner().invoke(check.command, [], standalone_mode=False)
    assert told.return_value == 0
    assert "\x1b" not in told.stdout
    lines = told.stdout.splitlines()
    width = lines[1].index("0.1.0")
    answers = [line for line in lines if line[:9] in {"  ok     ", "  note   ", "  problem"}]
    assert len(answers) > 10
    assert all(line[width - 2 : width] == "  " and line[width] != " " for line in answers)
    assert any(line.strip().startswith("-> install what it needs") for line in lines)

    answer = json.loads(CliRunner().invoke(check.command, ["--json"], standalone_mode=False).stdout)
    assert answer["ok"] is True
    assert answer["self_test"][0]["outcome"] == "FOCUSED"
    broken = next(item for item in answer["drivers"] if item["driver"] == "strange_broken")
    assert broken["error"] == "RuntimeError: firmware of another century"


def test_what_is_to_be_typed_is_printed_whole(capsys: pytest.CaptureFixture[str]) -> None:
    line = "echo '" + ", ".join(f'ATTRS{{word{k}}}=="{k}"' for k in range(12)) + "' | sudo tee /etc/a.rules"
    step = f"{'no permission to open it ' * 8}: type this:\n{line}"
    check.tell([Finding("devices", "camera", Status.PROBLEM, "/dev/x", step)])
    told = capsys.readouterr().out.splitlines()
    assert told[-1].strip() == line
    assert len(told) > 5
    assert all(len(one) <= 120 for one in told[:-1])
