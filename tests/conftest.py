"""What every test may rely on: no profile of the machine's own is in reach."""

from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("untimed", deadline=None)  # a busy machine is not a failing test
settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def _no_profiles_of_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(nowhere(tmp_path_factory)))


def nowhere(factory: pytest.TempPathFactory) -> Path:
    return factory.getbasetemp() / "state-of-nobody"
