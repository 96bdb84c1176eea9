"""A real systemd for tests: PID 1 in private namespaces, over a throw-away overlay of this machine's root.

`Booted` is a context manager. Inside it everything is the machine's own (programs, libraries, accounts) and nothing of
what is written survives: files lie in a tmpfs, mounts in a private mount namespace, processes under a PID 1 whose death
takes them along, cgroups in a folder that is removed at the end. Needs root; what is missing is told by `why_not`.

The installation under test is laid out as tools/install does it: a virtual environment in /opt/elpd, here assembled
from the running interpreter, its packages and this checkout, so that nothing is downloaded.
"""

from __future__ import annotations

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

ROOT = Path(__file__).parents[1]
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
_NEEDED = (
    "systemctl",
    "systemd-sysusers",
    "systemd-analyze",
    "journalctl",
    "dbus-daemon",
    "unshare",
    "nsenter",
)
_UNSHARE = ("unshare", "--pid", "--fork", "--mount", "--net", "--ipc", "--uts", "--cgroup", "--propagation", "private")
_BOOT_S = 30.0
MEMORY = Path("/sys/fs/cgroup/memory")

_BOOT = r"""
set -eu
mount -t tmpfs -o size=1G tmpfs "$TREE"
cd "$TREE"; mkdir upper work root
mount -t overlay overlay -o "lowerdir=/,upperdir=$TREE/upper,workdir=$TREE/work" root; cd root
mount -t tmpfs -o mode=755 tmpfs run; mount -t tmpfs tmpfs tmp
mount -t proc proc proc; mount -t sysfs -o ro sysfs sys; mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 tmpfs dev
for node in null zero full random urandom tty; do touch dev/$node; mount --bind /dev/$node dev/$node; done
mkdir dev/pts dev/shm; mount -t devpts -o newinstance,ptmxmode=0666 devpts dev/pts; mount -t tmpfs tmpfs dev/shm
ln -s pts/ptmx dev/ptmx; ln -s /proc/self/fd dev/fd
touch dev/console; mount --bind "$CONSOLE" dev/console
cp -a "$FILES"/. .
while IFS="=" read -r inside outside; do
    [ -n "$inside" ] || continue
    mkdir -p "./$inside"; mount --bind "$outside" "./$inside"; mount -o remount,bind,ro "./$inside"
done <"$BINDS"
mkdir -p mnt; pivot_root . mnt; umount -l mnt  # not chroot: from inside one no user namespace can be made
cd /; systemd-sysusers
[ ! -d /var/cache/elpd ] || chown -R elpd:elpd /var/cache/elpd
export container=tests
exec /lib/systemd/systemd --system --unit=tests.target --show-status=0 --log-target=journal
"""

_TRIAL = """
mount -t tmpfs tmpfs "$1"; cd "$1"; mkdir u w r
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/u,workdir=$1/w" r
"""

_TARGET = """[Unit]
Requires=basic.target
Wants=dbus.service
After=basic.target dbus.service
AllowIsolate=yes
"""
_MASKED = ("apt-daily", "apt-daily-upgrade", "man-db", "e2scrub_all", "dpkg-db-backup")

_PROGRAM = f"""#!/opt/elpd/bin/{PYTHON}
import sys
from elpd.cli import main
sys.exit(main())
"""


def why_not() -> str | None:
    """Say what keeps a systemd from being booted here; ``None`` where nothing does."""
    if os.geteuid() != 0:
        return "needs root for namespaces and mounts"
    for program in _NEEDED:
        if shutil.which(program) is None:
            return f"{program} is not installed; see tools/packages"
    if not Path("/lib/systemd/systemd").exists():
        return "systemd is not installed; see tools/packages"
    with tempfile.TemporaryDirectory() as folder:
        tried = subprocess.run(
            [*_UNSHARE, "sh", "-ec", _TRIAL, "sh", folder], capture_output=True, text=True, check=False
        )
    if tried.returncode:
        return f"no private namespaces here: {tried.stderr.strip()}"
    if not cgroups().is_dir():
        return "no cgroup v2 hierarchy"
    return None


def installation() -> tuple[dict[str, str], dict[str, Path]]:
    """Return (files, read-only binds) that make /opt/elpd and the units as tools/install would."""
    packages = sysconfig.get_path("purelib")
    files = _installed() | {
        "opt/elpd/pyvenv.cfg": "home = /opt/python/bin\ninclude-system-site-packages = false\n",
        f"opt/elpd/lib/{PYTHON}/site-packages/here.pth": "/opt/source\n/opt/source/drivers\n/opt/packages\n",
        "opt/elpd/bin/elpd": _PROGRAM,
        # an interpreter outside /usr looks for its library where it was built, which ProtectHome= may hide
        "etc/systemd/system.conf.d/python.conf": "[Manager]\nDefaultEnvironment=LD_LIBRARY_PATH=/opt/python/lib\n",
        "etc/systemd/journald.conf.d/tests.conf": "[Journal]\nStorage=volatile\nRateLimitBurst=0\n",
    }
    binds = {"opt/python": Path(sys.base_prefix), "opt/packages": Path(packages), "opt/source": ROOT}
    return files, binds


