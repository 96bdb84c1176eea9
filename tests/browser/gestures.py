"""What a person does on the page, and what the daemon behind it then tells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from fake_daemon import PHASES

if TYPE_CHECKING:
    from conftest import Rig
    from playwright.sync_api import Page

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install '.[test]'")
expect = sync_api.expect

REFUSED = "Failed to load resource"
"""What a browser says of an answer that was no success."""


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
