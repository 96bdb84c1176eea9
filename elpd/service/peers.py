"""Who is at the other end of a connection, and whether that may operate the rig.

The kernel says (``SO_PEERCRED``), not the client. root, the daemon's own user and the members of one group operate;
whoever else can open the socket looks.
"""

from __future__ import annotations

import grp
import os
import socket
import struct
from dataclasses import dataclass
from pathlib import Path

from elpd.errors import ConfigError

SO_PEERGROUPS = 59
"""Linux's number (4.13), which Python's socket module does not name."""

MOST_BYTES = 1024
"""What Python's ``getsockopt`` takes at most: 256 groups."""


@dataclass(frozen=True, slots=True)
class Peer:
    """The process that connected, as it was then."""

    pid: int
    uid: int
    groups: frozenset[int]
    name: str


def peer_of(connection: socket.socket) -> Peer:
    """Ask the kernel who connected."""
    pid, uid, gid = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return Peer(pid, uid, frozenset({gid, *_further_groups(connection)}), _process_name(pid))


@dataclass(frozen=True, slots=True)
class Operators:
    """Who may operate: *uid*, root, and the group *gid* where there is one."""

    uid: int
    gid: int | None = None

    @classmethod
    def of_group(cls, group: str | None) -> Operators:
        """Return the operators of a daemon of this user. Raises ``ConfigError`` for a group that does not exist."""
        if group is None:
            return cls(os.geteuid())
        try:
            return cls(os.geteuid(), grp.getgrnam(group).gr_gid)
        except KeyError:
            raise ConfigError(f"api.operators: there is no group {group!r}; make it, or leave the key out") from None

    def include(self, peer: Peer) -> bool:
        """Say whether *peer* may operate."""
        return peer.uid in {0, self.uid} or self.gid in peer.groups


def _further_groups(connection: socket.socket) -> tuple[int, ...]:
    try:
        packed = connection.getsockopt(socket.SOL_SOCKET, SO_PEERGROUPS, MOST_BYTES)
    except OSError:
        return ()  # an older kernel, or more than 256 groups: the first one counts
    return struct.unpack(f"{len(packed) // 4}I", packed)


def _process_name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
