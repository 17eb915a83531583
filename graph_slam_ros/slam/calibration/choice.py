"""The choice of parameters: those of the groups that are asked for, and that the edges of a graph depend on."""

from collections.abc import Collection

from graph_slam_ros.slam.calibration.parameters import AUTO, DEFAULT_GROUPS, OF_ODOMETRY, QUANTITIES, Parameter
from graph_slam_ros.slam.calibration.rows import TrialProblem

_LEAST_KEYFRAMES = 3


def parameters_of(problem: TrialProblem, groups: Collection[str]) -> list[Parameter]:
    """The parameters of some groups that the edges of a graph depend on.

    With ``auto``, where all inputs of landmarks have ranges alone, these have an offset and a factor, as radios do, and
    odometry keeps its scale: one of the two must. So does it where bearings alone tell no scale.
    """
    if len(problem.keyframes) < _LEAST_KEYFRAMES:
        return []
    model, excluded, chooses = problem.model(), set[str](), AUTO in groups
    groups = {*groups, *DEFAULT_GROUPS} if chooses else groups
    odometries = sorted({edges.source for edges in model.odometry})
    kinds: dict[str, set[str]] = {}
    for edges in model.sightings:
        kinds.setdefault(edges.source, set()).add(edges.kind)
    if chooses and kinds and all(only_ranges(some) for some in kinds.values()):
        groups = {*groups, "range_factor", "range_offset"}
        excluded.add("distance")
    if chooses and kinds and all(only_bearings(some) for some in kinds.values()) and not _has_scale(problem):
        excluded.add("distance")
    if any("offset" in kind for some in kinds.values() for kind in some):
        excluded.add("range_offset")  # it is an unknown of the graph
    found = []
    for name, quantity in QUANTITIES.items():
        if (
            quantity.group not in groups
            or name in excluded
            or (problem.space.dimensions == 2 and name in ("roll", "pitch", "z"))
        ):
            continue
        if name in OF_ODOMETRY:
            found += [Parameter(odometries[0], name)] if len(odometries) == 1 else []
        elif quantity.group == "yaw":
            found += [Parameter(source, name) for source, some in kinds.items() if not only_ranges(some)]
        elif name.startswith("range"):
            found += [Parameter(source, name) for source, some in kinds.items() if "range" in " ".join(some)]
        else:
            found += [Parameter(source, name) for source in kinds]
    return found


def places_of(problem: TrialProblem) -> list[Parameter]:
    """The place (x, y) on the robot of each sensor whose sightings have a direction."""
    kinds: dict[str, set[str]] = {}
    for edges in problem.model().sightings:
        kinds.setdefault(edges.source, set()).add(edges.kind)
    return [Parameter(source, axis) for source, some in kinds.items() if not only_ranges(some) for axis in ("x", "y")]


def offsets_of(problem: TrialProblem) -> list[Parameter]:
    """The offset of the ranges of each sensor that measures bearings, too."""
    both = (edges.source for edges in problem.model().sightings if edges.kind == "range and bearing")
    return [Parameter(source, "range_offset") for source in dict.fromkeys(both)]


def only_ranges(kinds: Collection[str]) -> bool:
    """Return whether kinds of edges measure distances alone."""
    return all(kind.startswith("range") and kind != "range and bearing" for kind in kinds)


def only_bearings(kinds: Collection[str]) -> bool:
    """Return whether kinds of edges measure directions alone."""
    return all(kind.startswith("bearing") for kind in kinds)


def _has_scale(problem: TrialProblem) -> bool:
    """Return whether something besides odometry and landmarks that are new has a scale: a fix, a closure, a map."""
    return bool(set(problem.graph.labels) - {"anchor", "odometry", "landmarks"}) or len(problem.held) > 1
