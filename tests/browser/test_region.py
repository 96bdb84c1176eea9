"""The region in a real browser: drawn, moved and resized by pointer and keyboard."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from gestures import close_to, drag, expect, sensor_to_page

if TYPE_CHECKING:
    from conftest import Opener, Rig


def test_a_region_is_drawn_moved_and_resized_with_the_pointer(opened: Opener, rig: Rig) -> None:
    page = opened()
    drag(page, (300, 200), (700, 500))
    drawn = rig.asked_for("roi", 2)["set"]
    assert close_to(drawn, x=300, y=200, width=400, height=300), drawn
    drag(page, (500, 350), (600, 300))
    moved = rig.asked_for("roi", 3)["set"]
    assert close_to(moved, x=400, y=150, width=400, height=300), moved
    drag(page, (800, 450), (900, 600))
    resized = rig.asked_for("roi", 4)["set"]
    assert close_to(resized, x=400, y=150, width=500, height=450), resized
    expect(page.locator("#region-summary")).to_have_text(re.compile(r"Region \d+ × \d+ at \d+, \d+"))
    page.mouse.click(*sensor_to_page(page, 50, 50))  # a click alone is no region
    expect(page.locator("#region-summary")).to_contain_text("Region")
    assert rig.count("roi") == 4


def test_a_drag_past_the_edge_ends_at_the_edge(opened: Opener, rig: Rig) -> None:
    page = opened()
    drag(page, (1000, 500), (1700, 900))
    drawn = rig.asked_for("roi", 2)["set"]
    assert close_to(drawn, x=1000, y=500, width=280, height=220), drawn
    assert drawn["x"] + drawn["width"] <= 1280


def test_what_the_daemon_cut_is_shown_as_it_was_used(opened: Opener, rig: Rig) -> None:
    page = opened()
    page.click("#region-summary")
    for name, value in (("x", "1200"), ("y", "700"), ("width", "400"), ("height", "400")):
        page.fill(f"#roi-{name}", value)
    page.click("#region-form button[type=submit]")
    assert rig.asked_for("roi", 2)["set"]["width"] == 400
    expect(page.locator("#roi-echo")).to_have_text("Cut to the sensor: 80 × 20 at 1200, 700.")
    expect(page.locator("#roi-width")).to_have_value("80")


def test_the_region_by_keyboard(opened: Opener, rig: Rig) -> None:
    page = opened()
    region = page.locator("#region")
    region.focus()
    page.keyboard.press("Enter")
    assert rig.asked_for("roi", 2)["set"] == {"x": 496, "y": 216, "width": 288, "height": 288}
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("Control+ArrowUp")
    rig.until_asked("roi", {"set": {"x": 504, "y": 223, "width": 296, "height": 288}})
    expect(region).to_have_attribute("aria-label", "Region 296 by 288 pixels at 504, 223")
    page.keyboard.press("Delete")
    rig.until_asked("roi", {"set": None})
    expect(region).to_have_attribute("aria-label", "No region: elpd chooses one")


def test_a_status_that_is_late_takes_no_region_away_and_one_that_is_new_does(opened: Opener, rig: Rig) -> None:
    page = opened()
    late = rig.daemon._status()
    rig.tells(late)
    drag(page, (300, 200), (700, 500))
    rig.asked_for("roi", 2)
    rig.asked_for("status", rig.count("status") + 3)
    expect(page.locator("#region-summary")).to_contain_text("Region")
    late["roi"] = {"x": 8, "y": 16, "width": 64, "height": 32}  # somebody else's
    expect(page.locator("#region-summary")).to_have_text("Region 64 × 32 at 8, 16")


def test_a_status_of_between_two_changes_takes_the_second_one_not_back(opened: Opener, rig: Rig) -> None:
    page = opened()
    before = rig.daemon._status()
    rig.tells(before)
    drag(page, (300, 200), (700, 500))
    rig.asked_for("roi", 2)
    between = rig.daemon._status()
    drag(page, (500, 350), (600, 300))
    moved = rig.asked_for("roi", 3)["set"]
    assert between["roi"] not in (None, moved)
    rig.tells(between)
    rig.asked_for("status", rig.count("status") + 3)
    expect(page.locator("#region-summary")).to_have_text(
        f"Region {moved['width']} × {moved['height']} at {moved['x']}, {moved['y']}"
    )


def test_a_region_is_saved_and_chosen_by_name(opened: Opener, rig: Rig) -> None:
    page = opened()
    drag(page, (300, 200), (700, 500))
    rig.asked_for("roi", 2)
    page.click("#region-summary")
    page.fill("#roi-name", "slide left")
    page.click("#roi-save")
    assert rig.asked_for("roi", 3)["name"] == "slide left"
    drag(page, (100, 100), (200, 150))
    rig.asked_for("roi", 4)
    page.select_option("#roi-named", "slide left")
    assert close_to(rig.asked_for("roi", 5)["set"], x=300, y=200, width=400, height=300)
