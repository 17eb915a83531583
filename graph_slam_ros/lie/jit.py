"""Compilation of kernels: Numba with a cache that cannot serve stale code.

Numba keys its cache by the file of the compiled function and sees neither a change in a file imported by it nor another
setting of the compiler (bounds checks). So the cache lives in one folder per digest of all kernel sources and settings.
"""

import hashlib
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.extending import register_jitable

from graph_slam_ros.errors import GraphSlamError

__all__ = ["CACHE_DIR", "COMPILED", "jitable", "kernel"]

_PACKAGE = Path(__file__).resolve().parents[1]
_KERNEL_FOLDERS = ("lie", "graph", "solver")
_SETTINGS = ("BOUNDSCHECK", "OPT")


def _sources() -> list[Path]:
    return [path for folder in _KERNEL_FOLDERS for path in sorted((_PACKAGE / folder).rglob("*.py"))]


def _digest() -> str:
    settings = [getattr(numba.config, name, None) for name in _SETTINGS]
    sha = hashlib.sha256(f"{numba.__version__} {settings}".encode())
    for path in _sources():
        sha.update(path.relative_to(_PACKAGE).as_posix().encode())
        sha.update(path.read_bytes())
    return sha.hexdigest()[:16]


def _place() -> str:
    """A digest of where these files lie and when they changed: Numba compiles anew where either is different."""
    return hashlib.sha256(repr([(str(path), int(path.stat().st_mtime)) for path in _sources()]).encode()).hexdigest()


def _cache_dir() -> Path:
    """The first of the user's cache and a folder of this user and this source in /tmp that is usable and private."""
    choices = []
    root = os.environ.get("GRAPH_SLAM_CACHE") or os.environ.get("XDG_CACHE_HOME")
    with suppress(RuntimeError):  # no home folder is known
        choices.append(Path(root or Path.home() / ".cache") / "graph_slam_ros" / f"kernels-{_digest()}")
    with suppress(OSError):  # no folder for temporary files
        choices.append(Path(tempfile.gettempdir()) / f"graph_slam_ros-{os.getuid()}-{_digest()}")
    for folder in choices:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_private(folder):
                with tempfile.TemporaryFile(dir=folder):
                    return folder
        except OSError:  # read-only, or not a folder
            continue
    try:
        return Path(tempfile.mkdtemp(prefix="graph_slam_ros-"))
    except OSError:
        raise GraphSlamError("no folder to keep compiled kernels in: set GRAPH_SLAM_CACHE to one of yours") from None


def _is_private(folder: Path) -> bool:
    """Return whether nobody else can have put anything into the folder: Numba unpickles and runs what it caches.

    A folder of ours that others may write to, as a lax umask leaves it, is closed to them; what is in it must be ours.
    """
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid():
        return False
    if about.st_mode & 0o022:
        folder.chmod(0o700)
    return all(entry.stat(follow_symlinks=False).st_uid == os.getuid() for entry in os.scandir(folder))


CACHE_DIR = _cache_dir()
COMPILED = CACHE_DIR / f"complete-{_place()[:16]}"
"""Is there when all kernels of these files have been compiled into the cache."""
numba.config.CACHE_DIR = str(CACHE_DIR)  # type: ignore[attr-defined]


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop over arrays; it runs on one thread, without unsafe maths.

    Where it calls BLAS (wide fronts) that library may take more: for the same bytes every time it must have one.
    """
    compiled: Callable[..., Any] = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled


def jitable(function: Callable[..., Any]) -> Callable[..., Any]:
    """Leave a formula plain Python (floats or whole arrays) and let kernels compile it inline."""
    plain: Callable[..., Any] = register_jitable(function)
    return plain
