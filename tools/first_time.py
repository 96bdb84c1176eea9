"""Do what README tells somebody who has nothing yet, word for word, until the page says that it is in focus.

    python tools/first_time.py                      a fresh copy, a fresh environment; says how long each step took
    python tools/first_time.py --packages-of .venv  without downloads, with the packages of an environment that is there

The lines are README's own, read out of it: what "Quick start" has but the tests, then `elpd serve` and `elpd web` from
there or from "As a service". They run in a copy of what git has, with an empty home folder and, as a person has it, a
terminal. Then a browser opens the address that was printed, and Focus is clicked. Exit code 0 if it ends in focus.

Needs chromium (``tools/packages``) and playwright (``pip install '.[test]'``).
"""

from __future__ import annotations

import argparse
import os
import pty
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[1]
SERVING = ("elpd serve", "elpd web")
PATIENCE_MS = 180_000
CHROMIUM = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync")
PROGRAM = "#!{python}\nimport sys\nfrom elpd.cli import main\nsys.exit(main())\n"


def main() -> int:
    """Do it; exit 1 where a step fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packages-of", type=Path, metavar="PREFIX", help="an environment whose packages are used")
    prefix = parser.parse_args().packages_of
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="elpd-first-") as folder, ExitStack() as running:
        copy, home = Path(folder, "elpd"), Path(folder, "home")
        fresh_copy(copy, with_kernels=prefix is not None)
        home.mkdir()
        if prefix is not None:
            borrow(prefix.resolve(), copy)
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("ELPD", "PYTHON"))}
        environment |= {"HOME": str(home), "XDG_RUNTIME_DIR": str(home), "TERM": "dumb"}
        environment["PATH"] = f"{copy}/.venv/bin:{environment['PATH']}"
        address = ""
        for line in lines_of(copy / "README.md"):
            step_s = time.monotonic()
            if line.startswith(SERVING):
                address = running.enter_context(in_a_terminal(line, copy, environment)) or address
            elif subprocess.run(["bash", "-ec", line], cwd=copy, env=environment, check=False).returncode:  # noqa: S603, S607
                print(f"README's `{line}` failed", file=sys.stderr)
                return 1
            print(f"{time.monotonic() - step_s:6.1f} s  {line}", flush=True)
        step_s = time.monotonic()
        outcome, reason = focus_in_a_browser(address)
        print(f"{time.monotonic() - step_s:6.1f} s  Focus, on the page: {outcome}: {reason}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{time.monotonic() - begun_s:6.1f} s  in all, from nothing")
    print(f"{used.ru_utime + used.ru_stime:6.1f} s  of a processor, the browser's among them")
    return 0 if outcome == "In focus" else 1


def lines_of(readme: Path) -> list[str]:
    """Return README's commands up to the page, without their comments."""
    text = readme.read_text(encoding="utf-8")
    quick, service = (_commands(text, heading) for heading in ("Quick start", "As a service"))
    begin = [line for line in quick if "test" not in line]
    there = [line for line in begin if line.startswith(SERVING)]
    return begin + [line for line in service if line.startswith(SERVING) and not there]


def _commands(text: str, heading: str) -> list[str]:
    section = re.search(rf"^## {heading}\n.*?^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    if section is None:
        raise SystemExit(f"README has no commands below {heading!r}")
    lines = (line.partition("  #")[0].strip().removesuffix("&").strip() for line in section[1].splitlines())
    return [line for line in lines if line]


def fresh_copy(copy: Path, *, with_kernels: bool) -> None:
    """Copy what git would give, and, if wanted, the kernels that are compiled already."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],  # noqa: S607
        cwd=ROOT, capture_output=True, check=True,
    )  # fmt: skip
    paths = [ROOT / os.fsdecode(name) for name in listed.stdout.split(b"\0") if name]
    if with_kernels:
        paths += [*ROOT.glob("elpd/**/__pycache__/*.nb?"), *ROOT.glob("drivers/**/__pycache__/*.nb?")]
    for path in filter(Path.is_file, paths):
        place = copy / path.relative_to(ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, place)  # with its time, by which a kernel knows its source


def borrow(prefix: Path, copy: Path) -> None:
    """Make the copy's ``.venv`` of another environment's packages; to ``make`` it looks installed."""
    venv = copy / ".venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)  # noqa: S603
    (packages,) = prefix.glob("lib/python3*/site-packages")
    (own,) = venv.glob("lib/python3*/site-packages")
    (own / "here.pth").write_text(f"{copy}\n{copy}/drivers\n{packages}\n", encoding="utf-8")
    program = venv / "bin" / "elpd"
    program.write_text(PROGRAM.format(python=venv / "bin" / "python"), encoding="utf-8")
    program.chmod(0o755)
    (venv / ".installed").touch()


@contextmanager
def in_a_terminal(line: str, copy: Path, environment: dict[str, str]) -> Iterator[str | None]:
    """Run a command that stays, until the end of the block; the address that it has printed, if it is the page."""
    master, slave = pty.openpty()
    process = subprocess.Popen(  # noqa: S603
        ["bash", "-c", f"exec {line}"],  # noqa: S607
        cwd=copy, env=environment, stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
    )  # fmt: skip
    os.close(slave)
    try:
        yield _address(master) if line.startswith("elpd web") else None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=60)
        os.close(master)


def _address(master: int) -> str:
    said = b""
    while (found := re.search(rb"https?://\S+(?=\r?\n)", said)) is None:
        try:
            said += os.read(master, 4096)
        except OSError:  # it has ended
            raise SystemExit(f"elpd web ended: {said.decode(errors='replace')}") from None
    return found[0].decode()


def focus_in_a_browser(address: str) -> tuple[str, str]:
    """Open the page, click Focus, and return how it ended."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  (only now, so that --help needs nothing)

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=[*CHROMIUM])
        page = browser.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.goto(address)
        page.wait_for_selector("#state[data-state=READY]")
        page.click("#focus")
        page.wait_for_selector("#result:not([hidden])")
        told = page.locator("#outcome").inner_text(), page.locator("#reason").inner_text()
        browser.close()
        return told


if __name__ == "__main__":
    raise SystemExit(main())
