"""Closures that are in, by the parts of the drive that they join, and what the map would be without each group.

Closures of one group agree with one another. If they are wrong together, as where two aisles look alike, no statistic
of the run shows it: the map fits without them, and with them. A person who sees the map without each group knows.
"""

from collections.abc import Sequence
from typing import Any

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GaugeError, SingularError
from graph_slam_ros.runs.ledger_file import Entry

_NEAR = 10  # keyframes between two closures of one group, at both ends
_MOST = 8  # groups that are solved without
_MOST_EDGES = 2000  # of a class, above which groups are not what is wrong

Group = dict[str, Any]


def closure_groups(run: SavedGraph) -> list[Group]:
    """Groups of accepted closures; none where no closure is out, so that nothing contradicts any.

    Returns
    -------
    of each group ``edges``, ``ends`` (first and last keyframe at either end), ``chi2`` with and without it, ``most``
    (the keyframe that moves farthest without it, and by how much [m]); the last two are None where nothing else
    determines the map without it
    """
    closures = [e for e in run.entries if e.label == "closures" and e.verdict and len(e.vertices) == 2]
    inside = [e for e in closures if e.is_in]
    if len(inside) == len(closures) or len(inside) > _MOST_EDGES:
        return []
    several = sorted(_joined(run, inside), key=len, reverse=True)[:_MOST]
    return [_without(run, group) for group in sorted(several, key=lambda group: _ends(run, group[0]))]


def _ends(run: SavedGraph, e: Entry) -> tuple[int, int]:
    """The numbers of its two keyframes, the earlier first."""
    a, b = sorted(run.keyframe(vertex) or 0 for vertex in e.vertices)
    return a, b


def _joined(run: SavedGraph, closures: Sequence[Entry]) -> list[list[Entry]]:
    groups = list[list[Entry]]()
    for e in sorted(closures, key=lambda e: _ends(run, e)):
        a, b = _ends(run, e)
        near = (group for group in groups for c, d in (_ends(run, group[-1]),) if max(abs(a - c), abs(b - d)) <= _NEAR)
        group = next(near, None)
        if group is None:
            groups.append([e])
        else:
            group.append(e)
    return groups


def _without(run: SavedGraph, group: Sequence[Entry]) -> Group:
    edges, ends = [e.edge for e in group], [_ends(run, e) for e in group]
    out: Group = {"edges": edges, "ends": [[f(one[k] for one in ends) for f in (min, max)] for k in (0, 1)]}
    try:
        moved = run.moved(run.solve(edges))
    except (GaugeError, SingularError):
        return out | {"chi2": None, "most": None}
    chi2 = [moved.before.chi2_final, moved.after.chi2_final]
    return out | {"chi2": chi2, "most": [run.keyframe(moved.most[0]), moved.most[1]]}
