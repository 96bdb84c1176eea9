"""Sizes, keyboards, fingers, colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from gestures import REFUSED, begin_sweep, expect, sensor_to_page
from probes import FOCUSED, MOVING, PALE, TOUCHES

if TYPE_CHECKING:
    from conftest import Opener, Rig


def test_nothing_is_wider_than_the_screen(opened: Opener) -> None:
    page = opened()
    for width in (320, 360, 414, 768, 1024, 1920):
        page.set_viewport_size({"width": width, "height": 740})
        page.evaluate("scrollTo(0, 0)")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        stop = page.locator("#stop").bounding_box()
        assert stop is not None
        assert 0 <= stop["x"] <= stop["x"] + stop["width"] <= width
        assert 0 <= stop["y"] <= stop["y"] + stop["height"] <= 740
        page.evaluate("scrollTo(0, 99999)")
        assert page.locator("#stop").bounding_box() == stop


def test_a_phone_is_tapped_and_dragged(opened: Opener, rig: Rig) -> None:
    page = opened(viewport={"width": 360, "height": 740}, has_touch=True, is_mobile=True, device_scale_factor=2)
    for button in page.locator("button:visible:not(.plain)").all():
        box = button.bounding_box()
        assert box is not None
        assert box["height"] >= 44, button.inner_text()
    touch = page.context.new_cdp_session(page)

    def finger(kind: str, *points: tuple[float, float]) -> None:
        places = [dict(zip("xy", sensor_to_page(page, *point), strict=True)) for point in points]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    page.evaluate(TOUCHES)
    finger("touchStart", (200, 100))
    finger("touchMove", (500, 300))
    finger("touchMove", (800, 500))
    finger("touchEnd")
    drawn = rig.asked_for("roi", 2)["set"]
    assert abs(drawn["width"] - 600) < 20, drawn
    expect(page.locator("#region-summary")).to_contain_text("Region")
    page.locator("#focus").scroll_into_view_if_needed()
    page.tap("#focus")
    rig.asked_for("focus")
    page.tap("#stop")
    rig.asked_for("stop")
    assert rig.count("stop") == 1  # a tap is a press and a click, and one STOP
    finger("touchStart", (40, 600))
    finger("touchEnd")
    # a drag that the browser took for its own would end in a fling, which swallows the next tap; beside the region a
    # finger scrolls the page
    assert page.evaluate("window.touches") == [["region", True], ["focus", False], ["stop", False], ["region", False]]


def test_every_control_is_reached_by_tab_and_shows_it(opened: Opener) -> None:
    page = opened()
    controls = {"stop", "focus", "region", "home", "move-to", "preset-name", "dry-run"}
    if not page.evaluate("document.getElementById('download').disabled"):  # there is a picture to save
        controls.add("download")
    seen: list[str] = []
    for _ in range(60):
        page.keyboard.press("Tab")
        facts: dict[str, Any] = page.evaluate(FOCUSED)
        if facts["id"] == "BODY":
            break
        assert facts["shown"], facts
        seen.append(facts["id"])
    assert controls <= set(seen)
    assert seen.index("stop") <= 1


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read_in_both_schemes(opened: Opener, rig: Rig, scheme: str) -> None:
    page = opened(color_scheme=scheme, reduced_motion="reduce")
    begin_sweep(page, rig)
    assert page.evaluate(PALE) == {}
    rig.end_cycle(warnings=["the light swings at 100 Hz"])
    page.click("#runs button")
    expect(page.locator("#run-facts")).to_contain_text("took")
    assert page.evaluate(PALE) == {}
    rig.put(warnings=[{"code": "dark", "text": "more light"}], holder={"pid": 1, "uid": 0, "name": "elpd"})
    rig.set_fault("LensError", "gone")
    for notice in ("#fault", "#held", "#warnings"):
        expect(page.locator(notice)).to_be_visible()
    assert page.evaluate(PALE) == {}
    opened.expected = (REFUSED,)
    rig.stop()
    expect(page.locator("#offline")).to_be_visible()
    assert page.evaluate(PALE) == {}
    assert page.evaluate(MOVING) == 0
