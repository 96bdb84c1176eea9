"""What is kept from one life of the daemon to the next: read once, written after each change, and said if it fails."""

from __future__ import annotations

from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from elpd.service.kept import Kept
    from elpd.service.situation import Situation

log = structlog.get_logger(__name__)


class Books:
    """Keeps *kept* on the disk, and tells *situation* what is wrong with it."""

    def __init__(self, kept: Kept, situation: Situation) -> None:
        self._kept, self._situation = kept, situation

    def remember(self) -> bool:
        """Begin with what was kept; say whether the daemon before ended badly, and its lens must be homed."""
        kept = self._kept.content
        self._situation.set_roi(kept.roi)
        if self._kept.complaint is not None:
            self._situation.warn("state-damaged", self._kept.complaint)
            log.warning("state damaged", reason=self._kept.complaint)
        if kept.open:
            log.warning("daemon ended badly before")
            why = "the daemon before did not end in order; the lens may be anywhere: home it"
            self._situation.warn("ended-badly", why)
        return kept.open

    def save(self) -> None:
        """Write what has changed; what cannot be written stays in memory, and that is told."""
        try:
            self._kept.save()
        except OSError as error:
            text = f"{self._kept.path}: {error.strerror or error}; what was set is lost when the daemon ends"
            self._situation.warn("state-not-saved", text)
            log.warning("state not saved", reason=text)
        else:
            self._situation.unwarn("state-not-saved")
