"""The latency bench measures what it says; how long it takes is nobody's business here."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import latency

if TYPE_CHECKING:
    import pytest


def test_it_prints_both_tables_whole(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["latency.py", "--json", "--stops", "3", "--packets", "5", "--words", "200"])
    assert latency.main() == 0
    answer = json.loads(capsys.readouterr().out)
    ordinary = [row for row in answer["stops"] if not row["privileged"]]
    assert [row["condition"] for row in ordinary] == list(latency.CONDITIONS)
    for row in answer["stops"]:
        assert 0 < row["call_to_written_p50_us"] <= row["call_to_written_max_us"]
    for row in answer["reactions"]:
        assert 0 < row["own_p50_us"] <= row["sent_max_us"]
