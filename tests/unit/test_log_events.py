"""Event names are what programs look for: each is in tools/docs/events.md with level and fields, none is besides."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
LEVELS = {"debug", "info", "warning", "error", "exception", "critical"}


@dataclass(frozen=True, slots=True)
class Call:
    """A line of log in the code. *whole* is whether all its fields are named there."""

    level: str
    fields: frozenset[str]
    whole: bool
    where: str


def calls() -> Iterator[tuple[str, Call]]:
    for room in ("elpd", "drivers/elpd_drivers"):
        for path in sorted((ROOT / room).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if "structlog" not in text:
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in LEVELS:
                    where = f"{path.relative_to(ROOT)}:{node.lineno}"
                    assert node.args, f"{where}: a log event has a name"
                    name = node.args[0]
                    assert isinstance(name, ast.Constant), f"{where}: an event's name is a constant; values are fields"
                    fields = frozenset(word.arg for word in node.keywords if word.arg is not None) - {"exc_info"}
                    level = "error" if node.func.attr == "exception" else node.func.attr
                    yield str(name.value), Call(level, fields, all(word.arg for word in node.keywords), where)


def documented() -> dict[str, tuple[str, frozenset[str]]]:
    page = (ROOT / "tools" / "docs" / "events.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([^`]+)` \| ([\w, ]+) \| ([^|]*)\|", page, re.MULTILINE)
    assert len({name for name, _, _ in rows}) == len(rows), "an event is documented twice"
    return {name: (levels, frozenset(re.findall(r"`([a-z_]+)`", fields))) for name, levels, fields in rows}


def test_every_event_of_the_code_is_documented_as_it_is() -> None:
    page = documented()
    for name, call in calls():
        assert name in page, f"{call.where}: {name!r} is not in tools/docs/events.md"
        levels, fields = page[name]
        assert call.level in levels.split(", "), f"{call.where}: {name!r} is a {call.level}, documented as {levels}"
        assert call.fields <= fields, f"{call.where}: {name!r}: {set(call.fields - fields)} not documented"


def test_every_documented_event_and_field_is_in_the_code() -> None:
    page, known = documented(), list(calls())
    for name, (_, fields) in page.items():
        told = [call for other, call in known if other == name]
        bound = frozenset().union(*(call.fields for call in told))
        assert not all(call.whole for call in told) or bound == fields, f"{name!r} never has {set(fields - bound)}"
    assert set(page) == {name for name, _ in known}


def test_names_are_stable_words() -> None:
    for name, call in calls():
        assert re.fullmatch(r"[a-z][a-z0-9 ;,'\[\]-]*", name), f"{call.where}: {name!r} is not a lower-case phrase"
