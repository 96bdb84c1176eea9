"""The token: whoever can read one file may use the page.

It is made once, in a file that only its owner can read, and reaches the browser in the fragment of the address, which
browsers do not send. It survives restarts, so that open pages go on working.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
from pathlib import Path

from elpd.errors import ConfigError

TOKEN_BYTES = 32
SERVICE_TOKEN = Path("/var/lib/elpd-web/web.token")
"""Where ``elpd-web.service`` keeps its own."""
_TOKEN = re.compile(r"[A-Za-z0-9_-]{40,200}")


def token_path(configured: Path | None) -> Path:
    """Return where the token lies: as configured, else in the first private folder that this process has."""
    if configured is not None:
        return configured
    for variable in ("STATE_DIRECTORY", "RUNTIME_DIRECTORY"):  # a systemd unit's own; may hold several
        if folder := os.environ.get(variable, "").split(":")[0]:
            return Path(folder) / "web.token"
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "elpd" / "web.token"


def read_or_make_token(path: Path) -> str:
    """Return the token in *path*, made if there is none.

    Raises ``ConfigError`` if the file belongs to somebody else, can be read by others, or holds something else.
    """
    try:
        return _read(path, {os.geteuid()})
    except FileNotFoundError:
        pass
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}; set web.token_file to a file of your own") from None
    token = secrets.token_urlsafe(TOKEN_BYTES)
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        _create(path, token)
    except FileExistsError:
        return _read(path, {os.geteuid()})  # another gateway was faster
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror or error}; set web.token_file to a place that can be written"
        ) from None
    return token


def read_token(configured: Path | None) -> tuple[str, Path]:
    """Return the token of a gateway that runs, and its file: the user's own, else the service's, which root may read.

    Raises ``ConfigError`` if there is none, or it is not to be trusted.
    """
    own = token_path(configured)
    for path in [own] if configured is not None else [own, SERVICE_TOKEN]:
        try:
            return _read(path, trusted_uids={os.geteuid()} if os.geteuid() else None), path
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror or error}; ask as the user whom it belongs to") from None
    raise ConfigError(f"{own}: there is no token yet; start `elpd web`, which makes it")


def _create(path: Path, token: str) -> None:
    """Write a complete file or none: whoever reads meanwhile never sees half a token."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    try:
        with os.fdopen(handle, "w", encoding="ascii") as file:
            file.write(f"{token}\n")
        os.link(temporary, path)  # unlike a rename this never replaces
    finally:
        temporary.unlink()


def _read(path: Path, trusted_uids: set[int] | None) -> str:
    """Read a private file of one of these users, or (``None``) of anybody's."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    with os.fdopen(handle, encoding="ascii", errors="replace") as file:
        facts = os.fstat(file.fileno())
        mode = stat.S_IMODE(facts.st_mode)
        if mode & 0o077 or (trusted_uids is not None and facts.st_uid not in trusted_uids):
            raise ConfigError(
                f"{path}: mode {mode:04o}, owner {facts.st_uid}; a token file must be 0600 and belong to user "
                f"{os.geteuid()}: delete it, and a new one is made"
            )
        token = file.read(1024).strip()
    if not _TOKEN.fullmatch(token):
        raise ConfigError(f"{path}: does not hold a token; delete it, and a new one is made")
    return token
