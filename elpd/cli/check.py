"""`elpd check`: what is installed, what is plugged in, and does it work."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import click

from elpd.cli import inspection
from elpd.cli.common import config_options, json_option, print_json
from elpd.cli.inspection import Finding, Status

if TYPE_CHECKING:
    from pathlib import Path

_COLOURS = {Status.OK: "green", Status.NOTE: "yellow", Status.PROBLEM: "red"}
_STEP_WIDTH = 120


@click.command("check")
@config_options
@json_option
def command(*, config_path: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Look at this installation and focus the simulated rig once.

    Exit 0 when focusing works here (notes are about what is optional), 2 when the configuration is wrong, 3 when the
    self-test fails.
    """
    findings = [
        *inspection.versions(),
        *inspection.kernels(),
        *inspection.drivers(),
        *inspection.devices(),
        *inspection.real_time(),
        inspection.configuration(config_path, overrides),
        inspection.self_test(inspection.focus_simulated),
    ]
    code = exit_code(findings)
    if as_json:
        print_json(fields(findings, code))
    else:
        tell(findings)
    return code


def exit_code(findings: list[Finding]) -> int:
    """Return 3 if the self-test failed, else 2 if the configuration is wrong, else 0."""
    broken = {finding.section for finding in findings if finding.status is Status.PROBLEM}
    if broken & {"self-test", "kernels"}:
        return 3
    return 2 if "configuration" in broken else 0


def fields(findings: list[Finding], code: int) -> dict[str, Any]:
    """Return all findings as one object, grouped by section."""
    answer: dict[str, Any] = {"ok": code == 0}
    for finding in findings:
        answer.setdefault(finding.section.replace(" ", "_").replace("-", "_"), []).append(
            {
                "name": finding.name,
                "status": finding.status.value,
                "found": finding.found,
                "next_step": finding.next_step,
                **finding.data,
            }
        )
    return answer


def tell(findings: list[Finding]) -> None:
    """Print an aligned list, each problem followed by what to do."""
    width = max(len(finding.name) for finding in findings)
    section = ""
    for finding in findings:
        if finding.section != section:
            section = finding.section
            click.secho(f"{section}", bold=True)
        status = click.style(f"{finding.status.value:8s}", fg=_COLOURS[finding.status])
        click.echo(f"  {status}{finding.name:{width}s}  {finding.found}")
        if finding.next_step is not None:
            indent = " " * (width + 12)
            told, *to_type = finding.next_step.splitlines()
            click.echo(
                textwrap.fill(
                    told,
                    _STEP_WIDTH,
                    initial_indent=f"{indent}-> ",
                    subsequent_indent=f"{indent}   ",
                    break_long_words=False,
                    break_on_hyphens=False,
                )
            )
            for line in to_type:  # whole, so that it can be copied
                click.echo(f"{indent}   {line}")
