"""Compilation of kernels: Numba with a cache that cannot serve stale code, wherever the package lies.

Numba keys its cache by the place of the compiled function's file. It sees neither a change in a file imported by it nor
another setting of the compiler (bounds checks). So the cache lives in one folder per digest of the code of all kernel
sources, of what compiles them, its settings and the processor. Copies of the package that agree in these share it.
Comments, docstrings and line breaks are no part of the code.

A wheel brings such a folder as an archive, ``kernels-DIGEST.zip``, for a processor that most machines can stand for.
It is unpacked into the user's cache; where it is for another Numba or an older processor, kernels are compiled. Sums
over wide fronts differ in their last digits between processors: bytes repeat with one wheel, or on one machine.
"""

import ast
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import llvmlite
import llvmlite.binding
import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.core.codegen import get_host_cpu_features
from numba.extending import register_jitable

from graph_slam_ros.errors import GraphSlamError

__all__ = ["ARCHIVES", "CACHE_DIR", "PROCESSOR", "inlined", "inner", "jitable", "kernel"]

_PACKAGE = Path(__file__).resolve().parents[1]
_DOCUMENTED = ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef


def _sources() -> list[Path]:
    folders = [path for folder in ("lie", "graph", "solver") for path in sorted((_PACKAGE / folder).rglob("*.py"))]
    return [*folders, _PACKAGE / "warmup.py"]


_config: Any = numba.config
_features: str = get_host_cpu_features()  # type: ignore[no-untyped-call]

ARCHIVES = sorted(_PACKAGE.glob("kernels-*.zip"))
"""What a wheel brings; a checkout has none."""

PROCESSOR, _NEEDED = {
    "x86_64": ("x86-64-v3", {"+avx2", "+bmi", "+bmi2", "+f16c", "+fma", "+lzcnt", "+movbe"}),
    "aarch64": ("generic", set()),
    "arm64": ("apple-m1", set()),
}.get(os.uname().machine, ("", set()))
"""For which processor a wheel's kernels are compiled (``make wheel``), and what it has, as LLVM names it."""

if ARCHIVES and _config.CPU_NAME is None and _NEEDED.issubset(_features.split(",")):
    _config.CPU_NAME, _config.CPU_FEATURES = PROCESSOR, ""


def _compiler() -> list[Any]:
    """List what else the machine code depends on: versions, settings, the processor."""
    settings = [_config.BOUNDSCHECK, _config.OPT, _config.ENABLE_AVX, _config.LOOP_VECTORIZE, _config.SLP_VECTORIZE]
    processor = _config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    features = _features if _config.CPU_FEATURES is None else _config.CPU_FEATURES
    return [sys.implementation.cache_tag, numba.__version__, llvmlite.__version__, *settings, processor, features]


def _digest(contents: Iterable[bytes]) -> str:
    """Return a name for what the sources contain, and for what else the machine code depends on."""
    sha = hashlib.sha256(repr(_compiler()).encode())
    for path, content in zip(_sources(), contents, strict=True):
        sha.update(path.relative_to(_PACKAGE).as_posix().encode())
        sha.update(content)
    return sha.hexdigest()[:16]


