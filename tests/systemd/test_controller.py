"""The controller under its unit, a simulated Tic on a pty as its lens: what systemd gives it, and takes away."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterator

    from booted import Booted

pytestmark = pytest.mark.xdist_group("systemd")

CONFIG = """
rig = "hardware"
[camera]
driver = "quiet"
[lens]
driver = "sticky"
port = "{port}"
min_um = 0.0
max_um = 16000.0
speed_um_s = 800.0
watchdog_ms = 60000
reply_ms = 2000
"""
"""A long way, so that there is time to be killed on. The board's own dead-man is put off: it cannot have been that.
Replies may be late, because the board is a process among many."""

CAP_SYS_RESOURCE = 1 << 24

CLIENT = """
import json, socket, sys
with socket.socket(socket.AF_UNIX) as link:
    link.connect("/run/elpd/elpd.sock")
    link.sendall(json.dumps({"id": 1, "method": sys.argv[1], "params": json.loads(sys.argv[2])}).encode() + b"\\n")
    print(link.makefile().readline(), end="", flush=True)
"""


class Controller:
    """The unit, and the lens board beside it."""

    def __init__(self, machine: Booted) -> None:
        self.machine = machine
        board = (
            "/opt/elpd/bin/elpd",
            "sim-board",
            "tic",
            "--json",
            "--set",
            "board.travel_um=16000",
            "--set",
            "board.start_um=500",
        )
        properties = ("User=elpd", "CPUSchedulingPolicy=rr", "CPUSchedulingPriority=1")
        machine("systemd-run", "--unit=lens", *(f"--property={each}" for each in properties), *board)
        told = machine.until(lambda: machine.journal("-u", "lens", "_TRANSPORT=stdout"), "the board's port")
        self.port = json.loads(told[0]["MESSAGE"])["port"]
        self.configure(CONFIG.format(port=self.port))

    def configure(self, text: str) -> None:
        self.machine.write("/etc/elpd/elpd.toml", text)

    def client(self, method: str, user: str = "root", **params: Any) -> subprocess.Popen[str]:
        return self.machine.popen(
            "runuser", "-u", user, "--", "/opt/elpd/bin/python3", "-c", CLIENT, method, json.dumps(params)
        )

    def call(self, method: str, user: str = "root", **params: Any) -> dict[str, Any]:
        told, _ = self.client(method, user, **params).communicate(timeout=120)
        answer: dict[str, Any] = json.loads(told)
        return answer

    def status(self) -> dict[str, Any]:
        status: dict[str, Any] = self.call("status")["result"]
        return status

    def show(self, *properties: str) -> list[str]:
        found = self.machine.show("elpd", *properties)
        return [found[name] for name in properties]

    def journal(self, *matches: str) -> list[dict[str, Any]]:
        return self.machine.journal("-u", "elpd", *matches)

    def ready(self) -> None:
        """Run as configured, the lens homed."""
        text = CONFIG.format(port=self.port)
        as_configured = self.machine("cat", "/etc/elpd/elpd.toml").stdout == text
        if not as_configured or self.show("ActiveState") != ["active"]:
            self.machine("systemctl", "reset-failed", "elpd.service", "elpd.socket", check=False)
            self.configure(text)
            self.machine("systemctl", "restart", "elpd")
        if not self.status()["lens"]["referenced"]:
            answer = self.call("home")
            assert "result" in answer, answer

    def resting(self) -> dict[str, Any]:
        """Return the lens once it is known to be at rest."""

        def lens() -> dict[str, Any] | None:
            found: dict[str, Any] = self.status()["lens"]
            return found if found["moving"] is False else None

        at_rest: dict[str, Any] = self.machine.until(lens, "the lens to rest")
        return at_rest

    def moving(self) -> subprocess.Popen[str]:
        """Return the request of a long move that is on its way."""
        asked = self.client("move", to_um=15900.0)
        self.machine.until(lambda: self.status()["lens"]["moving"], "the lens to move")
        return asked


@pytest.fixture(scope="module")
def started(machine: Booted) -> Iterator[Controller]:
    machine("useradd", "--groups", "elpd", "member")
    machine("useradd", "stranger")
    controller = Controller(machine)
    yield controller
    machine("systemctl", "stop", "elpd", "lens")


@pytest.fixture
def controller(started: Controller) -> Controller:
    started.ready()
    return started


def test_it_says_when_it_is_ready_and_what_it_does(controller: Controller) -> None:
    state, text, kind = controller.show("ActiveState", "StatusText", "Type")
    assert (state, kind) == ("active", "notify")
    assert text.startswith("READY")
    (opened, *_) = controller.journal("ELPD_EVENT=rig open")
    assert (opened["PRIORITY"], opened["SYSLOG_IDENTIFIER"]) == ("6", "elpd")
    assert opened["ELPD_NEEDS_HOME"] in {"true", "false"}
    lines = [json.loads(line) for line in controller.machine("cat", "/var/log/elpd/elpd.jsonl").stdout.splitlines()]
    assert {"rig open", "kernels ready"} <= {line["event"] for line in lines}
    assert int(opened["ELPD_MONOTONIC_NS"]) in {line["monotonic_ns"] for line in lines}


def test_who_may_open_the_socket_and_operate(controller: Controller) -> None:
    assert controller.call("hello", "member")["result"]["role"] == "operate"
    assert controller.call("hello", "elpd-web")["result"]["role"] == "operate"
    refused = controller.machine(
        "runuser", "-u", "stranger", "--", "/opt/elpd/bin/python3", "-c", CLIENT, "hello", "{}", check=False
    )
    assert "PermissionError" in refused.stderr
    controller.machine("chmod", "666", "/run/elpd/elpd.sock")
    try:
        assert controller.call("hello", "stranger")["result"]["role"] == "observe"
        assert controller.call("move", "stranger", to_um=10.0)["error"]["kind"] == "Forbidden"
    finally:
        controller.machine("chmod", "660", "/run/elpd/elpd.sock")


def test_the_lens_is_driven_from_inside_the_sandbox(controller: Controller) -> None:
    was_um = controller.status()["lens"]["position_um"]
    answer = controller.call("jog", "member", by_um=25.0)["result"]
    assert answer["position_um"] == pytest.approx(was_um + 25.0, abs=0.5)


def proc_status(machine: Booted, pid: str) -> dict[str, str]:
    lines = machine("cat", f"/proc/{pid}/status").stdout.splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def test_the_focus_thread_is_urgent_and_its_memory_stays_where_that_may_be(controller: Controller) -> None:
    (pid,) = controller.show("MainPID")
    threads = controller.machine("ps", "-L", "-o", "cls=,rtprio=", "-p", pid).stdout.splitlines()
    process, systemd = (proc_status(controller.machine, number) for number in (pid, "1"))
    warned = any(warned["code"] == "not-real-time" for warned in controller.status()["warnings"])
    if int(systemd["CapEff"], 16) & CAP_SYS_RESOURCE:
        assert [thread.split() for thread in threads].count(["FF", "10"]) == 1
        assert int(process["VmLck"].split()[0]) > 0
        assert not warned
    else:  # nobody here gets what LimitRTPRIO= and LimitMEMLOCK= ask for: then it works all the same, and says so
        assert not any("FF" in thread for thread in threads)
        assert warned


def test_nothing_else_is_in_its_reach(controller: Controller) -> None:
    (pid,) = controller.show("MainPID")
    inside = ("nsenter", "-t", pid, "-m", "-n")
    for place in ("/etc/elpd", "/opt/elpd", "/usr", "/opt/source"):
        touched = controller.machine(*inside, "touch", f"{place}/x", check=False)
        assert "Read-only file system" in touched.stderr, place
    assert controller.machine(*inside, "sh", "-c", "ls /home /root 2>&1", check=False).stdout.strip() in {
        "/home:\n\n/root:",
        "/home:\n/root:",
    }
    links = controller.machine("nsenter", "-t", pid, "-n", "ip", "-oneline", "link").stdout.splitlines()
    assert [link.split()[1] for link in links] == ["lo:"]


def test_killed_in_mid_move_the_lens_is_stopped_and_nothing_moves_after(controller: Controller) -> None:
    restarts = int(controller.show("NRestarts")[0])
    begun = len(controller.journal("ELPD_EVENT=rig open"))
    asked = controller.moving()
    controller.machine("systemctl", "kill", "--signal=KILL", "--kill-whom=main", "elpd")
    controller.machine.until(lambda: len(controller.journal("ELPD_EVENT=rig open")) > begun, "the controller's return")
    asked.communicate(timeout=120)
    assert int(controller.show("NRestarts")[0]) > restarts
    assert any("at rest" in line["MESSAGE"] for line in controller.journal("_TRANSPORT=stdout"))
    lens = controller.resting()
    assert not lens["referenced"]
    assert lens["position_um"] < 15000.0
    refused = controller.call("move", to_um=100.0)
    assert refused["error"]["kind"] == "Unreferenced"
    assert controller.status()["lens"]["position_um"] == lens["position_um"]
    assert "result" in controller.call("home")


def test_a_hang_ends_in_a_traceback_that_names_it_and_a_restart(controller: Controller) -> None:
    begun = len(controller.journal("ELPD_EVENT=rig open"))
    asked = controller.moving()
    controller.machine.write("/run/elpd/hang", controller.show("MainPID")[0])
    controller.machine.until(lambda: controller.journal("ELPD_EVENT=focus thread hangs"), "the supervisor's stop")
    restarts = int(controller.show("NRestarts")[0])
    controller.machine.until(lambda: int(controller.show("NRestarts")[0]) > restarts, "the watchdog")
    controller.machine.until(lambda: len(controller.journal("ELPD_EVENT=rig open")) > begun, "the controller's return")
    told = "\n".join(line["MESSAGE"] for line in controller.journal("_TRANSPORT=stdout"))
    assert "Fatal Python error: Aborted" in told
    assert "in hang_where_nobody_expects_it" in told
    asked.communicate(timeout=120)
    lens = controller.resting()
    assert not lens["referenced"]
    assert lens["position_um"] < 15000.0


def test_a_process_that_is_frozen_in_mid_move_is_ended_and_the_lens_stopped(controller: Controller) -> None:
    restarts, begun = int(controller.show("NRestarts")[0]), len(controller.journal("ELPD_EVENT=rig open"))
    asked = controller.moving()
    controller.machine("systemctl", "kill", "--signal=STOP", "--kill-whom=main", "elpd")  # and no SIGCONT
    controller.machine.until(lambda: int(controller.show("NRestarts")[0]) > restarts, "the watchdog")
    controller.machine.until(lambda: len(controller.journal("ELPD_EVENT=rig open")) > begun, "the controller's return")
    asked.communicate(timeout=120)
    lens = controller.resting()
    assert not lens["referenced"]
    assert lens["position_um"] < 15000.0
    assert [warned["code"] for warned in controller.status()["warnings"]].count("ended-badly") == 1


def test_out_of_memory_in_mid_move_is_a_clean_restart(controller: Controller) -> None:
    begun = len(controller.journal("ELPD_EVENT=rig open"))
    asked = controller.moving()
    with controller.machine.starved("elpd.service") as killed:
        hungry = [controller.client("runs", limit=20) for _ in range(8)]  # connections and answers need new pages
        controller.machine.until(killed, "the kernel's out-of-memory killer")
    for client in hungry:
        client.communicate(timeout=120)
    controller.machine.until(lambda: len(controller.journal("ELPD_EVENT=rig open")) > begun, "the controller's return")
    asked.communicate(timeout=120)
    assert any("at rest" in line["MESSAGE"] for line in controller.journal("_TRANSPORT=stdout"))
    lens = controller.resting()
    assert not lens["referenced"]
    assert lens["position_um"] < 15000.0
    assert controller.call("move", to_um=100.0)["error"]["kind"] == "Unreferenced"
    assert "result" in controller.call("home")


def test_a_configuration_that_is_wrong_is_refused_and_the_old_one_stays(controller: Controller) -> None:
    (pid,) = controller.show("MainPID")
    limits = controller.status()["lens"]["limits_um"]
    text = CONFIG.format(port=controller.port)
    controller.configure(text.replace("speed_um_s", "sped_um_s_") + "[focus]\ndeadlin_ms = 3\n")
    controller.machine("systemctl", "reload", "elpd")
    (refused, *_) = controller.machine.until(
        lambda: controller.journal("PRIORITY=4", "ELPD_EVENT=configuration refused, the old one stays"), "the refusal"
    )
    assert "/etc/elpd/elpd.toml:14: focus.deadlin_ms: unknown key" in refused["ELPD_REASON"]
    assert any(warned["code"] == "config-refused" for warned in controller.status()["warnings"])
    assert controller.status()["lens"]["limits_um"] == limits
    controller.configure(text.replace("max_um = 16000.0", "max_um = 15000.0"))
    controller.machine("systemctl", "reload", "elpd")
    controller.machine.until(lambda: controller.journal("ELPD_EVENT=configuration reloaded"), "the new configuration")
    controller.machine.until(lambda: controller.status()["lens"]["limits_um"] == [0.0, 15000.0], "the new limits")
    assert controller.show("MainPID", "ActiveState") == [pid, "active"]


def test_a_wrong_configuration_at_the_start_ends_it_once_with_the_line(controller: Controller) -> None:
    where_um = controller.status()["lens"]["position_um"]
    controller.configure("rig = 'hardware'\nrg = 1\n")
    controller.machine("systemctl", "restart", "elpd", check=False)
    assert controller.show("ActiveState", "Result", "NRestarts", "ExecMainStatus") == ["failed", "exit-code", "0", "2"]
    assert any("/etc/elpd/elpd.toml:2: rg: unknown key" in line["MESSAGE"] for line in controller.journal())
    controller.ready()
    assert controller.status()["lens"]["position_um"] == where_um


def test_the_lens_is_stopped_by_the_configuration_in_force_not_by_what_is_on_disk_since(controller: Controller) -> None:
    asked = controller.moving()
    controller.configure("rig = 'hardware'\nrg = 1\n")
    controller.machine("systemctl", "kill", "--signal=KILL", "--kill-whom=main", "elpd")
    controller.machine.until(lambda: controller.show("ActiveState") == ["failed"], "the wrong configuration's end")
    asked.communicate(timeout=120)
    controller.ready()
    assert any("at rest at" in line["MESSAGE"] for line in controller.journal("_TRANSPORT=stdout"))
    assert controller.status()["lens"]["position_um"] < 15000.0


def test_a_crash_loop_ends_and_the_lens_is_left_alone(controller: Controller) -> None:
    machine, folder = controller.machine, "/run/systemd/system/elpd.service.d"
    where_um = controller.status()["lens"]["position_um"]
    machine("mkdir", "-p", folder)
    crash = "[Service]\nExecStart=\nExecStart=/bin/sh -c 'kill -SEGV $$$$'\nRestartSec=10ms\n"
    machine.write(f"{folder}/crash.conf", crash)
    try:
        machine("systemctl", "daemon-reload")
        machine("systemctl", "restart", "elpd", check=False)
        machine.until(lambda: controller.show("ActiveState") == ["failed"], "the end of the loop")
        assert controller.show("Result", "NRestarts") == ["signal", "5"]
    finally:
        machine("rm", "-r", folder)
        machine("systemctl", "daemon-reload")
    controller.ready()
    assert controller.status()["lens"]["position_um"] == where_um


def test_stopping_closes_the_socket_and_nothing_starts_it_again(controller: Controller) -> None:
    controller.machine("systemctl", "stop", "elpd")
    refused = controller.client("hello")
    assert refused.communicate(timeout=120)[0] == ""
    assert refused.returncode != 0
    assert controller.show("ActiveState", "Result") == ["inactive", "success"]
    assert controller.machine.show("elpd.socket", "ActiveState") == {"ActiveState": "inactive"}


def test_kernels_are_kept_where_the_rest_is_read_only(controller: Controller) -> None:
    listed = ("find", "/var/cache/elpd/numba", "-name", "evt2.decode_*.nbc", "-printf", "%u %p\\n")
    kept = [line.split()[1] for line in controller.machine(*listed).stdout.splitlines()]
    controller.machine("rm", *kept)  # of older sources too, where the tests have run before
    controller.machine("systemctl", "restart", "elpd")
    before = controller.machine(*listed).stdout.splitlines()
    assert all(line.startswith("elpd ") for line in before)
    gone, damaged = (line.split()[1] for line in before[:2])
    controller.machine("rm", gone)
    controller.machine.write(damaged, "garbage")
    controller.machine("systemctl", "restart", "elpd")
    assert sorted(controller.machine(*listed).stdout.splitlines()) == sorted(before)
    assert controller.machine("stat", "--format=%s", damaged).stdout != f"{len('garbage')}\n"
    (told,) = {line["ELPD_KERNEL"] for line in controller.journal("ELPD_EVENT=damaged kernel made anew")}
    assert told.rpartition(".")[2] in {"decode_evt2", "decode_evt21"}
    assert controller.show("ActiveState") == ["active"]
