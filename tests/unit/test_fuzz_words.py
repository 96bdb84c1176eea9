"""The fuzzing tool on a small scale, and that it would find something."""

from typing import Any

import fuzz_words
import numpy as np
import pytest

from elpd.records import Encoding


@pytest.mark.parametrize("encoding", list(fuzz_words.DTYPES))
def test_random_words_harm_no_kernel(encoding: Encoding) -> None:
    for seed, words in fuzz_words.random_streams(encoding, 2 * fuzz_words.PIECE, 7):
        assert fuzz_words.run(words, encoding, np.random.default_rng(seed)) > 0


def test_damaged_runs_of_vectors_and_counters_harm_no_kernel() -> None:
    phrase = [0x6001, 0x0005, 0x2003, 0x280F, 0x3010, 0x4FFF, 0x4001, 0x50F0, 0xE014, 0xF003, 0xF000, 0x7000]
    words = np.array([0x8001, *phrase * 3000], np.uint16)
    for seed, stretch in fuzz_words.damaged(words, 3, 11):
        assert fuzz_words.run(stretch, Encoding.EVT3, np.random.default_rng(seed)) > 10_000


def test_a_kernel_that_writes_beyond_its_arrays_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = fuzz_words.KERNELS[Encoding.EVT2][0][0]

    def overflowing(*arguments: Any) -> int:
        np.lib.stride_tricks.as_strided(arguments[7].reshape(-1), (arguments[7].size + 1,))[-1] = 5
        return int(honest(*arguments))

    monkeypatch.setitem(fuzz_words.KERNELS, Encoding.EVT2, [(overflowing, overflowing)])
    with pytest.raises(fuzz_words.Broken, match="guard"):
        fuzz_words.run(np.zeros(10, np.uint32), Encoding.EVT2, np.random.default_rng(1))


def test_kernels_that_differ_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    (plain, capped), *_ = fuzz_words.KERNELS[Encoding.EVT3]
    monkeypatch.setitem(fuzz_words.KERNELS, Encoding.EVT3, [(plain, capped), (plain, plain)])
    words = np.array([0x8001, 0x0005, *[0x2003] * 20], np.uint16)
    with pytest.raises(fuzz_words.Broken, match="rate cap differ"):
        fuzz_words.run(words, Encoding.EVT3, np.random.default_rng(1))
