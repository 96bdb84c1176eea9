"""Write what follows from the socket's messages (``elpd/service/messages.py``): the schema, and the client's types.

    python tools/schema.py            writes elpd/service/schema.json, elpd/client/shapes.py, elpd/client/methods.py
    python tools/schema.py --check    says which of them is not what the messages make of it, and exits 1

The client may not import pydantic, and its types may not be a second opinion; so they are written by this.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic.json_schema import models_json_schema

from elpd.service.messages import (
    ANSWERS,
    LEASE_FREE,
    METHODS,
    OBSERVING,
    PROTOCOL,
    DroppedEvent,
    ErrorBody,
    FaultEvent,
    PhaseEvent,
    PositionEvent,
    ResultEvent,
    SampleEvent,
    StateEvent,
    schema_digest,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = ROOT / "elpd/service/schema.json"
SHAPES = ROOT / "elpd/client/shapes.py"
CALLS = ROOT / "elpd/client/methods.py"

EVENTS = (SampleEvent, PhaseEvent, ResultEvent, FaultEvent, StateEvent, PositionEvent, DroppedEvent)
BY_HAND = {"focus", "subscribe"}
"""The client writes these itself: one takes patience, the other is `events`."""

SAYS_NULL = ("roi", "set")
"""The one parameter in which ``null`` is not the same as nothing."""

WRITTEN = "Written by ``tools/schema.py``; change ``elpd/service/messages.py`` and run that."
SCALARS = {
    "integer": "int",
    "number": "float",
    "string": "str",
    "boolean": "bool",
    "null": "None",
    "object": "dict[str, Any]",
    "Unset": "Unset",
}


def schema() -> dict[str, Any]:
    """Return the JSON Schema of all methods and events."""
    models = {
        **dict.fromkeys(METHODS.values(), "validation"),
        **dict.fromkeys((*ANSWERS.values(), *EVENTS, ErrorBody), "serialization"),
    }
    references, definitions = models_json_schema(list(models.items()), ref_template="#/$defs/{model}")  # type: ignore[arg-type]

    def of(model: Any) -> Any:
        return references[model, models[model]]

    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "elpd's socket: one JSON object a line",
        "protocol": PROTOCOL,
        "digest": schema_digest(),
        "methods": {
            name: {
                "params": of(METHODS[name]),
                "result": of(ANSWERS[name]),
                "operates": name not in OBSERVING,
                "lease_free": name in OBSERVING or name in LEASE_FREE,
            }
            for name in METHODS
        },
        "events": {model.model_fields["event"].default: of(model) for model in EVENTS},
        "error": of(ErrorBody),
        **definitions,
    }


def shapes(whole: dict[str, Any]) -> str:
    """Return the source of the client's types: what is answered and told, as ``TypedDict``."""
    definitions = whole["$defs"]
    names = [_name(method["result"]) for method in whole["methods"].values()]
    names += [_name(event) for event in whole["events"].values()]
    told = {_name(event) for event in whole["events"].values()}
    classes = [_class(name, definitions[name], told=name in told) for name in _in_order(names, definitions)]
    events = " | ".join(_name(event) for event in whole["events"].values())
    return "\n".join(
        [
            f'"""What the daemon answers and tells, as types.\n\n{WRITTEN}\n"""',
            "",
            "from __future__ import annotations",
            "",
            "from typing import Any, Literal, TypedDict",
            "",
            *classes,
            "",
            "class Reconnected(TypedDict):",
            '    """The client\'s own: the daemon had gone, and what happened meanwhile was not told."""',
            "",
            '    event: Literal["reconnected"]',
            "    seq: int",
            "",
            "",
            f"Event = {events} | Reconnected",
            '"""What `events` yields."""',
            "",
        ]
    )


def calls(whole: dict[str, Any]) -> str:
    """Return the source of the client's methods, waiting and awaiting."""
    named = sorted(
        {_name(method["result"]) for name, method in whole["methods"].items() if name not in BY_HAND} | {"RoiBox"}
    )
    return "\n".join(
        [
            f'"""The socket\'s methods, one by one.\n\n{WRITTEN}\n"""',
            "",
            "# ruff: noqa: A002, D401, E501  (the names and the words are the messages')",
            "from __future__ import annotations",
            "",
            "from typing import TYPE_CHECKING, Any, Literal",
            "",
            "from elpd.client.wire import NULL, UNSET, Unset, given",
            "",
            "if TYPE_CHECKING:",
            f"    from elpd.client.shapes import {', '.join(named)}",
            "",
            "",
            "class Methods:",
            '    """What can be asked; each waits for its answer, *timeout_s* at most."""',
            "",
            "    def call(",
            "        self, method: str, params: dict[str, Any] | None = None, timeout_s: float | None = None",
            "    ) -> Any:",
            '        """Ask for any method and return its result."""',
            "        raise NotImplementedError",
            "",
            *[line for name in METHODS if name not in BY_HAND for line in _method(name, whole, "")],
            "",
            "class AsyncMethods:",
            '    """What can be asked; each awaits its answer, *timeout_s* at most."""',
            "",
            "    async def call(",
            "        self, method: str, params: dict[str, Any] | None = None, timeout_s: float | None = None",
            "    ) -> Any:",
            '        """Ask for any method and return its result."""',
            "        raise NotImplementedError",
            "",
            *[line for name in METHODS if name not in BY_HAND for line in _method(name, whole, "async ")],
        ]
    )


