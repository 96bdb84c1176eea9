"""`elpd stop`: stop the lens now."""

from __future__ import annotations

from typing import Any

import click

from elpd.cli.errands import errand_options, run


@click.command("stop")
@errand_options
def command(**options: Any) -> int:
    """Stop as hard as the controller can, and say where that was."""
    return run(lambda errands, _: errands.stop(), "stop", {}, **options)
