"""What can go wrong, as a tree.

::

    ElpdError
    ├── UsageError            what the caller asked for cannot be done (exit code 2)
    │   ├── ConfigError       a configuration file or key
    │   └── FormatError       a file that is not what it claims to be
    ├── DeviceError           machinery broke (exit code 3); latched by the daemon
    │   ├── CameraError       camera missing, lost, or speaking nonsense
    │   ├── LensError         lens missing, lost, silent, alarmed, or running away
    │   │   └── UnreferencedError   the lens does not know where it is
    │   └── FaultLatchedError       a fault of before has not been cleared
    ├── BusyError             somebody else holds the rig (exit code 4)
    │   ├── UnavailableError        the daemon is starting or going down
    │   └── UnreachableError        no daemon answers
    ├── CancelledError        somebody ended it before it began (exit code 1)
    ├── ForbiddenError        the caller may look, not touch (exit code 4)
    ├── TooLargeError         a message past its limit (exit code 2)
    └── ReplayDiverged        a recorded run did not replay to the same calls

A focus that was not found is *not* an error: it is an ``Outcome`` (``elpd.records``). Every message says what was
measured, what the limit was, and what to do next.
"""

from typing import ClassVar


class ElpdError(Exception):
    """Base of everything elpd raises on purpose. ``kind`` is the stable word that programs read."""

    exit_code = 1
    kind: ClassVar[str] = "ElpdError"

    def __init_subclass__(cls) -> None:
        """Take the class's name for the stable word of the JSON interfaces, unless it says another or is private."""
        if not cls.__name__.startswith("_"):
            cls.kind = cls.__dict__.get("kind", cls.__name__)


class UsageError(ElpdError):
    """The request itself is wrong; nothing was moved."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration file, key or value is wrong."""


class FormatError(UsageError):
    """A file is not what it claims to be, or is damaged beyond use."""


class DeviceError(ElpdError):
    """Machinery broke. The lens has been told to stop before this is raised."""

    exit_code = 3


class CameraError(DeviceError):
    """The camera is missing, lost, or its data make no sense."""


class LensError(DeviceError):
    """The lens controller is missing, lost, silent, alarmed, or does not obey."""


class UnreferencedError(LensError):
    """The lens does not know where it is; ``home`` it."""

    kind = "Unreferenced"


class FaultLatchedError(DeviceError):
    """A fault of before has not been cleared; nothing was moved."""

    kind = "Fault"


class BusyError(ElpdError):
    """Somebody else holds the rig."""

    exit_code = 4


class UnavailableError(BusyError):
    """The daemon is starting or going down."""

    kind = "Unavailable"


class UnreachableError(BusyError):
    """No daemon answers, or not in time."""


class CancelledError(ElpdError):
    """Somebody ended it before it had begun."""

    kind = "Cancelled"


class ForbiddenError(ElpdError):
    """The caller may look, not touch."""

    exit_code = 4
    kind = "Forbidden"


class TooLargeError(ElpdError):
    """A message past its limit."""

    exit_code = 2
    kind = "TooLarge"


class ReplayDiverged(ElpdError):  # noqa: N818  (a finding about a recording, not a fault of the program)
    """A recorded run asked its devices something else than it did when it was recorded."""