def outputs() -> dict[Path, str]:
    """Return every file that this writes."""
    whole = schema()
    return {
        SCHEMA: json.dumps(whole, indent=1, sort_keys=False) + "\n",
        SHAPES: _formatted(shapes(whole)),
        CALLS: _formatted(calls(whole)),
    }


def main() -> int:
    """Write the files, or check them."""
    stale = [path for path, text in outputs().items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    for path in stale:
        if "--check" in sys.argv:
            print(f"{path.relative_to(ROOT)} is not what the messages make of it; run `python tools/schema.py`")
        else:
            path.write_text(outputs()[path], encoding="utf-8")
            print(f"wrote {path.relative_to(ROOT)}")
    return 1 if stale and "--check" in sys.argv else 0


def _method(name: str, whole: dict[str, Any], prefix: str) -> list[str]:
    method = whole["methods"][name]
    params = whole["$defs"][_name(method["params"])]
    answer = _name(method["result"])
    properties = params.get("properties", {})
    required = params.get("required", [])
    first = [f"{key}: {_type(properties[key])}" for key in required]
    last = ["timeout_s: float | None = None"]
    for key, value in properties.items():
        if key not in required:
            (last if value.get("type") == "boolean" else first).append(_optional(name, key, value))
    passed = ", ".join(
        f"{key}=NULL if {key} is None else {key}" if (name, key) == SAYS_NULL else f"{key}={key}" for key in properties
    )
    told = params["description"] if properties else whole["$defs"][answer]["description"]
    wait = "await " if prefix else ""
    return [
        f"    {prefix}def {name}({', '.join(['self', *first, '*', *last])}) -> {answer}:",
        f'        """{told}"""',
        f'        answer: {answer} = {wait}self.call("{name}", given({passed}), timeout_s)',
        "        return answer",
        "",
    ]


def _optional(method: str, key: str, value: dict[str, Any]) -> str:
    """Return a parameter that need not be given; ``None`` is the same as that, but for `roi`'s *set*."""
    if (method, key) == SAYS_NULL:
        return f"{key}: {_type({'anyOf': [*value['anyOf'][:-1], {'type': 'Unset'}, {'type': 'null'}]})} = UNSET"
    default = value.get("default")
    return f"{key}: {_type(value)} = {default if default is None or isinstance(default, bool) else json.dumps(default)}"


def _class(name: str, definition: dict[str, Any], *, told: bool) -> str:
    fields = [f"    {key}: {_type(value)}" for key, value in definition["properties"].items()]
    seq = ["    seq: int"] if told else []
    return "\n".join(["", f"class {name}(TypedDict):", f'    """{definition["description"]}"""', "", *fields, *seq, ""])


def _in_order(names: list[str], definitions: dict[str, Any]) -> list[str]:
    """Return *names* and all they refer to, what is referred to first."""
    order: list[str] = []

    def visit(name: str) -> None:
        if name in order:
            return
        for inner in _references(definitions[name]):
            visit(inner)
        order.append(name)

    for name in names:
        visit(name)
    return order


def _references(node: Any) -> list[str]:
    if isinstance(node, dict):
        own = [_name(node)] if "$ref" in node else []
        return own + [name for value in node.values() for name in _references(value)]
    return [name for value in node for name in _references(value)] if isinstance(node, list) else []


def _type(node: dict[str, Any]) -> str:
    """Return a schema as a Python type."""
    if "$ref" in node:
        return _name(node)
    if "const" in node:
        return f"Literal[{json.dumps(node['const'])}]"
    if "enum" in node:
        return f"Literal[{', '.join(json.dumps(value) for value in node['enum'])}]"
    if "anyOf" in node:
        return _either(_type(one) for one in node["anyOf"])
    if node.get("type") == "array":
        items = node.get("prefixItems") or [node.get("items", {})]
        return f"list[{_either(kind for one in items for kind in _type(one).split(' | '))}]"
    if node.get("type") == "object" and isinstance(node.get("additionalProperties"), dict):
        return f"dict[str, {_type(node['additionalProperties'])}]"
    return SCALARS.get(node.get("type", ""), "Any")


def _either(kinds: Iterable[str]) -> str:
    """Return a union, each kind once, ``None`` last."""
    return " | ".join(sorted(dict.fromkeys(kinds), key=lambda kind: kind == "None"))


def _name(reference: dict[str, str]) -> str:
    return reference["$ref"].removeprefix("#/$defs/")


def _formatted(source: str) -> str:
    """Return *source* as the formatter would leave it."""
    import subprocess  # noqa: PLC0415  (only those who write need ruff)

    done = subprocess.run(
        [sys.executable, "-m", "ruff", "format", "--stdin-filename", "written.py", "-"],
        input=source,
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
