"""What each edge of a run does to it, and what ``explain`` says of it: its templates, and the numbers to fill in."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from graph_slam_ros.analysis.explain import ends_of, remedy, statements, title
from graph_slam_ros.analysis.what_if import Influences, SavedGraph
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import GaugeError, SingularError
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.slam.edits import HAND_MADE
from graph_slam_ros.slam.robust.ledger import FINAL
from graph_slam_ros.tools.report.packing import shown
from graph_slam_ros.typing import Index

Group = dict[str, Any]
_NEAR = 10  # keyframes between two closures of one group, at both ends
_MOST = 8  # groups that are solved without
_MOST_EDGES = 2000  # of a class, above which groups are not what is wrong


def effects(run: SavedGraph) -> Influences:
    """The effects of leaving out each judged edge that is in, or of letting in each that is out, to first order."""
    inside = [e.edge for e in run.entries if e.is_in and e.verdict]
    outside = [e.edge for e in run.entries if not e.is_in and e.reason not in FINAL]
    return run.influence_model.of(inside, outside)


def sentences(run: SavedGraph, found: Influences) -> tuple[list[dict[str, Any]], Index]:
    """Make the texts of all edges: groups with a title and lines of name and text, and the group (n,) of each edge."""
    changed = {change.edge for change in run.changes}
    limits = {dof: quantile(run.config.robust.gate, dof) for dof in {e.dof for e in run.entries}}
    known, groups, at = dict[Any, int](), list[dict[str, Any]](), np.zeros(len(run.entries), dtype=np.int64)
    is_known = np.isfinite(found.end_m)
    for k, e in enumerate(run.entries):
        limit = limits[e.dof]
        ends = tuple(ends_of(e, run))
        bounds = e.threshold < 0.99 * limit, limit < 0.99 * e.threshold
        effect = bool(is_known[k]), bool(found.is_alone[k]), int(found.end[k])
        about = bool(e.landmark), e.source if e.source in ("", HAND_MADE) else True, e.edge in changed
        key: tuple[Any, ...] = (e.tag, e.label, e.verdict, e.reason, *ends, *bounds, *effect, *about)
        key = (PLACES,) if e.label == PLACES else key
        if key not in known:
            known[key] = len(groups)
            groups.append(_group(run, e, ends, effect, is_changed=e.edge in changed))
        at[k] = known[key]
    return groups, at


def _group(
    run: SavedGraph, e: Entry, ends: Sequence[str], effect: tuple[bool, bool, int], *, is_changed: bool
) -> dict[str, Any]:
    if e.label == PLACES:
        return {"title": "edge {edge}", "lines": [["", "{place}"]]}
    lines = [[what, text] for what, text in statements(e, run, is_changed=is_changed)]
    if is_changed:
        lines.append(["changed", "{changes}"])
    if e.verdict and e.reason not in FINAL:
        lines.append(["what if", _what_if(run, e, ends, *effect)])
    if not e.is_in:
        lines.append(["to change", remedy(e)])
    return {"title": title(e, run), "lines": lines}


def _what_if(run: SavedGraph, e: Entry, ends: Sequence[str], is_known: bool, is_alone: bool, end: int) -> str:
    name = shown(run.folder.name)
    which, option = ("out", "--without") if e.is_in else ("in with its full weight", "--with")
    exactly = f"graph_slam explain {name} {option} {{edge}} solves it"
    if is_alone:
        return f"it were {which}: nothing else determines one of its vertices, and nothing could be solved"
    if not is_known:
        return f"it were {which}: the map would change too much for one step to say how; {exactly}"
    return (
        f"it were {which}, to first order: cost {{cost:+.4g}}, the last pose moves by {{last_m:.3f}} m,"
        f" {ends[end]} by {{end_m:.3f}} m; {exactly}"
    )


def closure_groups(run: SavedGraph) -> list[Group]:
    """Groups of accepted closures that join the same parts of the drive; none where nothing contradicts any closure.

    Returns of each group ``edges``, ``ends`` (first and last keyframe at either end), ``chi2`` with and without it,
    ``most`` (the keyframe that moves farthest without it, and by how much [m]); the last two are None where nothing
    else determines the map without it.

    Closures of one group agree with one another. If they are wrong together, as where two aisles look alike, no
    statistic of the run shows it. A person who sees the map without each group knows.
    """
    closures = [e for e in run.entries if e.label == "closures" and e.verdict and len(e.vertices) == 2]
    inside = [e for e in closures if e.is_in]
    if len(inside) == len(closures) or len(inside) > _MOST_EDGES:
        return []
    several = sorted(_joined(run, inside), key=len, reverse=True)[:_MOST]
    return [_without(run, group) for group in sorted(several, key=lambda group: _ends(run, group[0]))]


def _ends(run: SavedGraph, e: Entry) -> tuple[int, int]:
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
