from __future__ import annotations

import json

import pytest
import schema
from from_schema import ANY_JSON, SCHEMA, params
from hypothesis import assume, given
from hypothesis import strategies as st

from elpd.client.aio import AsyncClient
from elpd.client.sync import Client
from elpd.service.lines import RefusedLine, read_call
from elpd.service.messages import METHODS, schema_digest

ACROSS_FIELDS = {"move", "roi", "preset"}
"""Rules between two parameters, which the schema does not tell."""


def test_what_was_written_from_the_messages_is_what_they_say_now() -> None:
    for path, text in schema.outputs().items():
        assert path.read_text(encoding="utf-8") == text, "run `python tools/schema.py`"


def test_the_schema_names_every_method_and_its_own_digest() -> None:
    assert list(SCHEMA["methods"]) == list(METHODS)
    assert SCHEMA["digest"] == schema_digest()
    operating = {name for name, method in SCHEMA["methods"].items() if method["operates"]}
    assert operating >= {"focus", "stop", "cancel", "move", "home", "jog", "clear"}
    assert not operating & {"hello", "status", "metrics", "runs", "run", "map", "subscribe"}


def test_both_clients_have_every_method() -> None:
    for method in METHODS.keys() - {"subscribe"}:
        for client in (Client, AsyncClient):
            assert method in dir(client)
            assert getattr(client, method).__doc__


@pytest.mark.parametrize("method", METHODS)
def test_what_the_schema_allows_is_understood(method: str) -> None:
    @given(params(method), st.none() | st.integers(-(2**63), 2**63 - 1) | st.text("abc", max_size=64))
    def understood(asked: dict[str, object], number: object) -> None:
        line = json.dumps({"id": number, "method": method, "params": asked}).encode()
        try:
            call = read_call(line)
        except RefusedLine:
            if method not in ACROSS_FIELDS:
                raise
            return
        assert (call.method, call.number) == (method, number)
        assert call.params.model_dump(mode="json", exclude_unset=True) == asked

    understood()


@pytest.mark.parametrize("method", METHODS)
def test_a_parameter_that_the_schema_does_not_know_is_refused(method: str) -> None:
    @given(params(method), st.text(max_size=10), ANY_JSON)
    def refused(asked: dict[str, object], name: str, value: object) -> None:
        assume(name not in METHODS[method].model_fields)
        with pytest.raises(RefusedLine) as caught:
            read_call(json.dumps({"method": method, "params": asked | {name: value}}).encode())
        assert caught.value.error.kind == "UsageError"

    refused()
