"""Write elpd(1): the commands and options as the program itself knows them, the rest by hand.

    python tools/manpage.py >elpd.1

The page is made when it is installed (`tools/install`), so it cannot be older than the program.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from elpd import __version__
from elpd.cli import root

if TYPE_CHECKING:
    from collections.abc import Iterator

OPENING = r"""
.SH NAME
elpd \- real-time autofocus for event cameras
.SH SYNOPSIS
.B elpd
.RI [ options ]
.I command
.RI [ arguments ]
.SH DESCRIPTION
The lens sweeps once while an event camera watches; the moment the sign of the Event Laplacian Product changes the lens
has passed focus, and it is stopped and brought to rest there.
.PP
.B elpd serve
owns the camera and the lens and answers on a socket; most other commands ask it, or, with
.BR \-\-foreground ,
.B \-\-config
or
.BR \-\-set ,
do their work from their own process.
"""

CLOSING = r"""
.SH EXIT STATUS
.TP
.B 0
in focus, or done
.TP
.B 1
not in focus, or cancelled; the result says why
.TP
.B 2
wrong usage or configuration; nothing has moved
.TP
.B 3
a device is missing, lost or does not obey
.TP
.B 4
somebody else holds the rig, or nobody answers
.TP
.B 130
interrupted
.SH FILES
.TP
.I /etc/elpd/elpd.toml
configuration of the service; every key is explained in it
.TP
.I /run/elpd/elpd.sock
the socket of the service
.TP
.I /var/lib/elpd
profiles and state;
.I runs
in it holds the recorded cycles
.TP
.I /var/log/elpd/elpd.jsonl
log of the service, one JSON object a line
.TP
.I ~/.local/state/elpd
profiles of those who work without the service
.SH ENVIRONMENT
.TP
.B XDG_STATE_HOME
where profiles lie, in a folder
.IR elpd
.TP
.B NUMBA_CACHE_DIR
where compiled kernels are kept
.TP
.B JOURNAL_STREAM
set by systemd: log lines then go to the journal, with a field for every value
.SH EXAMPLES
.EX
elpd demo
elpd check --config /etc/elpd/elpd.toml
systemctl start elpd && elpd focus --json
elpd focus --foreground --set sim.seed=3
journalctl \-u elpd ELPD_EVENT="focus cycle"
.EE
.SH SEE ALSO
.BR journalctl (1),
.BR systemctl (1),
.BR udev (7)
"""


def main() -> None:
    """Print the page."""
    print(page(), end="")


def page() -> str:
    """Return the page as roff."""
    lines = [f'.TH ELPD 1 "" "elpd {_text(__version__)}" "User Commands"', ".nh", ".ad l", OPENING.strip()]
    lines += [".SH OPTIONS", *_options(root), ".SH COMMANDS"]
    context = click.Context(root, info_name="elpd")
    for name, command in _commands(root, context):
        usage = " ".join(command.collect_usage_pieces(click.Context(command, info_name=name, parent=context)))
        lines += [
            ".SS",
            rf"\fBelpd {_text(name)}\fR {_text(usage)}",
            *_paragraphs(command.help or ""),
            *_options(command),
        ]
    return "\n".join([*lines, CLOSING.strip()]) + "\n"


def _commands(group: click.Group, context: click.Context, above: str = "") -> Iterator[tuple[str, click.Command]]:
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield f"{above}{name}", command
        if isinstance(command, click.Group):
            yield from _commands(command, context, f"{above}{name} ")


def _options(command: click.Command) -> list[str]:
    """Return the options as tagged paragraphs, each with its help."""
    lines = []
    context = click.Context(command)
    for option in command.params:
        record = option.get_help_record(context)
        if isinstance(option, click.Option) and record is not None:
            lines += [".TP", rf"\fB{_text(record[0])}\fR", _text(record[1])]
    return lines


def _paragraphs(text: str) -> list[str]:
    r"""Return a docstring's paragraphs; those that follow ``\b`` keep their lines."""
    lines = []
    for paragraph in text.strip().split("\n\n"):
        rows = [row.strip() for row in paragraph.splitlines()]
        if rows[0] == "\b":
            lines += [".PP", ".nf", *map(_text, rows[1:]), ".fi"]
        else:
            lines += [".PP", _text(" ".join(rows))]
    return lines


def _text(text: str) -> str:
    """Escape what roff would take for its own."""
    text = re.sub(r"\s+", " ", text.replace("\b", "")).strip()
    text = text.replace("\\", r"\e").replace("-", r"\-").replace("`", r"\(ga")
    return rf"\&{text}" if text[:1] in {".", "'"} else text


if __name__ == "__main__":
    main()
