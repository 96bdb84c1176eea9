"""One booted systemd for all tests of a worker: it takes a second, and compiled kernels are kept in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import booted
import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="session")
def machine() -> Iterator[booted.Booted]:
    if (missing := booted.why_not()) is not None:
        pytest.skip(missing)
    files, binds = booted.installation()
    with booted.Booted(files, binds) as running:
        yield running
