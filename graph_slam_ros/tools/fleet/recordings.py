"""The recordings of a fleet: found in folders and in the stores of fsspec, and copied to a worker."""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fsspec.core import url_to_fs

from graph_slam_ros.errors import GraphSlamError

_SUFFIXES = (".mcap", ".bag", ".db3", ".mcap.zstd", ".db3.zstd", ".bag.active")
_METADATA = "metadata.yaml"


@dataclass(frozen=True, slots=True)
class Source:
    """A recording: a file, or a folder with ``metadata.yaml``.

    Attributes
    ----------
    url : path, or address that fsspec can read
    name : short name, unique in the fleet
    size : bytes of its files
    identity : changes when a file does: a hash of names, sizes, and times or checksums of the store
    """

    url: str
    name: str
    size: int
    identity: str


def find_sources(texts: Iterable[str]) -> list[Source]:
    """Return the recordings that are named, the largest first.

    Raises GraphSlamError: nothing is there, or no recording in it.

    Parameters
    ----------
    texts : files, folders of a recording, folders of recordings, or addresses (``s3://``, ``gs://``)
    """
    urls: dict[str, tuple[int, str]] = {}
    for text in texts:
        try:
            found = dict(_found(text))
        except (OSError, ValueError, ImportError) as error:
            raise GraphSlamError(f"{text}: {error}") from None
        if not found:
            raise GraphSlamError(f"{text}: no recording (mcap, db3, ROS 1 bag) in it")
        urls |= found
    names = _short_names(list(urls))
    sources = [Source(url, names[url], *urls[url]) for url in urls]
    return sorted(sources, key=lambda one: (-one.size, one.url))


def _found(text: str) -> Iterator[tuple[str, tuple[int, str]]]:
    fs, root = url_to_fs(text)
    if not fs.exists(root):
        raise GraphSlamError(f"{text}: no such file or folder")
    if not fs.isdir(root):
        yield _described(fs, root, {root: fs.info(root)})
        return
    files = fs.find(root, detail=True)
    folders = sorted({str(Path(file).parent) for file in files if Path(file).name == _METADATA})
    for folder in folders:
        yield _described(fs, folder, {f: i for f, i in files.items() if Path(f).parent == Path(folder)})
    for file, info in sorted(files.items()):
        if file.endswith(_SUFFIXES) and str(Path(file).parent) not in folders:
            yield _described(fs, file, {file: info})


def _described(fs: Any, path: str, files: Mapping[str, Mapping[str, Any]]) -> tuple[str, tuple[int, str]]:
    """The address of a recording, its size and its identity."""
    marks = []
    for file, info in sorted(files.items()):
        changed = next((str(info[key]) for key in ("ETag", "etag", "md5Hash", "mtime", "created") if key in info), "")
        marks.append(f"{file} {info['size']} {changed}")
    url = os.path.abspath(path) if _is_local(fs) else fs.unstrip_protocol(path)
    return url, (
        sum(int(info["size"]) for info in files.values()),
        hashlib.sha256("\n".join(marks).encode()).hexdigest(),
    )


def _is_local(fs: Any) -> bool:
    return "file" in ((fs.protocol,) if isinstance(fs.protocol, str) else fs.protocol)


def _short_names(urls: list[str]) -> dict[str, str]:
    """Return the shortest unique end of each address, in whole parts of its path."""
    out: dict[str, str] = {}
    for url in urls:
        parts = url.rstrip("/").split("/")
        for count in range(1, len(parts) + 1):
            tail = parts[-count:]
            if sum(other.rstrip("/").split("/")[-count:] == tail for other in urls) == 1:
                break
        out[url] = "/".join(tail)
    return out


def local_copy(url: str, folder: Path) -> Path:
    """Return where a recording can be read on this machine: itself, or a copy in ``folder``.

    Raises GraphSlamError: it is not there, seen from this machine.
    """
    fs, root = url_to_fs(url)
    if not fs.exists(root):
        raise GraphSlamError(f"{url}: no such file or folder on this worker: put recordings where all workers see them")
    if _is_local(fs):
        return Path(root)
    target = folder / Path(root).name
    fs.get(root, str(target), recursive=fs.isdir(root))
    return target
