"""Public recordings and graphs: they are outside the repository, in the folder that GRAPH_SLAM_DATASETS names."""

import sys
from pathlib import Path

from benchmarks.fresh import ROOT

sys.path.append(str(ROOT / "test"))
import places
import public_recordings

DATASETS: Path = places.DATASETS
PARK: Path = public_recordings.RECORDED / "victoria_park"


class Absent(SystemExit):
    """Data are not at hand, and without them a programme ends."""


def check(*paths: Path) -> None:
    """Raise Absent where one is not there."""
    for path in paths:
        if not path.exists():
            raise Absent(f"no {path.name} in {DATASETS}: set GRAPH_SLAM_DATASETS")


def mrclam(robot: int, bag: Path, *options: str) -> Path:
    """Write the recording of a robot of MR.CLAM set 7, with its truth. Raises Absent."""
    check(places.CONVERTER, places.SET_7)
    return Path(places.mrclam(robot, bag.resolve(), *options))


def plaza() -> tuple[Path, float, Path]:
    """Write the recording of Plaza 2 here; returns it, what its stamps begin at, and its truth. Raises Absent."""
    source = public_recordings.RECORDED / "plaza2"
    check(source)
    return public_recordings.plaza(Path()), public_recordings.EPOCH_S, source / "Plaza2_.mat"
