"""What `elpd check` looks at: each question asked once, each answer a finding with what to do next.

A finding is never an exception. Somebody else's driver may fail in any way it likes when it is imported; that is one
line in the list and none of our business beyond it.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import platform
import time
from dataclasses import dataclass, field
from enum import Enum
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elpd import __version__
from elpd.errors import ElpdError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

DRIVER_GROUPS = ("elpd.rigs", "elpd.cameras", "elpd.lenses", "elpd.apertures", "elpd.formats", "elpd.boards")
DISCOVERY_GROUP = "elpd.discovery"

DRIVER_KEYS = {"camera": "camera.driver", "serial port": "lens.driver"}
NOTHING_FOUND = {
    "usb": ("no event camera", "for a real one: check its cable and power; `lsusb` lists all that this machine sees"),
    "serial": ("no serial port", "for a real lens: plug its controller in; `dmesg` tells why it does not come up"),
}
"""Of our own discoveries: what is not there, and what to do about it. The simulated rig needs neither."""


_MCL_CURRENT_ON_FAULT = 1 | 4  # lock what is there, but do not page everything in just to find out


class Status(Enum):
    """How a finding is to be read."""

    OK = "ok"
    NOTE = "note"  # works without
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One answer. ``next_step`` is what a person does about it; ``data`` is for programs."""

    section: str
    name: str
    status: Status
    found: str
    next_step: str | None = None
    data: dict[str, Any] = field(default_factory=dict)


def versions() -> list[Finding]:
    """Say what runs here."""
    findings = [
        Finding("versions", "elpd", Status.OK, __version__),
        Finding("versions", "python", Status.OK, f"{platform.python_version()} on {platform.machine()}"),
    ]
    for package in ("numpy", "numba", "opencv-python-headless"):
        try:
            findings.append(Finding("versions", package, Status.OK, version(package)))
        except PackageNotFoundError:
            findings.append(
                Finding("versions", package, Status.NOTE, "not installed under this name", f"pip install {package}")
            )
    return findings


def kernels() -> list[Finding]:
    """Import every room with kernels: they compile, or come from the cache, right then."""
    from elpd.service.compiling import by_others, modules  # noqa: PLC0415  (numba, only for this)

    begun = time.perf_counter()
    found: dict[str, Any] = {}
    try:
        names = modules(files=True)  # and with them, for two processes share the work, what the self-test needs
        with by_others([*names, *(point.module for point in entry_points(group="elpd.rigs"))]):
            for module in names:
                found |= _dispatchers(importlib.import_module(module))
    except Exception as error:  # noqa: BLE001  (numba raises many kinds; each means the same to the person)
        return [
            Finding(
                "kernels",
                "compile",
                Status.PROBLEM,
                f"{type(error).__name__}: {error}",
                "reinstall numba and llvmlite in versions that belong together",
            )
        ]
    seconds = time.perf_counter() - begun
    loaded = sum(sum(kernel.stats.cache_hits.values()) for kernel in found.values())
    data = {"kernels": len(found), "from_cache": loaded, "seconds": round(seconds, 3)}
    text = f"{len(found)} ready in {seconds:.1f} s, {loaded} signatures from the cache"
    return [Finding("kernels", "compile", Status.OK, text, data=data), _cache(found)]


def drivers(groups: Iterable[str] = DRIVER_GROUPS) -> list[Finding]:
    """Import every registered driver, ours and strangers'."""
    findings = []
    for group in groups:
        for point in sorted(entry_points(group=group), key=lambda point: point.name):
            data = {"group": group, "driver": point.name, "value": point.value}
            owner = "" if point.dist is None else f" ({point.dist.name} {point.dist.version})"
            name = f"{group.removeprefix('elpd.')}: {point.name}"
            try:
                point.load()
            except (Exception, SystemExit) as error:  # noqa: BLE001  (a stranger's module may fail in any way it likes)
                reason = f"{type(error).__name__}: {error}"
                step = f"install what it needs, or uninstall it; `python -c 'import {point.module}'` shows the details"
                findings.append(
                    Finding("drivers", name, Status.NOTE, f"{reason}{owner}", step, data | {"error": reason})
                )
            else:
                findings.append(
                    Finding("drivers", name, Status.OK, f"{point.value}{owner}", data=data | {"error": None})
                )
    return findings


def devices() -> list[Finding]:
    """Ask every discovery what is plugged in."""
    findings = []
    for point in sorted(entry_points(group=DISCOVERY_GROUP), key=lambda point: point.name):
        try:
            found = point.load()()
        except (Exception, SystemExit) as error:  # noqa: BLE001  (a stranger's module may fail in any way it likes)
            findings.append(Finding("devices", point.name, Status.NOTE, f"cannot look: {error}"))
            continue
        if not found:
            found_none, step = NOTHING_FOUND.get(point.name, ("nothing found", None))
            findings.append(Finding("devices", point.name, Status.NOTE, found_none, step))
        for device in found:
            data = {
                "kind": device.kind,
                "device": device.name,
                "where": device.where,
                "drivers": list(device.drivers),
            }
            status = Status.OK if device.next_step is None else Status.PROBLEM
            key = DRIVER_KEYS.get(device.kind, "driver")
            opened_by = f", {key} = {' or '.join(device.drivers)}" if device.drivers else ""
            told = f"{device.where}  {device.name}{opened_by}"
            findings.append(Finding("devices", device.kind, status, told, device.next_step, data))
    return findings


