"""`elpd focus`: one cycle, by the daemon or from here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from elpd.cli.common import config_options, from_here, interruptible, json_option, parse_roi, print_json
from elpd.config import Config, load
from elpd.errors import UsageError
from elpd.focus.settings import FocusRequest
from elpd.records import Roi


@click.command("focus")
@click.option(
    "--roi", metavar="X,Y,W,H", help="Where to focus, in sensor pixels; proposed (most texture) if not given."
)
@click.option("--reference", metavar="last|IMG", help="Focus on the last map, or on an image of the whole sensor.")
@click.option("--foreground", is_flag=True, help="Focus from this process, not through the daemon.")
@click.option("--dry-run", is_flag=True, help="Everything but motion of the lens.")
@config_options
@json_option
def command(
    *,
    roi: str | None,
    reference: str | None,
    foreground: bool,
    dry_run: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Focus once: exit 0 in focus, 1 not found, 2 usage, 3 device, 4 busy or unreachable."""
    from_here(foreground=foreground, config_path=config_path, overrides=overrides)
    config = load(config_path, overrides)
    request = FocusRequest(
        roi=parse_roi(roi) or _configured_roi(config),
        reference=_reference_path(reference, config),
        dry_run=dry_run,
    )
    from elpd.cli.view import open_view  # noqa: PLC0415
    from elpd.record.session import focus_once  # noqa: PLC0415  (after the request is known to be well formed: numba)

    with interruptible() as cancelled:
        if as_json:
            session = focus_once(config, request, None, cancelled)
        else:
            with open_view() as view:
                session = focus_once(config, request, view, cancelled)
                view.result(session.result)
    if as_json:
        print_json(session.fields())
    else:
        _tell(session.fields())
    return 0 if session.focused else 1


def _configured_roi(config: Config) -> Roi | None:
    return None if config.focus.roi is None else Roi(*config.focus.roi)


def _reference_path(reference: str | None, config: Config) -> Path | None:
    if reference is None:
        return None
    path = config.journal.directory / "last-map.npz" if reference == "last" else Path(reference)
    if not path.exists():
        hint = "make one with `elpd expose`" if reference == "last" else "give an existing image"
        raise UsageError(f"--reference {reference}: {path} does not exist; {hint}")
    return path


def _tell(fields: dict[str, Any]) -> None:
    print(f"{fields['outcome']}: {fields['reason']}")
    for warning in fields["warnings"]:
        print(f"  warning: {warning}")
    for name, unit in (("focus_um", "um"), ("sigma_um", "um"), ("stop_um", "um"), ("final_um", "um")):
        if fields[name] is not None:
            print(f"  {name.removesuffix('_um'):10s} {fields[name]:10.2f} {unit}")
    print(f"  {'duration':10s} {fields['duration_ms']:10.1f} ms   {fields['events']} events, {fields['lost']} lost")
    truth = fields.get("truth")
    if truth:
        told = ", ".join(
            f"{name.removesuffix('_error_um')} {value:+.2f} um"
            for name, value in truth.items()
            if name.endswith("_error_um") and value is not None
        )
        print(f"  the simulator knows: {told}")
    if fields.get("run"):
        print(f"  recorded in {fields['run']}")
