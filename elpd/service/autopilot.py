"""What the daemon does by itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from elpd.service.job import Job


class Autopilot:
    """Nothing, yet."""

    def job(self) -> Job | None:
        return None

    def opened(self) -> None:
        return

    def rest(self, why: str) -> None:
        return

    def forget(self) -> None:
        return
