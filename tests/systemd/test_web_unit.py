"""The page's unit: it serves, with its own account, and can touch nothing else."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from booted import Booted

pytestmark = pytest.mark.xdist_group("systemd")

ASK = """
import sys, urllib.request
with urllib.request.urlopen(sys.argv[1], timeout=10) as answer:
    print(answer.status, answer.headers["Content-Security-Policy"])
"""


@pytest.fixture(scope="module")
def web(machine: Booted) -> Iterator[Booted]:
    machine("ip", "link", "set", "lo", "up")
    machine("systemctl", "start", "elpd-web.service")
    machine.until(lambda: machine.journal("-u", "elpd-web", "_TRANSPORT=stdout"), "the page's address")
    yield machine
    machine("systemctl", "stop", "elpd-web.service", "elpd.socket", check=False)


def address(web: Booted) -> str:
    told = web.journal("-u", "elpd-web", "_TRANSPORT=stdout")[-1]["MESSAGE"]
    found = re.match(r"http://127\.0\.0\.1:\d+/", told)
    assert found is not None, told
    return found[0]


def test_the_page_is_served_and_the_token_is_in_no_journal(web: Booted) -> None:
    served = web("/opt/elpd/bin/python3", "-c", ASK, address(web)).stdout
    assert served.startswith("200 default-src 'self'")
    token = web("cat", "/var/lib/elpd-web/web.token").stdout.strip()
    assert len(token) >= 40
    assert token not in json.dumps(web.journal("-u", "elpd-web"))


def test_the_token_is_its_owners_alone(web: Booted) -> None:
    told = web("stat", "-c", "%U %a", "/var/lib/elpd-web", "/var/lib/elpd-web/web.token").stdout.splitlines()
    assert told == ["elpd-web 700", "elpd-web 600"]


def test_it_runs_as_its_own_user_in_the_group_that_may_operate(web: Booted) -> None:
    pid = web.show("elpd-web", "MainPID")["MainPID"]
    status = dict(
        line.split(":\t", 1) for line in web("cat", f"/proc/{pid}/status").stdout.splitlines() if ":\t" in line
    )
    group = web("getent", "group", "elpd").stdout.split(":")[2]
    assert status["Uid"].split()[0] == web("id", "-u", "elpd-web").stdout.strip()
    assert group in status["Groups"].split()
    assert int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
