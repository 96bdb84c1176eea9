"""The command line: one file per command, loaded when it is called.

`elpd --help` must not import numba, so the group knows its commands by name and imports a command's module only to run
it (or to print its own help). Everything that programs read goes to stdout as one JSON object; everything for people
that is not the answer goes to stderr.
"""

from __future__ import annotations

import importlib
import io
import sys
from pathlib import Path
from typing import ClassVar, cast

import click

from elpd import __version__, log
from elpd.cli.common import report_error
from elpd.errors import ElpdError

COMMANDS = {
    "calibrate": "measure the rig itself: aperture, backlash, lens, sensor",
    "cancel": "end what the daemon runs",
    "check": "what is installed, what is plugged in, and does it work",
    "clear": "clear the daemon's latched fault",
    "convert": "an event file in another format, or a part of one",
    "decode": "what an event file holds",
    "demo": "focus the embedded simulated rig, live in the terminal",
    "detect": "the causal detector over a recorded sweep",
    "expose": "stage 1 alone: open the aperture, make the map",
    "focus": "one focus cycle",
    "home": "find the lens's reference",
    "jog": "move the lens by so much",
    "lease": "keep the rig for oneself",
    "map": "the daemon's newest picture, to a file",
    "metrics": "counters and latencies, for Prometheus",
    "mode": "when the daemon focuses by itself",
    "move": "move the lens to a place",
    "park": "stop the lens past any daemon: the last resort",
    "preset": "places of the lens that the daemon remembers",
    "record": "what the camera sees, to a file; nothing moves",
    "replay": "run a recorded cycle again, to the same decision",
    "report": "a recorded run as one HTML page",
    "roi": "the daemon's regions",
    "runs": "the recorded cycles",
    "serve": "the daemon: own the rig, answer on a socket",
    "sim-board": "a simulated lens controller on a pty",
    "status": "how the daemon and its rig are",
    "stop": "stop the lens now",
    "temperature": "tell what a thermometer at the lens reads",
    "temporal-map": "an HDR picture from a recorded aperture opening",
    "web": "the page, for browsers",
}


class LazyGroup(click.Group):
    """A group whose commands live in ``elpd.cli.<prefix><name>`` and are imported on demand."""

    table: ClassVar[dict[str, str]] = COMMANDS
    prefix: ClassVar[str] = ""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Name every command, without importing any."""
        del ctx
        return sorted(self.table)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command's module and return its ``command``."""
        if cmd_name not in self.table:
            ctx.fail(f"there is no command {cmd_name!r}; there are {', '.join(sorted(self.table))}")
        module = importlib.import_module(f"elpd.cli.{self.prefix}{cmd_name.replace('-', '_')}")
        return cast("click.Command", module.command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands from the table, so that help stays light."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl(sorted(self.table.items()))


@click.command(cls=LazyGroup, no_args_is_help=False, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="elpd")
@click.option("--verbose", "-v", is_flag=True, help="Log what happens, to stderr.")
@click.option(
    "--log",
    "log_file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Log to this file too, one JSON object a line.",
)
def root(*, verbose: bool, log_file: Path | None) -> None:
    """Real-time autofocus for event cameras."""
    log.configure(verbose=verbose, file=log_file)


def main() -> None:
    """Run the command line; every error ends here, without a traceback, with its own exit code."""
    as_json = "--json" in sys.argv
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a curve's dots must not break a terminal of few letters
    try:
        code = root.main(standalone_mode=False)
    except click.exceptions.Abort:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except click.ClickException as error:
        context = error.ctx if isinstance(error, click.UsageError) else None
        verb = context.command_path.rpartition("elpd")[2] if context is not None else ""
        report_error("UsageError", f"{error.format_message().rstrip('.')}; see `elpd{verb} --help`", as_json=as_json)
        sys.exit(2)
    except ElpdError as error:
        report_error(error.kind, str(error), as_json=as_json)
        sys.exit(error.exit_code)
    except OSError as error:  # a file or folder that is not ours to read or write; devices raise their own
        where = f"{error.filename}: " if error.filename else ""
        report_error("UsageError", f"{where}{error.strerror or error}", as_json=as_json)
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)
