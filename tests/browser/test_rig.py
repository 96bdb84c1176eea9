"""The rig on the page: connection, faults, what may be done by whom, the lens by hand, the lease."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gestures import REFUSED, begin_sweep, expect

if TYPE_CHECKING:
    from conftest import Opener, Rig


def test_the_daemon_restarts_and_the_page_comes_back_by_itself(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page = opened()
    rig.stop()
    expect(page.locator("#link-text")).to_have_text("no daemon")
    expect(page.locator("#focus")).to_be_disabled()
    rig.put(position_um=42.0)
    rig.start()
    expect(page.locator("#link-text")).to_have_text("live")
    expect(page.locator("#offline")).to_be_hidden()
    expect(page.locator("#position")).to_have_text("42.00")
    rig.heard()
    begin_sweep(page, rig)


def test_a_latched_fault_is_cleared_on_the_page(opened: Opener, rig: Rig) -> None:
    page = opened()
    rig.set_fault("LensError", "lens: no reply to STOP for 52 ms (limit 50); check the cable")
    expect(page.locator("#fault-title")).to_have_text("Fault: Lens")
    expect(page.locator("#fault-text")).to_contain_text("check the cable")
    expect(page.locator("#focus")).to_be_disabled()
    expect(page.locator("#stop")).to_be_enabled()
    page.click("#clear")
    rig.asked_for("clear")
    expect(page.locator("#fault")).to_be_hidden()
    expect(page.locator("#focus")).to_be_enabled()


def test_warnings_have_a_title_and_the_daemons_sentence(opened: Opener, rig: Rig) -> None:
    page = opened()
    expect(page.locator("#warnings")).to_be_hidden()
    titles = {
        "dark": "Too dark",
        "flat": "No texture",
        "flicker": "The light flickers",
        "saturated": "Saturated",
        "losing-events": "Events are lost",
        "paused": "Paused",
    }
    rig.put(warnings=[{"code": code, "text": "measured 3, limit 5; change this"} for code in titles])
    said = [f"{title}measured 3, limit 5; change this" for title in titles.values()]
    expect(page.locator("#advice li")).to_have_text(said)


def test_who_may_only_watch_can_still_press_stop(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    rig.stop()
    rig.put(role="observe")
    rig.start()
    page = opened()
    expect(page.locator("#link-text")).to_have_text("watching only")
    for control in ("#focus", "#home", "#jog button >> nth=0", "#preset-form button"):
        expect(page.locator(control)).to_be_disabled()
    expect(page.locator("#stop")).to_be_enabled()
    page.click("#stop")
    expect(page.locator(".trouble")).to_contain_text("elpd-operators")


def test_the_lens_by_hand_presets_and_modes(opened: Opener, rig: Rig) -> None:
    page = opened()
    page.click("#jog button[value='10']")
    assert rig.asked_for("jog") == {"by_um": 10}
    expect(page.locator("#position")).to_have_text("1368.75")
    page.fill("#move-to", "1500.5")
    page.press("#move-to", "Enter")
    assert rig.asked_for("move") == {"to_um": 1500.5}
    page.fill("#preset-name", "slide")
    page.click("#preset-form button")
    expect(page.locator("#presets")).to_contain_text("slide1500.5 µm")
    page.click("#home")
    rig.asked_for("home")
    expect(page.locator("#position")).to_have_text("0.00")
    page.click(".preset-go")
    expect(page.locator("#position")).to_have_text("1500.50")
    page.click("label:has(> [value=continuous])")
    assert rig.asked_for("mode", 2) == {"mode": "continuous"}
    expect(page.locator("#mode-help")).to_contain_text("Watches")


def test_a_refusal_is_told_in_the_daemons_words(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page = opened()
    page.click("#jog button[value='100']")
    rig.asked_for("jog")
    rig.put(position_um=2990.0)
    page.click("#jog button[value='100']")
    expect(page.locator(".trouble")).to_contain_text("3090.0 µm is outside the limits")


def test_the_page_keeps_the_rig_and_gives_it_back(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page, other = opened(), opened()
    expect(page.locator("#lease-state")).to_contain_text("Free")
    page.click("#lease")
    assert rig.asked_for("lease") == {"action": "acquire", "seconds": 15}
    expect(page.locator("#lease")).to_have_text("Give it back")
    expect(page.locator("#held")).to_be_hidden()
    expect(page.locator("#focus")).to_be_enabled()
    expect(other.locator("#held-title")).to_have_text("Another page has the rig")
    for control in ("#focus", "#home", "#jog button >> nth=0", "#lease", "#record-form button"):
        expect(other.locator(control)).to_be_disabled()
    page.click("#jog button[value='10']")
    rig.asked_for("jog")
    other.click("#stop")
    rig.asked_for("stop")
    page.click("#lease")
    assert rig.asked_for("lease", 2) == {"action": "release"}
    expect(other.locator("#held")).to_be_hidden()
    expect(other.locator("#focus")).to_be_enabled()


def test_a_page_that_is_closed_gives_the_rig_back(opened: Opener, rig: Rig) -> None:
    page, other = opened(), opened()
    page.click("#lease")
    expect(other.locator("#held")).to_be_visible()
    page.close(run_before_unload=True)
    assert rig.asked_for("lease", 2) == {"action": "release"}
    expect(other.locator("#held")).to_be_hidden()


def test_who_has_the_rig_is_said_and_what_they_alone_may_do_is_off(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page = opened()
    rig.put(holder={"pid": 4242, "uid": 1000, "name": "elpd"})
    expect(page.locator("#held-title")).to_have_text("elpd (process 4242) has the rig")
    expect(page.locator("#held-text")).to_contain_text("ends by itself in 12 s")
    expect(page.locator("#focus")).to_be_disabled()
    expect(page.locator("#stop")).to_be_enabled()
    page.keyboard.press("Escape")
    rig.asked_for("stop")
    rig.put(holder=None)
    expect(page.locator("#focus")).to_be_enabled()


def test_a_lease_that_was_lost_is_told(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page = opened()
    page.clock.install()
    page.click("#lease")
    expect(page.locator("#lease")).to_have_text("Give it back")
    rig.put(holder=None)
    page.clock.run_for(6000)
    expect(page.locator(".trouble")).to_contain_text("not this page's any more")
    expect(page.locator("#lease")).to_have_text("Keep the rig")
