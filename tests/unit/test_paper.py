"""The published method, rule by rule, with its oddities."""

from typing import Any

import cv2
import numpy as np
import pytest

from elpd.records import Roi
from elpd.vision.paper import (
    EVK4,
    SYNTHETIC_MANY_FRAMES,
    SYNTHETIC_ONE_FRAME,
    PaperDetector,
    elp_of_bin,
    filter_of_the_code,
    filter_of_the_paper,
    paper_laplacian,
)

ROI = Roi(2, 2, 6, 6)
IMAGE = np.random.default_rng(0).integers(0, 255, (10, 10)).astype(np.uint8)


def test_the_laplacian_is_of_the_whole_median_frame_then_cut() -> None:
    table = paper_laplacian(IMAGE, ROI)
    smooth = cv2.medianBlur(IMAGE, 3).astype(float)
    assert table[4, 5] == smooth[3, 5] + smooth[5, 5] + smooth[4, 4] + smooth[4, 6] - 4 * smooth[4, 5]
    assert not table[:2].any()
    assert not table[:, 8:].any()


def test_deep_images_are_read_as_eight_bit() -> None:
    np.testing.assert_array_equal(paper_laplacian(IMAGE.astype(np.uint16) * 257, ROI), paper_laplacian(IMAGE, ROI))


def columns(rows: Any) -> Any:
    x, y, on = (np.array(column) for column in zip(*rows, strict=True))
    return x.astype(np.uint16), y.astype(np.uint16), on.astype(np.uint8)


def test_normalised_bins_count_events_outside_the_region_in_the_divisor() -> None:
    table = paper_laplacian(IMAGE, ROI)
    inside, outside = (4, 4, 0), (0, 0, 1)
    alone = elp_of_bin(*columns([inside]), table, SYNTHETIC_MANY_FRAMES, ROI)
    diluted = elp_of_bin(*columns([inside, outside, outside, outside]), table, SYNTHETIC_MANY_FRAMES, ROI)
    assert alone == pytest.approx(table[4, 4])
    assert diluted == pytest.approx(table[4, 4] / 4)


def test_evk4_bins_are_raw_sums_of_ten_events_in_the_region_or_more() -> None:
    table = paper_laplacian(IMAGE, ROI)
    assert elp_of_bin(*columns([(4, 4, 1)] * 9 + [(0, 0, 1)] * 5), table, EVK4, ROI) is None
    assert elp_of_bin(*columns([(4, 4, 1)] * 10), table, EVK4, ROI) == pytest.approx(-10 * table[4, 4])


def test_counts_wrap_at_eight_bits() -> None:
    table = paper_laplacian(IMAGE, ROI)
    wrapped = elp_of_bin(*columns([(4, 4, 0)] * 260), table, EVK4, ROI)
    assert wrapped == pytest.approx(4 * table[4, 4])


def test_an_empty_bin_is_skipped() -> None:
    nothing = (np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8))
    assert elp_of_bin(*nothing, paper_laplacian(IMAGE, ROI), SYNTHETIC_MANY_FRAMES, ROI) is None


def test_the_codes_filter_mixes_with_its_own_past_and_the_papers_with_the_mean() -> None:
    assert filter_of_the_code([5.0], None) == 5.0
    assert filter_of_the_code([5.0, 10.0], 5.0) == pytest.approx(0.4 * 10 + 0.6 * 5)
    assert filter_of_the_code([0.0, 3e5], 0.0) == 3e5
    assert filter_of_the_paper([4.0, 10.0], 0.4, 100.0) == pytest.approx(0.4 * 10 + 0.6 * 7)
    assert filter_of_the_paper([4.0, 10.0], 0.4, 1.0) == 10.0


def fed(constants: Any, values: Any) -> Any:
    detector = PaperDetector(constants)
    for k, value in enumerate(values):
        detector.feed(k * detector.bin_us, value)
    return detector.result()


def test_the_synthetic_rule_looks_back_three_bins_and_five_milliseconds() -> None:
    said = fed(SYNTHETIC_MANY_FRAMES, [10.0] * 20 + [-60.0] * 3)
    first_negative = said.crossing_us
    assert said.focus_us == first_negative - 3 * 2000 - 5000
    assert said.decided_us > said.crossing_us


def test_the_answer_is_overwritten_while_the_rule_holds() -> None:
    once = fed(SYNTHETIC_ONE_FRAME, [10.0] * 20 + [-60.0] * 3)
    again = fed(SYNTHETIC_ONE_FRAME, [10.0] * 20 + [-60.0] * 3 + [100.0] * 5 + [-60.0] * 9)
    assert again.focus_us > once.focus_us


def test_evk4_wants_a_deep_recent_minimum() -> None:
    assert fed(EVK4, [100.0] * 10 + [-400.0] * 5).focus_us is None
    said = fed(EVK4, [100.0] * 10 + [-2000.0] * 5)
    assert said.focus_us == said.crossing_us - 2 * 1000


def test_a_sweep_that_starts_the_wrong_way_finds_nothing() -> None:
    assert fed(SYNTHETIC_MANY_FRAMES, [-60.0] * 30).focus_us is None
