"""Who is kept out of the page: without a token, from another page, under another name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gateways import TOKEN
from gestures import REFUSED, expect
from probes import FRAME, SEND

if TYPE_CHECKING:
    from conftest import Opener, Rig


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
