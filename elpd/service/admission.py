"""Which requests may not move the lens now, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import FaultLatchedError, UnavailableError, UnreferencedError, UsageError
from elpd.service.messages import FocusParams

if TYPE_CHECKING:
    from elpd.service.engine_port import Request
    from elpd.service.messages import ModeName
    from elpd.service.situation import Situation

WITHOUT_REFERENCE = frozenset({"home", "record"})
"""What a lens that does not know where it is may be asked for."""


def refuse_motion(request: Request, situation: Situation, mode: ModeName, *, needs_home: bool) -> None:
    """Let a request that needs the lens or the camera pass, or raise an ``ElpdError`` that says what is in its way."""
    method, params = request.method, request.params
    fault = situation.fault
    if situation.state == "STARTING":
        raise UnavailableError("the daemon is starting; nothing was moved, ask again in a moment")
    if fault is not None:
        raise FaultLatchedError(
            f"nothing was moved: a fault is latched ({fault.kind}: {fault.message}); see to it, then clear it"
        )
    if method == "record" or (isinstance(params, FocusParams) and params.dry_run):
        return
    if method == "focus" and mode == "manual":
        raise UsageError("the mode is manual: autofocus never moves the lens; set another mode first")
    if method not in WITHOUT_REFERENCE and needs_home:
        raise UnreferencedError("the lens may have moved unseen and does not know where it is; home it first")
