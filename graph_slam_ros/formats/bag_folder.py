"""The files of a rosbag2 folder, as its metadata.yaml names them."""

import shlex
from pathlib import Path

import yaml

from graph_slam_ros.formats.files import read_text

_PACKED = ".zstd"


def as_listed(path: Path, found: list[Path]) -> tuple[list[Path], list[str], list[str]]:
    """The files that metadata.yaml names, the losses (named, and not there), and warnings (there, and not named)."""
    there = {file.name.removesuffix(".zstd"): file for file in found}
    named = [Path(name).name.removesuffix(".zstd") for name in _names_in(path / "metadata.yaml")]
    files = [there[name] for name in dict.fromkeys(named) if name in there]
    if not files:
        return found, [], []
    lost = [name for name in named if name not in there and not (path / f"{name}{_PACKED}").is_file()]
    missing = [f"{path / name}: not there, though metadata.yaml names it" for name in lost]
    others = [file.name for file in found if file not in files]
    mend = "metadata.yaml does not name it: if it is a part of the recording, ros2 bag reindex"
    return files, missing, [f"{path / name}: not read, as {mend}" for name in others]


def still_packed(path: Path, files: list[Path]) -> list[str]:
    """The losses of files that are compressed as a whole, next to others that are not."""
    there = {file.name for file in files}
    if not path.is_dir() or any(name.endswith(_PACKED) for name in there):
        return []
    packed = sorted(file for file in path.glob(f"*{_PACKED}") if file.name.removesuffix(_PACKED) not in there)
    return [f"{file.name}: not read: {unpacking(file)}" for file in packed if file.stem.endswith((".db3", ".mcap"))]


def unpacking(file: Path, codec: str = "zstd") -> str:
    """Say how a file is unpacked that is compressed as a whole, or is an archive."""
    name = shlex.quote(str(file))
    if codec in ("zip", "tar") or ".tar." in file.name or file.suffix in (".tgz", ".tbz", ".txz"):
        return f"an archive: unpack it, and give the folder in it: {'unzip' if codec == 'zip' else 'tar xf'} {name}"
    whole = file.with_suffix("") if file.suffix in (".zstd", ".gz", ".bz2", ".lz4") else Path("UNPACKED")
    mend = f"unpack it first: {codec} -dc < {name} > {shlex.quote(str(whole))}"
    return f"the whole file is compressed with {codec}: {mend}"


def _names_in(metadata: Path) -> list[str]:
    """The files that the metadata of a rosbag2 folder name; none where it has none, or they cannot be read."""
    if not metadata.is_file():
        return []
    try:
        content = yaml.safe_load(read_text(metadata, follow=True))
        return [str(name) for name in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (OSError, ValueError, yaml.YAMLError, TypeError, KeyError, RecursionError):
        return []