def real_time() -> list[Finding]:
    """Try what the daemon would like to do, and take it back at once."""
    return [
        _privilege(
            "SCHED_FIFO",
            _try_fifo,
            "focus will share the CPU with everything else; allow LimitRTPRIO=20 (systemd) or rtprio in limits.conf",
        ),
        _privilege(
            "mlockall",
            _try_mlockall,
            "memory may be paged out; allow LimitMEMLOCK=infinity (systemd) or memlock in limits.conf",
        ),
    ]


def configuration(path: Path | None, overrides: tuple[str, ...]) -> Finding:
    """Read the configuration and see whether the drivers that it names exist."""
    from elpd.config import load  # noqa: PLC0415  (pydantic, only when it is this question's turn)

    name = str(path) if path is not None else "defaults"
    step = "correct the key or value; config/elpd.toml lists all with their meaning"
    try:
        config = load(path, overrides)
    except ElpdError as error:
        return Finding("configuration", name, Status.PROBLEM, str(error), step)
    for name_of_section, group in (("camera", "elpd.cameras"), ("lens", "elpd.lenses"), ("aperture", "elpd.apertures")):
        section = getattr(config, name_of_section)
        known = {point.name for point in entry_points(group=group)}
        if section.driver not in known | {"sim"}:
            found = f"{name_of_section}.driver is {section.driver!r}; installed: {', '.join(sorted(known)) or 'none'}"
            return Finding("configuration", name, Status.PROBLEM, found, step)
    return Finding("configuration", name, Status.OK, f'valid, rig = "{config.rig}"')


def self_test(focus: Callable[[], dict[str, Any]]) -> Finding:
    """Focus the simulated rig once, in virtual time. *focus* returns the JSON fields of `elpd focus`."""
    begun = time.perf_counter()
    step = "the installation is damaged or this machine computes differently; reinstall, then report this output"
    try:
        fields = focus()
    except Exception as error:  # noqa: BLE001  (whatever breaks here is exactly what the test is for)
        return Finding("self-test", "focus", Status.PROBLEM, f"{type(error).__name__}: {error}", step)
    seconds = time.perf_counter() - begun
    data = {key: fields.get(key) for key in ("outcome", "reason", "duration_ms", "truth")} | {
        "seconds": round(seconds, 3)
    }
    if fields["outcome"] != "FOCUSED":
        return Finding("self-test", "focus", Status.PROBLEM, f"{fields['outcome']}: {fields['reason']}", step, data)
    error_um = (fields.get("truth") or {}).get("final_error_um")
    distance = "" if error_um is None else f", {abs(error_um):.2f} um from true focus"
    found = f"FOCUSED in {fields['duration_ms']:.0f} ms of simulated time{distance} ({seconds:.1f} s here)"
    return Finding("self-test", "focus", Status.OK, found, data=data)


def focus_simulated() -> dict[str, Any]:
    """Run one whole cycle on the default simulated rig, unrecorded."""
    from elpd.config import Config  # noqa: PLC0415
    from elpd.focus.settings import FocusRequest  # noqa: PLC0415
    from elpd.record.session import focus_once  # noqa: PLC0415  (numba and the simulator, only for the self-test)

    config = Config.model_validate({"rig": "sim", "journal": {"enabled": False}, "sim": {"pace": 0.0}})
    return focus_once(config, FocusRequest()).fields()


# --- parts -------------------------------------------------------------------------------------------------------


def _dispatchers(module: Any) -> dict[str, Any]:
    """Return the kernels that *module* defines, by full name."""
    return {
        f"{module.__name__}.{name}": value
        for name, value in vars(module).items()
        if hasattr(value, "nopython_signatures") and value.py_func.__module__ == module.__name__
    }


def _cache(found: dict[str, Any]) -> Finding:
    """Say whether compiled kernels can be kept. ``stats`` is numba's own view of a kernel's cache."""
    paths = sorted({str(kernel.stats.cache_path) for kernel in found.values() if kernel.stats.cache_path})
    if not paths:
        step = "set NUMBA_CACHE_DIR to a folder that can be written; until then every start compiles"
        return Finding("kernels", "cache", Status.NOTE, "none", step, {"path": None, "writable": False})
    # A kernel's folder is made when its first compilation is kept; until then its parents decide.
    closed = [path for path in paths if not os.access(_nearest_existing(Path(path)), os.W_OK)]
    data = {"path": paths[0], "writable": not closed}
    if closed:
        step = "set NUMBA_CACHE_DIR to a folder that can be written, or live with compiling at every start"
        return Finding("kernels", "cache", Status.NOTE, f"not writable: {closed[0]}", step, data)
    return Finding("kernels", "cache", Status.OK, f"writable: {paths[0]}", data=data)


def _nearest_existing(path: Path) -> Path:
    while not path.exists():
        path = path.parent
    return path


def _privilege(name: str, attempt: Callable[[], str | None], consequence: str) -> Finding:
    refused = attempt()
    data = {"allowed": refused is None}
    if refused is None:
        return Finding("real time", name, Status.OK, "allowed", data=data)
    return Finding("real time", name, Status.NOTE, f"not allowed ({refused})", consequence, data)


def _try_fifo() -> str | None:
    if not hasattr(os, "sched_setscheduler"):
        return "this system has no such scheduler"
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError as error:
        return error.strerror
    os.sched_setscheduler(0, before, parameters)
    return None


def _try_mlockall() -> str | None:
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        refused = libc.mlockall(_MCL_CURRENT_ON_FAULT)
    except (OSError, AttributeError):
        return "this system has no mlockall"
    if refused:
        return os.strerror(ctypes.get_errno())
    libc.munlockall()
    return None
