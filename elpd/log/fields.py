"""Values of log lines as text: JSON that every parser takes, whatever a library bound."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import structlog

if TYPE_CHECKING:
    from structlog.typing import EventDict


def json_text(value: Any) -> str:
    """Return JSON on one line; NaN is ``null``, a path its text, a numpy number a number, anything else its ``str``."""
    from pydantic_core import to_json  # noqa: PLC0415  (not for `elpd --help`)

    return to_json(value, inf_nan_mode="null", fallback=_plain).decode("utf-8")


def with_traceback(event: EventDict) -> dict[str, Any]:
    """Turn ``exc_info`` into text under ``exception``."""
    return dict(structlog.processors.format_exc_info(None, "", event))


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
