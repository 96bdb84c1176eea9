"""JSON that a schema allows, and JSON that it does not: strategies for as much of JSON Schema as ours uses."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import hypothesis.strategies as st

SCHEMA: dict[str, Any] = json.loads(
    Path(__file__).parents[1].joinpath("elpd/service/schema.json").read_text(encoding="utf-8")
)

ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


def allowed(node: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Return what *node* allows."""
    if "$ref" in node:
        return allowed(SCHEMA["$defs"][node["$ref"].removeprefix("#/$defs/")])
    if "enum" in node:
        return st.sampled_from(node["enum"])
    if "anyOf" in node:
        return st.one_of([allowed(one) for one in node["anyOf"]])
    return {
        "null": st.none,
        "boolean": st.booleans,
        "integer": lambda: st.integers(node.get("minimum", -100), node.get("maximum", 100_000)),
        "number": lambda: _numbers(node),
        "string": lambda: _strings(node),
        "array": lambda: st.lists(allowed(node["items"]), max_size=4),
        "object": lambda: _objects(node),
    }[node["type"]]()


def params(method: str) -> st.SearchStrategy[Any]:
    """Return parameters of *method* that its schema allows."""
    return allowed(SCHEMA["methods"][method]["params"])


def _objects(node: dict[str, Any]) -> st.SearchStrategy[Any]:
    strategies = {name: allowed(value) for name, value in node.get("properties", {}).items()}
    required = {name: strategies[name] for name in node.get("required", [])}
    optional = {name: value for name, value in strategies.items() if name not in required}
    return st.fixed_dictionaries(required, optional=optional)


def _strings(node: dict[str, Any]) -> st.SearchStrategy[str]:
    # A schema's patterns are ECMAScript's, whose words are of ASCII letters.
    if "pattern" not in node:
        return st.text(min_size=node.get("minLength", 0), max_size=node.get("maxLength", 20))
    most = node.get("maxLength", 64)
    return st.from_regex(re.compile(node["pattern"], re.ASCII), fullmatch=True).filter(lambda text: len(text) <= most)


def _numbers(node: dict[str, Any]) -> st.SearchStrategy[float]:
    low = node.get("minimum", node.get("exclusiveMinimum", -1e6))
    high = node.get("maximum", 1e6)
    return st.floats(low, high, exclude_min="exclusiveMinimum" in node)
