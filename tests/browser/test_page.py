"""The page in a real browser, before a daemon that does what the test says."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest
from fake_daemon import PHASES
from gateways import TOKEN
from probes import FOCUSED, FRAME, MOVING, PALE, SEND, TOUCHES

if TYPE_CHECKING:
    from conftest import Opener, Rig
    from playwright.sync_api import Page

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install '.[test]'")
expect = sync_api.expect

REFUSED = "Failed to load resource"


def sensor_to_page(page: Page, x: float, y: float) -> tuple[float, float]:
    box = page.locator("#region").bounding_box()
    assert box is not None
    return box["x"] + x / 1280 * box["width"], box["y"] + y / 720 * box["height"]


def drag(page: Page, begin: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*sensor_to_page(page, *begin))
    page.mouse.down()
    page.mouse.move(*sensor_to_page(page, (begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2))
    page.mouse.move(*sensor_to_page(page, *end))
    page.mouse.up()


def close_to(box: dict[str, int], **wanted: int) -> bool:
    return all(abs(box[name] - value) <= 3 for name, value in wanted.items())


def begin_sweep(page: Page, rig: Rig) -> None:
    page.click("#focus")
    rig.asked_for("focus")
    for phase in PHASES[:4]:
        rig.phase(phase)
    rig.sweep(1358.0, 1350.0, 12)
    rig.phase("sweep", 0.4)
    rig.sweep(1350.0, 1500.0, 60)
    expect(page.locator("#phase-now")).to_have_text("Sweeping towards focus (40 %)")


# --- the region ------------------------------------------------------------------------------------------------------


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
    rig.thread.call(rig.daemon.answers.__setitem__, "status", lambda _: late)
    drag(page, (300, 200), (700, 500))
    rig.asked_for("roi", 2)
    rig.asked_for("status", rig.count("status") + 3)
    expect(page.locator("#region-summary")).to_contain_text("Region")
    late["roi"] = {"x": 8, "y": 16, "width": 64, "height": 32}  # somebody else's
    expect(page.locator("#region-summary")).to_have_text("Region 64 × 32 at 8, 16")


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


# --- a cycle ---------------------------------------------------------------------------------------------------------


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


# --- stop ------------------------------------------------------------------------------------------------------------


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
    expect(page.locator(".trouble")).to_contain_text("STOP did not get through")
    expect(page.locator(".trouble")).to_contain_text("rig's own switch")


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


# --- connection, faults, rights --------------------------------------------------------------------------------------


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


# --- the lease -------------------------------------------------------------------------------------------------------


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


# --- the token, strangers --------------------------------------------------------------------------------------------


def test_the_token_leaves_the_address_at_once_and_lasts_for_the_tab(opened: Opener) -> None:
    page = opened()
    assert TOKEN not in page.url
    page.reload()
    page.wait_for_selector("#link[data-link=on]")


def test_without_the_token_the_page_asks_for_it(opened: Opener, rig: Rig) -> None:
    opened.expected = (REFUSED,)
    page = opened(token=None, wait=False)
    expect(page.locator("#token")).to_be_focused()
    page.keyboard.type("wrong")
    page.keyboard.press("Enter")
    expect(page.locator("#locked")).to_be_visible()
    expect(page.locator("#stop")).to_be_enabled()
    page.fill("#token", TOKEN)
    page.keyboard.press("Enter")
    page.wait_for_selector("#link[data-link=on]")
    expect(page.locator("#locked")).to_be_hidden()


def test_another_page_and_a_rebound_name_move_nothing(opened: Opener, rig: Rig) -> None:
    page = opened()
    opened.expected = (REFUSED, "CORS", "Access to fetch")
    answer = page.context.request.get(rig.address, headers={"Host": "rebound.test"})
    assert answer.status == 421
    stranger = page.context.new_page()
    rebound = stranger.goto(f"http://rebound.test:{rig.port}/#token={TOKEN}")
    assert rebound is not None
    assert rebound.status == 421
    stranger.route("http://evil.example/**", lambda route: route.fulfill(body="<p>a page", content_type="text/html"))
    stranger.goto("http://evil.example/")
    for options in (
        {"method": "POST", "mode": "no-cors", "body": "{}"},
        {"method": "POST", "headers": {"Content-Type": "application/json", "X-Elpd": "1", "Authorization": "Bearer x"}},
    ):
        stranger.evaluate(SEND, [f"{rig.address}api/stop", options])
    framed = stranger.evaluate(FRAME, rig.address)
    assert framed is False
    assert rig.count("stop") == 0


# --- sizes, keyboards, colours ---------------------------------------------------------------------------------------


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
    rig.stop()
    expect(page.locator("#offline")).to_be_visible()
    assert page.evaluate(PALE) == {}
    assert page.evaluate(MOVING) == 0
