"""Take pictures of the page, as README shows it: the simulated rig, a real daemon, a real browser, one focus cycle.

    python tools/web_pictures.py tools/docs/images

writes ``page-light.png``, ``page-dark.png`` and ``page-phone.png``. Needs chromium (``tools/packages``), playwright
(``pip install '.[test]'``) and pillow, which comes with matplotlib (``pip install '.[docs]'``). Inter is the page's
first choice of a typeface; the pictures here were made with it (Debian's ``fonts-inter``).
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Page

SCENE = ("sim.seed=7", "sim.scene=coffee", "sim.pace=1", "sim.start_um=-200")
SHOTS: dict[str, dict[str, Any]] = {
    "light": {"viewport": {"width": 1360, "height": 960}, "color_scheme": "light"},
    "dark": {"viewport": {"width": 1360, "height": 960}, "color_scheme": "dark"},
    "phone": {
        "viewport": {"width": 375, "height": 812},
        "device_scale_factor": 2,
        "has_touch": True,
        "is_mobile": True,
        "color_scheme": "light",
    },
}
REGION = {"x": 470, "y": 150, "width": 420, "height": 420}
COLOURS = 256
CALM_MS = 300_000
CHROMIUM = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync")


def main() -> int:
    """Take them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the PNGs go")
    folder = parser.parse_args().folder
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  (the rigs below are for tests as well)

    chromium = shutil.which("chromium")
    if chromium is None:
        print("chromium is not installed; tools/packages installs it", file=sys.stderr)
        return 2
    with running_page(*SCENE) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=[*CHROMIUM])
        focus_once(browser, address)
        for name, options in SHOTS.items():
            path = folder / f"page-{name}.png"
            path.write_bytes(smaller(take(browser, address, options)))
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")
        browser.close()
    return 0


def focus_once(browser: Browser, address: str) -> None:
    """Choose a region and run one cycle from the page."""
    page = opened(browser, address, SHOTS["light"])
    page.click("#region-summary")
    for name, value in REGION.items():
        page.fill(f"#roi-{name}", str(value))
    page.click("#region-form button[type=submit]")
    page.wait_for_selector("#region.has-box")
    page.click("#focus")
    page.wait_for_selector("#result:not([hidden])", timeout=120_000)
    print(page.locator("#outcome").inner_text(), page.locator("#reason").inner_text())
    # a machine with too much to do is warned of, until a minute after: a picture for README has no such warning
    page.wait_for_selector("#warnings", state="hidden", timeout=CALM_MS)
    page.context.close()


def take(browser: Browser, address: str, options: dict[str, Any]) -> bytes:
    """Return one picture of the page as it is after the cycle."""
    page = opened(browser, address, options)
    page.wait_for_selector("#image[src]")
    page.wait_for_selector("#plot[data-points]:not([data-points='0'])")
    page.click("#runs button >> nth=0")
    page.wait_for_selector("#run-detail:not([hidden])")
    page.evaluate("scrollTo(0, 0)")
    page.mouse.move(0, 0)
    picture = page.screenshot(animations="disabled")
    page.context.close()
    return picture


def opened(browser: Browser, address: str, options: dict[str, Any]) -> Page:
    """Open the page and wait until it is live."""
    page = browser.new_context(**options).new_page()
    page.goto(address)
    page.wait_for_selector("#link[data-link=on]")
    page.wait_for_selector("#state[data-state=READY]")
    return page


def smaller(png: bytes) -> bytes:
    """Return the picture in few colours."""
    from PIL import Image  # noqa: PLC0415

    few = (
        Image.open(io.BytesIO(png))
        .convert("RGB")
        .quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    )
    out = io.BytesIO()
    few.save(out, "PNG", optimize=True)
    return out.getvalue()


@contextmanager
def running_page(*settings: str) -> Iterator[str]:
    """Run ``elpd serve`` on the simulated rig and ``elpd web`` before it; the page's address, with its token."""
    with (
        tempfile.TemporaryDirectory(prefix="elpd-") as folder,
        running("serve", folder, *settings),
        running("web", folder) as page,
    ):
        token = Path(page["token_file"]).read_text(encoding="ascii").strip()
        yield f"{page['address']}#token={token}"


@contextmanager
def running(command: str, folder: str, *settings: str) -> Iterator[dict[str, Any]]:
    """Run one of our commands in *folder* until the end of the block; what it prints once it is ready."""
    options = [f"api.socket={folder}/elpd.sock", f"state.directory={folder}/state", f"journal.directory={folder}/runs"]
    options += [f"web.token_file={folder}/web.token", "web.port=0", *settings]
    arguments = [item for option in options for item in ("--set", option)]
    program = "from elpd.cli import main; main()"
    with subprocess.Popen(  # noqa: S603  (our own command)
        [sys.executable, "-c", program, command, "--json", *arguments], stdout=subprocess.PIPE, text=True, cwd=folder
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line:
                raise RuntimeError(f"elpd {command} ended with {process.wait()} before it was ready")
            yield json.loads(line)
        finally:
            process.terminate()
            process.wait(timeout=30)


if __name__ == "__main__":
    raise SystemExit(main())
