"""A cycle in a real browser, and STOP in the midst of it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from fake_daemon import PHASES
from gestures import REFUSED, begin_sweep, expect

if TYPE_CHECKING:
    from conftest import Opener, Rig


def test_a_cycle_from_the_button_to_its_record(opened: Opener, rig: Rig) -> None:
    page = opened()
    begin_sweep(page, rig)
    expect(page.locator("#state")).to_have_text("Focusing")
    expect(page.locator("#focus")).to_be_disabled()
    expect(page.locator("#phases [aria-current=step]")).to_have_text("sweep")
    expect(page.locator("#plot")).to_have_attribute("data-points", re.compile(r"^[5-9]\d$"))
    rig.sweep(1502.0, 1610.0, 50)
    for phase in PHASES[5:]:
        rig.phase(phase)
    rig.end_cycle(final_um=1560.9, warnings=["the light swings at 100 Hz; switch the lamp to DC"])
    expect(page.locator("#outcome")).to_have_text("In focus")
    expect(page.locator("#found")).to_have_text("1560.90")
    expect(page.locator("#remarks")).to_contain_text("switch the lamp to DC")
    expect(page.locator("#curve-summary")).to_contain_text(re.compile(r"crossed zero at 156\d\.\d µm"))
    expect(page.locator("#curve-summary")).to_contain_text("focus measured at 1560.9 µm")
    expect(page.locator("#phases [data-is=done]")).to_have_count(8)
    expect(page.locator("#spoken")).to_contain_text("focused: in focus at 1560.9")
    expect(page.locator("#position")).to_have_text("1560.90")
    expect(page.locator("#focus")).to_be_enabled()
    page.click("#runs button")
    expect(page.locator("#run-reason")).to_contain_text("in focus at 1560.9")
    expect(page.locator("#run-plot")).to_have_attribute("data-points", re.compile(r"^\d{3}$"))


def test_what_was_not_found_says_what_to_change(opened: Opener, rig: Rig) -> None:
    page = opened()
    page.check("#reference")
    page.check("#dry-run")
    page.click("#focus")
    assert rig.asked_for("focus") == {"reference": "last", "dry_run": True}
    rig.phase("choose")
    rig.end_cycle("NO_TEXTURE", reason="texture 12 is below the noise of 40; choose a region with edges, or add light")
    expect(page.locator("#outcome")).to_have_text("No texture in the region")
    expect(page.locator("#reason")).to_contain_text("choose a region with edges")
    expect(page.locator("#found")).to_be_hidden()


def test_a_page_that_opens_during_a_cycle_has_all_of_it(opened: Opener, rig: Rig) -> None:
    first = opened()
    begin_sweep(first, rig)
    late = opened(wait=False)
    expect(late.locator("#phase-now")).to_have_text("Sweeping towards focus (40 %)")
    expect(late.locator("#plot")).to_have_attribute("data-points", first.locator("#plot").get_attribute("data-points"))


@pytest.mark.parametrize(
    "how", ["button", "Escape", "Space on a button", "Space in a field", "Escape in a field", "Enter"]
)
def test_stop_in_mid_sweep(opened: Opener, rig: Rig, how: str) -> None:
    page = opened()
    begin_sweep(page, rig)
    if how == "button":
        page.click("#stop")
    elif how == "Enter":
        page.locator("#stop").focus()
        page.keyboard.press("Enter")
    elif how.endswith("field"):
        page.click("#region-summary")
        page.fill("#roi-x", "12")
        page.keyboard.press(how.split(maxsplit=1)[0])
    elif how == "Escape":
        page.keyboard.press("Escape")
    else:
        page.locator("#cancel").focus()
        page.keyboard.press("Space")
    rig.asked_for("stop")
    expect(page.locator("#outcome")).to_have_text("Cancelled")
    expect(page.locator("#spoken")).not_to_be_empty()
    assert (rig.count("stop"), rig.count("cancel")) == (1, 0)


def test_space_at_rest_still_works_a_button(opened: Opener, rig: Rig) -> None:
    page = opened()
    expect(page.locator("#lens-state")).to_contain_text("at rest")
    page.locator("#dry-run").focus()
    page.keyboard.press("Space")
    expect(page.locator("#dry-run")).to_be_checked()
    assert rig.count("stop") == 0
    page.locator("body").press("Escape")
    rig.asked_for("stop")


def test_a_stop_that_does_not_get_through_says_so_and_stays(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page = opened()
    rig.stop()
    expect(page.locator("#offline-title")).to_have_text("The daemon is away")
    expect(page.locator("#stop")).to_be_enabled()
    page.click("#stop")
    expect(page.locator(".trouble")).to_contain_text(re.compile("STOP did not get through.*rig's own switch"))


def test_what_the_page_asked_by_itself_is_not_told_when_the_daemon_goes_before_it_answers(
    opened: Opener, rig: Rig
) -> None:
    opened.expected = (REFUSED,)
    rig.put(silent={"roi"})
    page = opened(wait=False)
    rig.asked_for("roi")
    with page.expect_response(re.compile("api/roi")) as gone:
        rig.stop()
    assert (gone.value.status, gone.value.json()["error"]["kind"]) == (503, "Unreachable")
    expect(page.locator("#offline-title")).to_have_text("The daemon is away")
    expect(page.locator("#trouble")).to_be_empty()


def test_stop_finds_a_way_past_commands_and_pictures_that_nobody_answers(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page = opened()
    rig.put(silent={"jog", "map", "run", "runs"})
    page.check("[name=kind][value=events]", force=True)
    rig.asked_for("map", rig.count("map") + 1)
    for nth in range(2):
        page.click("#jog button[value='1']")
        rig.asked_for("jog", nth + 1)
    page.click("#jog button[value='1']")
    expect(page.locator(".trouble")).to_contain_text("Two commands are under way")
    page.keyboard.press("Escape")
    rig.asked_for("stop")
    assert rig.count("jog") == 2


def test_a_tab_in_the_background_lets_go_and_comes_back(opened: Opener, rig: Rig) -> None:
    page = opened()
    hide = "(hidden) => { Object.defineProperty(document, 'hidden', { value: hidden, configurable: true }); }"
    page.evaluate(hide, True)
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#link-text")).to_have_text("offline")
    rig.phase("probe")
    page.evaluate(hide, False)
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#link-text")).to_have_text("live")
    expect(page.locator("#phase-now")).to_have_text("Setting out: which way is focus?")
