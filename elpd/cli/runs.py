"""`elpd runs`: the recorded cycles, or one of them with its numbers."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from elpd.cli.common import print_json
from elpd.cli.daemon import daemon_options, reach
from elpd.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from elpd.client.shapes import RunAnswer, RunsAnswer


@click.command("runs")
@click.argument("name", required=False)
@click.option(
    "--limit", type=click.IntRange(1, 1000), default=20, show_default=True, help="How many, the newest first."
)
@daemon_options
def command(*, name: str | None, limit: int, as_json: bool, **where: Any) -> int:
    """List the recorded cycles, or tell of the one called NAME.

    The daemon is asked; where none runs, the folder is read that the configuration names (journal.directory).
    """
    if name is None:
        listed = _listed(limit, **where)
        if as_json:
            print_json(dict(listed))
        else:
            for line in _table(listed):
                print(line)
        return 0
    run = _one(name, **where)
    if as_json:
        print_json(dict(run))
    else:
        for what, how in _told(run):
            print(f"{what:12s}{how}")
    return 0


def _listed(limit: int, **where: Any) -> RunsAnswer:
    try:
        return reach(**where).runs(limit)
    except UnreachableError:
        directory = _directory(**where)
    from elpd.service import archive  # noqa: PLC0415  (pydantic and numba, only without a daemon)

    answer: RunsAnswer = archive.runs(directory, limit).model_dump(mode="json")  # type: ignore[assignment]
    return answer


def _one(name: str, **where: Any) -> RunAnswer:
    try:
        return reach(**where).run(name)
    except UnreachableError:
        directory = _directory(**where)
    from elpd.service import archive  # noqa: PLC0415

    answer: RunAnswer = archive.run(directory, name).model_dump(mode="json")  # type: ignore[assignment]
    return answer


def _directory(*, socket: Path | None, config_path: Path | None, overrides: tuple[str, ...]) -> Path:
    """Return where runs lie without a daemon. Raises ``UnreachableError`` again where one was named."""
    from elpd.config import load  # noqa: PLC0415

    if socket is not None:
        raise UnreachableError(f"{socket}: no daemon answers; leave out --socket to read the runs on disk")
    directory = load(config_path, overrides).journal.directory
    print(f"no daemon answers; from {directory}", file=sys.stderr)
    return directory


def _table(listed: RunsAnswer) -> Iterator[str]:
    if not listed["runs"]:
        yield "no runs yet; every cycle makes one"
    width = max((len(run["name"]) for run in listed["runs"]), default=0)
    for run in listed["runs"]:
        at = "" if run["focus_um"] is None else f"{run['focus_um']:10.2f} um"
        sigma = "" if run["sigma_um"] is None else f"sigma {run['sigma_um']:.2f}"
        took = "" if run["duration_ms"] is None else f"{run['duration_ms']:.0f} ms"
        kept = "kept" if run["kept"] else ""
        ended = run["outcome"] or "ERROR"
        yield f"{run['name']:{width}s}  {ended:17s} {at:13s}  {sigma:11s} {took:>8s}  {kept}".rstrip()


def _told(run: RunAnswer) -> Iterator[tuple[str, str]]:
    yield "run", run["name"]
    result, error = run["result"], run["error"]
    if error is not None:
        yield "error", f"{error.get('kind')}: {error.get('message')}"
    if result is not None:
        yield "outcome", f"{result['outcome']}: {result['reason']}"
        for what, key, unit in (
            ("focus", "focus_um", "um"), ("sigma", "sigma_um", "um"), ("rests at", "final_um", "um"),
            ("took", "duration_ms", "ms"), ("events", "events", ""), ("lost", "lost", ""),
        ):  # fmt: skip
            if result.get(key) is not None:
                yield what, f"{result[key]:.10g} {unit}".rstrip()
        for warning in result.get("warnings", ()):
            yield "warning", warning
    yield "windows", str(len(run["samples"]))
    yield "files", ", ".join(run["files"])
