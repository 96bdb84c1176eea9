"""`elpd report`: a recorded run as one HTML page."""

from __future__ import annotations

from pathlib import Path

import click

from elpd.cli.common import config_options, json_option, print_json, run_folder


@click.command("report")
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="The page; RUN's name and .html if not given."
)
@config_options
@json_option
def command(
    *, run: Path, out: Path | None, config_path: Path | None, overrides: tuple[str, ...], as_json: bool
) -> None:
    """Write the run RUN as one self-contained HTML page: numbers, plots, picture, settings.

    RUN is a folder, or a name that `elpd runs` lists, of the folder journal.directory (runs/ unless set). The page has
    no script and loads nothing. The folder is only read.
    """
    from elpd.config import load  # noqa: PLC0415
    from elpd.record.report import report_html  # noqa: PLC0415  (numpy, numba and cv2 only now)

    run = run_folder(run, load(config_path, overrides))
    page = report_html(run)
    target = out or Path(f"{run.resolve().name}.html")
    target.write_text(page, encoding="utf-8")
    if as_json:
        print_json({"out": target, "bytes": len(page.encode()), "run": run})
    else:
        print(target)
