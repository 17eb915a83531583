"""The sentences of ``explain`` for all edges of a run: a few templates, and the numbers to fill in.

``explain`` itself makes each template, from an edge with placeholders as numbers. So page and command say the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from graph_slam_ros.analysis import measurement_text
from graph_slam_ros.analysis.explain import Numbers, change_text, remedy, statements, title
from graph_slam_ros.analysis.influence import Influences
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.slam.edits import HAND_MADE
from graph_slam_ros.slam.robust.ledger import FINAL
from graph_slam_ros.tools.report.packing import shown
from graph_slam_ros.typing import Array

_DEGREES = 180.0 / np.pi


class _Number(float):
    """A number that is shown as its name and format: ``{chi2:.4g}``. It compares as itself."""

    name: str

    def __new__(cls, value: float, name: str) -> "_Number":
        out = super().__new__(cls, value)
        out.name = name
        return out

    def __format__(self, spec: str) -> str:
        return f"{{{self.name}:{spec}}}" if spec else f"{{{self.name}}}"

    def __mul__(self, factor: float) -> "_Number":
        """Return itself: its column is in the unit that is shown."""
        return self


class _Text(str):
    """A text that is shown as its name."""

    name: str

    def __new__(cls, value: str, name: str) -> "_Text":
        out = super().__new__(cls, value)
        out.name = name
        return out

    def __format__(self, spec: str) -> str:
        return f"{{{self.name}}}" if self else ""


@dataclass(frozen=True, slots=True)
class Effects:
    """The effects of leaving out each edge that is in, or of letting in each that is out: by edge, NaN where not known.

    Attributes
    ----------
    last_m : motion of the last keyframe; end_m : of the vertex of the edge that moves farthest, ``end``
    cost : change of the cost
    is_alone : nothing else determines one of its vertices
    """

    last_m: Array
    end_m: Array
    end: Any
    cost: Array
    is_alone: Any


def effects(run: SavedGraph) -> Effects:
    """Compute the effects of all judged edges, to first order."""
    count, n = len(run.entries), run.space.dimensions
    last_m, end_m, cost = np.full((3, count), np.nan)
    out = Effects(last_m, end_m, np.zeros(count, dtype=np.int64), cost, np.zeros(count, dtype=bool))

    def enter(found: Influences) -> None:
        at = found.edges
        out.last_m[at], out.end_m[at] = np.linalg.norm(found.step[:, :n], axis=1), found.end_m
        out.end[at], out.cost[at], out.is_alone[at] = found.end, found.cost, found.is_alone

    inside = [row for row, e in enumerate(run.entries) if e.is_in and e.verdict]
    outside = [row for row, e in enumerate(run.entries) if not e.is_in and e.reason not in FINAL]
    if inside:
        enter(run.influence_model.without(inside))
    if outside:
        enter(run.influence_model.with_them(outside))
    return out


@dataclass(frozen=True, slots=True)
class Sentences:
    """The texts, and which of them each edge has.

    Attributes
    ----------
    groups : each a title, lines of name and text, and what its vertices are called
    group : (n,) the group of each edge
    numbers : by name (n,) values, as the texts name them
    changes : changes of the verdict, by edge
    """

    groups: list[dict[str, Any]]
    group: Any
    numbers: Mapping[str, Array]
    changes: dict[int, list[str]]


def sentences(run: SavedGraph, found: Effects) -> Sentences:
    """Make the texts of all edges."""
    entries = run.entries
    history: dict[int, list[Any]] = {}
    for change in run.changes:
        history.setdefault(change.edge, []).append(change)
    limits = {dof: quantile(run.config.robust.gate, dof) for dof in {e.dof for e in entries}}
    known, groups, at = dict[Any, int](), list[dict[str, Any]](), np.zeros(len(entries), dtype=np.int64)
    is_known = np.isfinite(found.end_m)
    for k, e in enumerate(entries):
        limit = limits[e.dof]
        kinds = tuple(_kind(run, e, vertex) for vertex in e.vertices)
        bounds = e.threshold < 0.99 * limit, limit < 0.99 * e.threshold
        effect = bool(is_known[k]), bool(found.is_alone[k]), int(found.end[k])
        about = bool(e.landmark), e.source if e.source in ("", HAND_MADE) else True, k in history
        key: tuple[Any, ...] = (e.tag, e.label, e.verdict, e.reason, *kinds, *bounds, *effect, *about)
        key = (PLACES,) if e.label == PLACES else key
        if key not in known:
            known[key] = len(groups)
            groups.append(_group(run, e, kinds, history.get(k, ()), effect))
        at[k] = known[key]
    changes = {edge: [change_text(c) for c in several] for edge, several in history.items()}
    return Sentences(groups, at, _numbers(entries), changes)


def _kind(run: SavedGraph, e: Entry, vertex: int) -> str:
    if run.keyframe(vertex) is not None:
        return "keyframe"
    return "landmark" if e.landmark else "vertex"


def _group(
    run: SavedGraph, e: Entry, kinds: Sequence[str], history: Sequence[Any], effect: tuple[bool, bool, int]
) -> dict[str, Any]:
    """The texts of one edge, with places for what is its own."""
    if e.label == PLACES:
        return {"title": "edge {edge}", "lines": [["", "{place}"]], "ends": []}
    ends = ["landmark {landmark}" if kind == "landmark" else f"{kind} {{end{slot}}}" for slot, kind in enumerate(kinds)]
    own: Any = SimpleNamespace(
        edge=_Number(e.edge, "edge"),
        label=e.label,
        tag=e.tag,
        source=_Text(e.source, "source"),
        landmark=_Text(e.landmark, "landmark"),
        keyframe=_Number(e.keyframe, "keyframe"),
        stamp_s=_Number(e.stamp_s, "stamp_s"),
        statistic=_Number(e.statistic, "statistic"),
        dof=e.dof,
        threshold=_Number(e.threshold, "threshold"),
        chi2=_Number(e.chi2, "chi2"),
        percent=_Number(0.0, "percent"),
        sigma_factor=_Number(0.0, "sigma_factor"),
        verdict=e.verdict,
        reason=e.reason,
        is_in=e.is_in,
    )
    several = Numbers.of(e)._asdict().items()
    numbers = Numbers(*([_Number(0.0, f"{name}{k}") for k in range(len(of))] for name, of in several))
    lines = [[what, text] for what, text in statements(own, ends, numbers, (), run.config) if not history]
    if history:  # it says whether an edge came in later
        lines = [[what, text] for what, text in statements(own, ends, numbers, history[:1], run.config)]
        lines = [line for line in lines if line[0] != "changed"] + [["changed", "{changes}"]]
    if e.verdict and e.reason not in FINAL:
        lines.append(["what if", _what_if(run, e, ends, *effect)])
    if not e.is_in:
        lines.append(["to change", remedy(own)])
    of = "{landmark}" if e.landmark else " and ".join(run.landmarks_of(e))
    return {"title": title(own, of), "lines": lines, "ends": ends}


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


def _numbers(entries: Sequence[Entry]) -> dict[str, Array]:
    """The numbers that texts have places for, in the units that are shown."""
    out: dict[str, Array] = {}
    by_tag: dict[str, list[tuple[int, Entry]]] = {}
    for row, e in enumerate(entries):
        if e.label != PLACES:
            by_tag.setdefault(e.tag, []).append((row, e))
    for tag, rows in by_tag.items():
        at, several = np.array([row for row, _ in rows]), [e for _, e in rows]
        m = several[0].dof
        upper, information = np.triu_indices(m), np.zeros((len(several), m, m))
        values = np.array([e.information for e in several])
        information[:, upper[0], upper[1]] = information[:, upper[1], upper[0]] = values
        of = {name: tuple(np.array([getattr(e, name) for e in several]).T) for name in ("measured", "residual")}
        whole: Any = SimpleNamespace(tag=tag, dof=m, **of)
        expected = measurement_text.expected(whole)
        sigmas = tuple(measurement_text.sigmas_of(information).T)
        for name, columns in zip(Numbers._fields, (measurement_text.measured(whole), sigmas, expected), strict=True):
            is_angle = [unit == "rad" for _, unit in measurement_text.units(tag, len(columns))]
            for k, column in enumerate(columns):
                unit = _DEGREES if is_angle[k] else 1.0
                out.setdefault(f"{name}{k}", np.full(len(entries), np.nan))[at] = column * unit
    return out
