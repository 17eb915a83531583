"""How kernels are compiled: Numba with a cache that cannot serve stale code.

Numba keys its cache by the file of the compiled function and sees neither a change in a file imported by it nor another
setting of the compiler (bounds checks). So the cache lives in one folder per digest of all kernel sources and settings.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.extending import register_jitable

__all__ = ["CACHE_DIR", "COMPILED", "jitable", "kernel"]

_PACKAGE = Path(__file__).resolve().parents[1]
_KERNEL_FOLDERS = ("lie", "graph", "solver")
_SETTINGS = ("BOUNDSCHECK", "OPT")


def _sources() -> list[Path]:
    return [path for folder in _KERNEL_FOLDERS for path in sorted((_PACKAGE / folder).glob("*.py"))]


def _digest() -> str:
    settings = [getattr(numba.config, name, None) for name in _SETTINGS]
    sha = hashlib.sha256(f"{numba.__version__} {settings}".encode())
    for path in _sources():
        sha.update(path.name.encode())
        sha.update(path.read_bytes())
    return sha.hexdigest()[:16]


def _place() -> str:
    """Of these files: Numba compiles anew what lies elsewhere, its older versions also what was touched."""
    return hashlib.sha256(repr([(str(path), int(path.stat().st_mtime)) for path in _sources()]).encode()).hexdigest()


def _cache_dir() -> Path:
    root = os.environ.get("GRAPH_SLAM_CACHE") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    wanted = Path(root) / "graph_slam_ros" / f"kernels-{_digest()}"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=wanted):
            return wanted
    except OSError:  # a read-only home: compile into a folder of this user and this source
        fallback = Path(tempfile.gettempdir()) / f"graph_slam_ros-{os.getuid()}-{_digest()}"
        fallback.mkdir(mode=0o700, exist_ok=True)
        if fallback.is_symlink() or fallback.stat().st_uid != os.getuid():  # another user's: what it caches is code
            return Path(tempfile.mkdtemp(prefix="graph_slam_ros-"))
        return fallback


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
