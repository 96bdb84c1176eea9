"""The trend over the runs in a real browser: drawn, told in words, pressed."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from gestures import expect
from probes import PALE

if TYPE_CHECKING:
    from conftest import Opener, Rig


def runs(count: int) -> list[dict[str, object]]:
    """Newest first; each third did not find focus."""
    return [
        {
            "name": f"20261122T2243{nth:02d}Z-001",
            "at": f"2026-11-22T22:43:{nth:02d}Z",
            "outcome": "NO_CROSSING" if nth % 3 == 2 else "FOCUSED",
            "reason": "as it was",
            "focus_um": None if nth % 3 == 2 else 1560.0,
            "sigma_um": None if nth % 3 == 2 else 1.0,
            "final_um": 1300.0 if nth % 3 == 2 else 1560.0 + nth,
            "duration_ms": 240.0 + nth,
            "kept": False,
        }
        for nth in reversed(range(count))
    ]


def test_a_trend_begins_with_the_second_run_and_grows_with_each(opened: Opener, rig: Rig) -> None:
    page = opened()
    expect(page.locator("#trend")).to_be_hidden()
    for nth in range(2):
        page.click("#focus")
        rig.asked_for("focus", nth + 1)
        rig.phase("probe")
        rig.end_cycle(final_um=1560.0 + nth)
    expect(page.locator("#trend-plot")).to_have_attribute("data-points", "2")
    expect(page.locator("#trend-summary")).to_have_text(
        "2 of 2 in focus; at rest 1560.5 µm (median), 1560.0 to 1561.0."
    )


def test_what_is_drawn_is_chosen_with_the_keyboard_and_told(opened: Opener, rig: Rig) -> None:
    rig.put(runs=runs(9))
    page = opened()
    plot = page.locator("#trend-plot")
    expect(plot).to_have_attribute("data-points", "6")
    expect(plot).to_have_attribute(
        "aria-label", re.compile("^9 runs, oldest first. 6 of 9 in focus; at rest 1563.5 µm")
    )
    page.locator("[name=trend]:checked").focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#trend-summary")).to_contain_text("standard error 1.00 µm (median)")
    page.keyboard.press("ArrowRight")
    expect(page.locator("#trend-summary")).to_contain_text("took 244 ms (median), 240 to 247")
    assert page.evaluate(PALE) == {}


def test_a_run_is_opened_from_the_trend_with_a_finger(opened: Opener, rig: Rig) -> None:
    page = opened()
    for nth in range(3):
        page.click("#focus")
        rig.asked_for("focus", nth + 1)
        rig.phase("probe")
        rig.end_cycle()
    expect(page.locator("#trend-plot")).to_have_attribute("data-points", "3")
    phone = opened(viewport={"width": 360, "height": 740}, has_touch=True, is_mobile=True, device_scale_factor=2)
    expect(phone.locator("#trend-plot")).to_have_attribute("data-points", "3")
    over = phone.locator("#trend-plot .u-over")
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    assert box is not None
    phone.touchscreen.tap(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])  # the second of three
    expect(phone.locator("#run-name")).to_have_text("20261122T224301Z-001")
    assert phone.evaluate("document.documentElement.scrollWidth") <= 360
