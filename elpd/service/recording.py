"""`record`: what the camera says while the lens stands still, as a run's folder without a decision."""

from __future__ import annotations

from typing import TYPE_CHECKING

from elpd.errors import UsageError
from elpd.events.stream import PacketDecoder
from elpd.record.journal import RunWriter
from elpd.service.messages import RecordAnswer
from elpd.units import NS_PER_S, HostNs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from elpd.config import Config
    from elpd.ports import RigParts
    from elpd.service.messages import RecordParams

READ_TIMEOUT_S = 0.01
FLUSH_EVERY_S = 0.25
"""Nothing moves, so what has gathered is written as it comes."""


def record(params: RecordParams, parts: RigParts, config: Config, interrupted: Callable[[], int]) -> RecordAnswer:
    """Record for so long, or until interrupted. Raises ``UsageError`` where nothing can be written.

    A disk that fills up ends the recording, marked truncated, with what was written until then.
    """
    if not config.journal.enabled:
        raise UsageError("journal.enabled is false: there is nowhere to record to; set it true")
    events = 0
    with RunWriter.begin(config, {"record_s": params.seconds, "name": params.name}, parts) as run:
        if run.path is None:
            raise UsageError(f"nothing can be recorded: {run.truncated}")
        camera, clock = run.parts.camera, run.parts.clock
        decoder = PacketDecoder(camera.geometry)
        camera.start()
        try:
            begun_ns = flushed_ns = clock.now_ns()
            until = HostNs(begun_ns + round(params.seconds * NS_PER_S))
            while (now := clock.now_ns()) < until and not interrupted() and run.truncated is None:
                packet = camera.read(min(READ_TIMEOUT_S, (until - now) / NS_PER_S))
                run.parts.lens.poll()
                if packet is not None:
                    events += int(decoder.feed(packet).t.size)
                if now - flushed_ns > FLUSH_EVERY_S * NS_PER_S:
                    flushed_ns = now
                    run.flush()
        finally:
            camera.stop()
        run.finish({"outcome": "RECORDED", "reason": run.truncated or "recorded", "events": events})
        path = run.path
    if params.name is not None:
        path = _renamed(path, params.name)
    return RecordAnswer(path=str(path), bytes=_size(path), events=events)


def _renamed(path: Path, name: str) -> Path:
    """Give a folder its name: one that bears a name of somebody's is kept for ever."""
    wanted = path.with_name(name.replace(" ", "-"))
    if wanted.exists():
        raise UsageError(f"{wanted} is there already; the recording is {path}; choose another name")
    return path.rename(wanted)


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
