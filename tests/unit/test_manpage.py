"""man elpd: every command and option is in it, and man formats it without a complaint."""

from __future__ import annotations

import re
import shutil
import subprocess
from typing import TYPE_CHECKING

import click
import pytest
from manpage import page

from elpd.cli import root

if TYPE_CHECKING:
    from collections.abc import Iterator


def commands(group: click.Group, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield (*above, name), command
        if isinstance(command, click.Group):
            yield from commands(command, (*above, name))


def plain(roff: str) -> str:
    return re.sub(r"\\f.|\\&", "", roff).replace(r"\-", "-").replace(r"\(ga", "`")


def test_every_command_and_option_is_there_under_its_command() -> None:
    opening, *sections = re.split(r"^\.SS\n", plain(page()), flags=re.MULTILINE)
    found = {section.splitlines()[0]: section for section in sections}
    told = list(commands(root))
    assert len(found) == len(told)
    for path, command in told:
        heading = next(
            head for head in found if head == (name := f"elpd {' '.join(path)}") or head.startswith(f"{name} ")
        )
        for option in command.params:
            names = option.opts if isinstance(option, click.Option) else [option.make_metavar(click.Context(command))]
            assert all(name in found[heading] for name in names), (path, names)
    assert all(name in opening for option in root.params for name in option.opts)


def test_man_reads_it_without_complaint() -> None:
    if shutil.which("groff") is None:
        pytest.skip("groff is not installed")
    done = subprocess.run(
        ["groff", "-man", "-Tutf8", "-ww", "-z", "-Kutf8"], input=page(), capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
