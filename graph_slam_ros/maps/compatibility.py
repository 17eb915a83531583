"""Reasons why two maps cannot be compared, or cannot become one."""

from pathlib import Path

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.maps.alignment import Alignment, align, positions
from graph_slam_ros.runs.whole_path import WholePath
from graph_slam_ros.slam import GraphSlam

_ABSOLUTE = ("fixes", "surveyed")  # in the axes of map
_SAME = 1e-6  # of chi2


def refuse_other_space(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> None:
    """Raise GraphSlamError if one is in the plane and one in space."""
    if one.space is not two.space:
        dimensions = (slam.space.dimensions for slam in (one, two))
        counts = " and ".join(f"{folder}: {n}" for folder, n in zip((a, b), dimensions, strict=True))
        raise GraphSlamError(f"world.dimensions differ ({counts})")


def shared_landmarks(one: GraphSlam, two: GraphSlam) -> list[str]:
    """The landmarks with the same id in both, without unnamed ones."""
    named = [{name for name, mark in slam.landmarks.items() if not mark.is_unnamed} for slam in (one, two)]
    return [name for name in one.landmarks if name in named[0] & named[1]]


def aligned_for_merge(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> tuple[list[str], Alignment]:
    """Return the landmarks that both maps share, and how the second map lies on the first.

    Raises
    ------
    GraphSlamError
        They cannot become one map.
    """
    _refuse_other_datum(one, two, a, b)
    _refuse_same_drive(one, two, a, b)
    shared = _shared(one, two, a, b)
    return shared, _aligned(one, two, shared)


def merge_trouble(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> str:
    """Return why two maps cannot become one; empty where they can."""
    try:
        aligned_for_merge(one, two, a, b)
    except GraphSlamError as error:
        return str(error)
    return ""


def _refuse_other_datum(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> None:
    if one.datum and two.datum and one.datum != two.datum:
        raise GraphSlamError(
            f"fixes of {a} are from {one.datum}, of {b} from {two.datum}: configure one datum for both"
        )


def _refuse_same_drive(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> None:
    """Refuse two maps of one drive, because its measurements would count twice."""
    driven, again = (_driven(WholePath.of(slam, folder)) for slam, folder in ((one, a), (two, b)))
    same = len(driven & again)
    if same > 1:  # two robots may begin at one time
        raise GraphSlamError(f"{same} keyframes are of the same drive in {a} and {b}: nothing new is in one of them")


def _driven(path: WholePath) -> set[tuple[int, bytes]]:
    return {(stamp, pose.tobytes()) for stamp, pose in zip(path.stamps_ns.tolist(), path.odometry, strict=True)}


def _shared(one: GraphSlam, two: GraphSlam, a: Path, b: Path) -> list[str]:
    """Landmarks in both maps. Raises GraphSlamError if a pair cannot be the same landmark."""
    for name, mark in two.landmarks.items():
        other = one.landmarks.get(name)
        if other is None or (mark.is_unnamed and other.is_unnamed):
            continue
        if mark.is_unnamed is not other.is_unnamed:
            raise GraphSlamError(f"landmark {name} has an identity in one of {a} and {b}, and none in the other")
        if one.graph.kind_of(other.vertex) is not two.graph.kind_of(mark.vertex):
            raise GraphSlamError(f"landmark {name} is a point in one of {a} and {b}, and a pose in the other")
    for label in absolute_classes(two):
        if not absolute_classes(one):
            raise GraphSlamError(f"{b} has {label}, which say where its map is, and {a} has none: merge {b} {a}")
    return shared_landmarks(one, two)


def absolute_classes(slam: GraphSlam) -> list[str]:
    """The classes of edges that are absolute in the map."""
    return [label for label in _ABSOLUTE if len(slam.graph.edges_of(label))]


def _aligned(one: GraphSlam, two: GraphSlam, shared: list[str]) -> Alignment:
    needed, robust = one.space.dimensions, one.config.robust
    if len(shared) < needed:
        raise GraphSlamError(f"{len(shared)} landmarks are in both maps: it takes {needed} to lay one on the other")
    found = align(one.space, positions(one, shared), positions(two, shared), robust.gate, robust.noise_factor)
    agree = 0 if found is None else int(found.fits.sum())
    if found is None or 2 * agree < len(shared):
        why = f"{agree} of them agree" if agree else "too few agree, or they stand too close together"
        raise GraphSlamError(f"{len(shared)} landmarks are in both maps, and {why} on how one lies on the other")
    return found