def compiled_kernels() -> dict[str, Path]:
    """Return where the service keeps kernels, for each that lies compiled in this checkout: it need not begin cold.

    A kernel belongs to its source by that file's time and size, which a bind keeps, and to its folder by name.
    """
    from numba.core.caching import _CacheLocator  # noqa: PLC0415

    found = {}
    for path in [*ROOT.glob("elpd/**/__pycache__/*.nb?"), *ROOT.glob("drivers/**/__pycache__/*.nb?")]:
        source = Path("/opt/source", path.parents[1].relative_to(ROOT), "any.py")
        found[f"var/cache/elpd/numba/{_CacheLocator.get_suitable_cache_subpath(str(source))}/{path.name}"] = path
    return found


def _installed() -> dict[str, str]:
    """Return what tools/install puts outside of the virtual environment."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, ROOT / "tools" / "install", "--no-venv", "--root", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        found = [path for path in Path(folder).rglob("*") if path.is_file()]
        return {str(path.relative_to(folder)): path.read_text(encoding="utf-8") for path in found}


class Booted:
    """A booted systemd. Call it with a command line to run that inside, as root.

    *files* maps paths inside to their text (``#!`` makes them executable), *binds* paths inside to folders outside,
    read-only, *copies* paths inside to files outside.
    """

    def __init__(
        self, files: Mapping[str, str], binds: Mapping[str, Path], copies: Mapping[str, Path] | None = None
    ) -> None:
        self._copies = dict(copies or {})
        self._files = {
            "etc/systemd/system/tests.target": _TARGET,
            **{f"etc/systemd/system/{name}.timer": "" for name in _MASKED},  # an empty file masks
            **files,
        }
        self._binds = dict(binds)
        self._console = b""
        self._init: int | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self.folder = Path(tempfile.mkdtemp(prefix="elpd-booted-"))
        self._cgroup = cgroups() / self.folder.name

    def __enter__(self) -> Self:
        try:
            self._boot()
            self.until(self._is_up, "systemd to come up", _BOOT_S)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __call__(
        self, *arguments: str, check: bool = True, text: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run a command inside, as root; *text* is its stdin."""
        done = subprocess.run(
            [*self._inside(), *arguments], capture_output=True, text=True, input=text, check=False, cwd="/", env=_ENV
        )
        if check and done.returncode:
            raise AssertionError(f"{arguments}: {done.returncode}\n{done.stdout}\n{done.stderr}\n{self.journal_text()}")
        return done

    def popen(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a command inside, its stdout piped."""
        return subprocess.Popen([*self._inside(), *arguments], stdout=subprocess.PIPE, text=True, cwd="/", env=_ENV)

    def write(self, path: str, text: str) -> None:
        """Write a file inside."""
        self("/usr/bin/tee", path, text=text)

    def show(self, unit: str, *properties: str) -> dict[str, str]:
        """Return properties of a unit."""
        told = self("systemctl", "show", unit, *(f"--property={name}" for name in properties)).stdout
        return dict(line.split("=", 1) for line in told.splitlines())

    def journal(self, *matches: str) -> list[dict[str, Any]]:
        """Return the entries of the journal that match, oldest first."""
        told = self("journalctl", "--output=json", "--no-pager", "--quiet", *matches, check=False).stdout
        return [json.loads(line) for line in told.splitlines()]

    def journal_text(self) -> str:
        """Return the end of the journal, for messages."""
        arguments = [*self._inside(), "journalctl", "--no-pager", "--lines=60", "--output=short-monotonic"]
        return subprocess.run(arguments, capture_output=True, text=True, check=False, cwd="/", env=_ENV).stdout

    def until(self, holds: Callable[[], Any], what: str, within_s: float = 120.0) -> Any:
        """Ask until *holds* returns something true, and return that; an ``AssertionError`` with the journal if late."""
        deadline = time.monotonic() + within_s
        while not (answer := holds()):
            if time.monotonic() > deadline:
                told = self.journal_text() if self._init else self._console.decode(errors="replace")
                raise AssertionError(f"waited {within_s:g} s for {what}\n{told}")
            time.sleep(0.03)
        return answer

    @contextmanager
    def starved(self, unit: str) -> Iterator[Callable[[], bool]]:
        """Give a unit's processes no page of memory more; what is yielded says whether one was killed for it.

        Skips the test where there is no memory cgroup (of version 1) to be had.
        """
        place = MEMORY / self.folder.name
        try:
            place.mkdir()
        except OSError:
            pytest.skip("no memory cgroup of our own here")
        try:
            (place / "memory.limit_in_bytes").write_text("64K", encoding="ascii")
            for pid in self._cgroup_of(unit).read_text(encoding="ascii").split():
                (place / "cgroup.procs").write_text(pid, encoding="ascii")
            yield lambda: "oom_kill 0" not in (place / "memory.oom_control").read_text(encoding="ascii")
        finally:
            for pid in (place / "cgroup.procs").read_text(encoding="ascii").split():
                (MEMORY / "cgroup.procs").write_text(pid, encoding="ascii")
            self.until(lambda: _removed(place), "the memory cgroup to be left")

    def _cgroup_of(self, unit: str) -> Path:
        return next(path for path in self._cgroup.rglob("cgroup.procs") if path.parent.name == unit)

    def __exit__(self, *_: object) -> None:
        if self._init is not None:
            _kill(self._init)
        if self._process is not None:
            _kill(self._process.pid)
            self._process.wait()
        self._remove_cgroups()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _boot(self) -> None:
        tree, files, binds = (self.folder / name for name in ("tree", "files", "binds"))
        tree.mkdir()
        for name, content in self._files.items():
            path = files / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content, encoding="utf-8")
            path.chmod(0o755 if content.startswith("#!") else 0o644)
        for name, outside in self._copies.items():
            (files / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(outside, files / name)
        (files / "opt/elpd/bin").mkdir(parents=True, exist_ok=True)
        for name in ("python3", PYTHON):
            (files / "opt/elpd/bin" / name).symlink_to(f"/opt/python/bin/{PYTHON}")
        for folder in files.rglob("*"):
            if folder.is_dir():
                folder.chmod(0o755)
        binds.write_text("".join(f"{inside}={outside}\n" for inside, outside in self._binds.items()), encoding="utf-8")
        self._cgroup.mkdir()
        master, slave = pty.openpty()
        # joins its cgroup before it unshares: what systemd makes then lies below and can be removed
        join = f'echo $$ >"{self._cgroup}/cgroup.procs"; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", join, "bash", *_UNSHARE, "--kill-child=SIGKILL", "bash", "-c", _BOOT],
            env=_ENV | {"TREE": str(tree), "FILES": str(files), "BINDS": str(binds), "CONSOLE": os.ttyname(slave)},
            stdin=subprocess.DEVNULL,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
        )
        os.close(slave)
        threading.Thread(target=self._read_console, args=(master,), daemon=True).start()

    def _read_console(self, master: int) -> None:
        try:
            while data := os.read(master, 65536):
                self._console = (self._console + data)[-100_000:]
        except OSError:  # the far end is gone
            pass
        finally:
            os.close(master)

    def _is_up(self) -> bool:
        if self._process is None or self._process.poll() is not None:
            raise AssertionError(f"systemd did not come up:\n{self._console.decode(errors='replace')}")
        if self._init is None:
            self._init = next(_children(self._process.pid), None)
        if self._init is None or Path(f"/proc/{self._init}/comm").read_text(encoding="utf-8") != "systemd\n":
            return False
        return self("systemctl", "is-system-running", check=False).stdout.strip() in {"running", "degraded"}

    def _inside(self) -> list[str]:
        root = f"/proc/{self._init}/root"
        return ["nsenter", "-t", str(self._init), "--all", f"--root={root}", f"--wd={root}"]

    def _remove_cgroups(self) -> None:
        deadline = time.monotonic() + 10.0
        while self._cgroup.is_dir() and time.monotonic() < deadline:
            for folder, _, _ in os.walk(self._cgroup, topdown=False):
                try:
                    os.rmdir(folder)  # noqa: PTH106  (os.walk gives strings)
                except OSError:  # a dying process is still in it
                    time.sleep(0.02)


_ENV = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8"}


def cgroups() -> Path:
    """Return where cgroups of version 2 are."""
    unified = Path("/sys/fs/cgroup/unified")
    return unified if unified.is_dir() else Path("/sys/fs/cgroup")


def _removed(folder: Path) -> bool:
    try:
        folder.rmdir()
    except OSError:  # a dying process is still in it
        return False
    return True


def _children(pid: int) -> Iterator[int]:
    try:
        yield from map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split())
    except OSError:
        return


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return
