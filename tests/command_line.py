"""Calling the command line in this process, as a program calls it: arguments in, exit code and both streams out."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest

from elpd import cli

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SMALL_RIG = ("--set", "sim.width=320", "--set", "sim.height=240", "--set", "sim.scene=camera")


@dataclass(frozen=True, slots=True)
class Answer:
    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """The one object on stdout; anything else there is a failure."""
        assert self.out.endswith("\n")
        assert self.out.count("\n") == 1, self.out
        answer: dict[str, Any] = json.loads(self.out)
        return answer


def caller(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path) -> Callable[..., Answer]:
    """Return what runs ``elpd ARGUMENTS`` in *folder*."""
    monkeypatch.chdir(folder)

    def call(*arguments: str) -> Answer:
        monkeypatch.setattr(sys, "argv", ["elpd", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        code = ended.value.code
        return Answer(code if isinstance(code, int) else 0, out, err)

    return call
