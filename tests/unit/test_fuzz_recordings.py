"""The tool that damages recordings, on a small scale, and that it would find something."""

import fuzz_recordings
import numpy as np
import pytest
from fuzz_words import Broken
from streams import evt3_stream

from elpd.records import Encoding

CONTENT = evt3_stream(3, 9000, 1280, 720).tobytes()


def test_damaged_bytes_harm_nothing() -> None:
    bench = fuzz_recordings.Bench(Encoding.EVT3)
    for seed in range(10):
        bench.feed(fuzz_recordings.mutated(CONTENT, np.random.default_rng(seed)), np.random.default_rng(seed))
    bench.check_guards()
    assert bench.words > 30_000
    assert bench.events > 1000


def test_an_event_that_is_not_counted_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = fuzz_recordings.Bench(Encoding.EVT3)
    monkeypatch.setattr(bench, "_counted", np.ones((2, 3), np.int64))
    with pytest.raises(Broken, match="counted"):
        bench.feed(CONTENT, np.random.default_rng(1))
