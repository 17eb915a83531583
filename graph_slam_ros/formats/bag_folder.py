"""The files of a rosbag2 folder, as its metadata.yaml names them."""

from pathlib import Path

import yaml

from graph_slam_ros.formats.files import read_text


def as_listed(path: Path, found: list[Path]) -> tuple[list[Path], list[str], list[str]]:
    """The files that metadata.yaml names, where any of them is there; and what it says beyond them.

    Returns
    -------
    The files to read, the losses (named, and not there), and the warnings (there, and not named).
    """
    there = {file.name.removesuffix(".zstd"): file for file in found}
    named = [Path(name).name.removesuffix(".zstd") for name in _names_in(path / "metadata.yaml")]
    files = [there[name] for name in dict.fromkeys(named) if name in there]
    if not files:
        return found, [], []
    missing = [f"{path / name}: not there, though metadata.yaml names it" for name in named if name not in there]
    others = [file.name for file in found if file not in files]
    mend = "metadata.yaml does not name it: if it is a part of the recording, ros2 bag reindex"
    return files, missing, [f"{path / name}: not read, as {mend}" for name in others]


def _names_in(metadata: Path) -> list[str]:
    """The files that the metadata of a rosbag2 folder name; none where it has none, or they cannot be read."""
    if not metadata.is_file():
        return []
    try:
        content = yaml.safe_load(read_text(metadata, follow=True))
        return [str(name) for name in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (OSError, ValueError, yaml.YAMLError, TypeError, KeyError, RecursionError):
        return []
