"""What every test may rely on: no profile and no daemon of the machine's own is in reach."""

from pathlib import Path

import pytest
from hypothesis import settings

# How long an example takes says more about who else uses the machine than about the code.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def _no_profiles_of_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(nowhere(tmp_path_factory)))


@pytest.fixture(autouse=True)
def _no_daemon_of_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setenv("ELPD_SOCKET", str(nowhere(tmp_path_factory) / "elpd.sock"))


def nowhere(factory: pytest.TempPathFactory) -> Path:
    return factory.getbasetemp() / "state-of-nobody"
