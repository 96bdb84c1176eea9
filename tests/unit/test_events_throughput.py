"""The throughput tool as a program: its JSON is read by others. Speeds are printed, never asserted."""

import json
import subprocess
import sys
from pathlib import Path

from shared import RECORDINGS, needs_shared

TOOL = Path(__file__).parents[2] / "tools/throughput.py"
RATIOS = {
    "fused_simd_vs_best_peer_decode",
    "fused_scalar_vs_best_peer_decode",
    "fused_simd_vs_numpy_event_frame",
    "decode_vs_best_peer",
}


@needs_shared
def test_json_has_rows_and_ratios_or_the_reason_why_not() -> None:
    command = [sys.executable, TOOL, RECORDINGS / "gen41_dense_vectors.raw", "--json", "--rounds", "1", "--mb", "1"]
    answer = json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    assert {"name", "file", "mb_s", "mev_s"} == set(answer["rows"][0])
    assert set(answer["ratios"]) >= RATIOS
    assert all(ratio is not None or answer["reasons"][name] for name, ratio in answer["ratios"].items())


@needs_shared
def test_what_the_peers_cannot_read_is_refused() -> None:
    command = [sys.executable, TOOL, RECORDINGS / "gen3_evt2.raw", "--json"]
    ended = subprocess.run(command, capture_output=True, check=False, text=True)
    assert ended.returncode == 2
    assert json.loads(ended.stdout)["error"]["kind"] == "UsageError"