def _code_of(source: bytes) -> bytes:
    """Return the syntax tree of a source without docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree).encode()


def _cache_dir() -> Path:
    """The first of the user's cache and a folder of this user and this code in /tmp that is usable and private.

    A folder has a file for each state of the sources that has this code: a syntax tree takes 0.2 s.
    """
    choices: list[tuple[Path, str]] = []
    root = os.environ.get("GRAPH_SLAM_CACHE") or os.environ.get("XDG_CACHE_HOME")
    with suppress(RuntimeError):  # no home folder is known
        choices.append((Path(root or Path.home() / ".cache") / "graph_slam_ros", "kernels-"))
    with suppress(OSError):  # no folder for temporary files
        choices.append((Path(tempfile.gettempdir()), f"graph_slam_ros-{os.getuid()}-"))
    contents = [path.read_bytes() for path in _sources()]
    same_sources = f"sources-{_digest(contents)}"
    for parent, prefix in choices:
        with suppress(OSError):  # read-only, or not a folder
            for known in sorted(parent.glob(f"{prefix}*/{same_sources}")):
                if _is_usable(known.parent):
                    return known.parent
            code = _digest(map(_code_of, contents))
            folder, archive = parent / (prefix + code), _PACKAGE / f"kernels-{code}.zip"
            if archive in ARCHIVES and not folder.exists():
                _unpack(archive, folder)
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_usable(folder):
                (folder / same_sources).touch()
                return folder
    try:
        return Path(tempfile.mkdtemp(prefix="graph_slam_ros-"))
    except OSError:
        raise GraphSlamError("no folder to keep compiled kernels in: set GRAPH_SLAM_CACHE to one of yours") from None


def _unpack(archive: Path, folder: Path) -> None:
    """Unpack kernels; where several processes do so, the first one's stay."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        shutil.unpack_archive(archive, scratch)
        with suppress(OSError):
            os.rename(scratch, folder)


def _is_usable(folder: Path) -> bool:
    """Return whether files can be written to a folder, and nobody else can have: Numba runs what it caches.

    If it is ours but others may write to it, as a lax umask leaves it, that is forbidden. All in it must be ours.
    """
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid():
        return False
    if about.st_mode & 0o022:
        folder.chmod(0o700)
    with tempfile.TemporaryFile(dir=folder):
        return all(entry.stat(follow_symlinks=False).st_uid == os.getuid() for entry in os.scandir(folder))


CACHE_DIR = _cache_dir()
_config.CACHE_DIR = str(CACHE_DIR)


class _Locator(UserProvidedCacheLocator):
    """Stores kernels of this package by their path in it; the folder's digest stands for their sources."""

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        super().__init__(py_func, py_file)  # type: ignore[no-untyped-call]
        self._cache_path = str(CACHE_DIR / Path(py_file).resolve().parent.relative_to(_PACKAGE))

    def get_source_stamp(self) -> str:
        """Return the same for all: what was compiled of other sources lies in another folder."""
        return "kernels"

    def get_disambiguator(self) -> str:
        """Return the same for all, and not the line: in a module each kernel has a name of its own."""
        return "kernel"

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """Leave kernels of somebody else's files to Numba."""
        if not Path(py_file).resolve().is_relative_to(_PACKAGE):
            return None
        return super().from_function(py_func, py_file)  # type: ignore[no-untyped-call]


class _CacheImpl(CompileResultCacheImpl):
    _locator_classes = [_Locator, *CompileResultCacheImpl._locator_classes]  # noqa: RUF012


class _Cache(FunctionCache):
    _impl_class = _CacheImpl

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        """Leave out the name of the system, in which macOS has its version."""
        signature, target, code = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        return signature, target[1:], code


def kernel(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile a loop over arrays; it runs on one thread, without unsafe maths.

    A kernel that calls BLAS (wide fronts) may use more threads there. The same bytes every time need one.
    """
    settings = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True} | options  # no call by a pointer
    compiled: Any = numba.njit(**settings)(function)  # type: ignore[call-overload]
    if compiled is not function:  # it is where compilation is switched off
        compiled._cache = _Cache(function)  # type: ignore[no-untyped-call]
    return cast(Callable[..., Any], compiled)


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel that kernels alone call: a call from Python would crash.

    What Python would call it by takes a tenth of a second to compile where it gets a tuple of arrays.
    """
    return kernel(function, no_cpython_wrapper=True)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a small kernel into the kernels that call it: a call that passes a tree copies a hundred numbers."""
    return kernel(function, no_cpython_wrapper=True, forceinline=True)


def jitable(function: Callable[..., Any]) -> Callable[..., Any]:
    """Leave a formula plain Python (floats or whole arrays) and let kernels compile it inline."""
    plain: Callable[..., Any] = register_jitable(function)
    return plain
