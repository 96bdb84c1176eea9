"""The words that programs read."""

from __future__ import annotations

from elpd.client import aio
from elpd.errors import ElpdError, UnreachableError


def everything(kind: type[ElpdError]) -> list[type[ElpdError]]:
    return [kind, *(below for child in kind.__subclasses__() for below in everything(child))]


def test_a_rooms_own_error_is_told_by_the_public_word() -> None:
    own = [kind for kind in everything(UnreachableError) if kind.__module__ == aio.__name__]
    assert [kind.kind for kind in own] == [UnreachableError.kind]
    assert not [kind for kind in everything(ElpdError) if kind.kind.startswith("_")]
