"""`elpd focus`: one cycle, by the daemon or from here."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from elpd.cli.common import config_options, interruptible, json_option, parse_roi, print_json
from elpd.cli.daemon import daemon_unless, naming_the_holder, socket_option
from elpd.errors import UsageError
from elpd.records import Roi

if TYPE_CHECKING:
    from elpd.cli.view import View
    from elpd.config import Config


@click.command("focus")
@click.option(
    "--roi", metavar="X,Y,W,H", help="Where to focus, in sensor pixels; proposed (most texture) if not given."
)
@click.option("--reference", metavar="last|IMG", help="Focus on the last map, or on an image of the whole sensor.")
@click.option("--preset", metavar="NAME", help="Begin where this preset is, in its region (daemon only).")
@click.option("--foreground", is_flag=True, help="Focus from this process, not through the daemon.")
@click.option("--dry-run", is_flag=True, help="Everything but motion of the lens.")
@socket_option
@config_options
@json_option
def command(
    *,
    roi: str | None,
    reference: str | None,
    preset: str | None,
    foreground: bool,
    dry_run: bool,
    socket: Path | None,
    config_path: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    """Focus once: exit 0 in focus, 1 not found, 2 usage, 3 device, 4 busy or unreachable."""
    region = parse_roi(roi)
    client = daemon_unless(foreground=foreground, config_path=config_path, overrides=overrides, socket=socket)
    if client is None and preset is not None:
        raise UsageError("--preset: presets are the daemon's; leave out --foreground, --config and --set")
    from elpd.cli.view import open_view  # noqa: PLC0415  (after the request is known to be well formed: numpy)

    def focus(view: View | None) -> dict[str, Any]:
        if client is None:
            return _from_here(region, reference, config_path, overrides, view, dry_run=dry_run)
        from elpd.cli.focus_by_daemon import focus_by  # noqa: PLC0415

        return focus_by(client, roi=region, reference=reference, preset=preset, dry_run=dry_run, view=view)

    if as_json:
        fields = focus(None)
        print_json(fields)
    else:
        with open_view() as view:
            fields = focus(view)
        _tell(fields)
    return 0 if fields["outcome"] == "FOCUSED" else 1


def _from_here(
    region: Roi | None,
    reference: str | None,
    config_path: Path | None,
    overrides: tuple[str, ...],
    view: View | None,
    *,
    dry_run: bool,
) -> dict[str, Any]:
    from elpd.config import load  # noqa: PLC0415  (a daemon's client needs none of these)
    from elpd.focus.settings import FocusRequest  # noqa: PLC0415

    config = load(config_path, overrides)
    request = FocusRequest(
        roi=region or _configured_roi(config), reference=_reference_path(reference, config), dry_run=dry_run
    )
    from elpd.record.session import focus_once  # noqa: PLC0415  (numba, after the request is known to be well formed)

    with interruptible() as cancelled, naming_the_holder():
        session = focus_once(config, request, view, cancelled)
    if view is not None:
        view.result(session.result)
    return session.fields()


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
