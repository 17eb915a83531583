"""The choice of parameters: those of the groups that are asked for, and that the edges of a graph depend on."""

from collections.abc import Collection

from graph_slam_ros.slam.calibration.parameters import OF_ODOMETRY, QUANTITIES, Parameter
from graph_slam_ros.slam.calibration.rows import TrialProblem

_LEAST_KEYFRAMES = 3


def parameters_of(problem: TrialProblem, groups: Collection[str]) -> list[Parameter]:
    """The parameters of some groups that the edges of a graph depend on."""
    if len(problem.keyframes) < _LEAST_KEYFRAMES:
        return []
    model = problem.model()
    odometries = sorted({edges.source for edges in model.odometry})
    kinds: dict[str, set[str]] = {}
    for edges in model.sightings:
        kinds.setdefault(edges.source, set()).add(edges.kind)
    found = []
    for name, quantity in QUANTITIES.items():
        if quantity.group not in groups or (problem.space.dimensions == 2 and name in ("roll", "pitch", "z")):
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


def only_ranges(kinds: Collection[str]) -> bool:
    """Return whether kinds of edges measure distances alone."""
    return all(kind.startswith("range") and kind != "range and bearing" for kind in kinds)
