"""A plan of edits by hand, and the run that it makes from another run."""

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import FormatError, GaugeError, GraphSlamError, SingularError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.formats.files import opened, read_text
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edits import AppliedEdit, Edit, edit_of
from graph_slam_ros.runs.folder import CONFIG, RunError, check_room, check_run, discard, recording_of
from graph_slam_ros.runs.journal import INGEST, MAP, parts_of
from graph_slam_ros.runs.restore import config_to_go_on, record_run, restored, stopwatch
from graph_slam_ros.slam import Config, Control, GraphSlam, MapView
from graph_slam_ros.slam.map_editor import MapEditor
from graph_slam_ros.slam.robust.innovation import innovations
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.solver import Solver

FORMAT, VERSION = "graph_slam_ros edits", 1
_KEYS = ("format", "version", "source", "edits")
_MOST_BYTES = 2**24
_MOST_EDITS = 10_000


@dataclass(frozen=True, slots=True)
class Plan:
    """Edits of one run.

    Attributes
    ----------
    source : ``source_hash`` of the run that it was made for
    edits : in the order in which they are applied
    """

    source: str
    edits: tuple[Edit, ...]


@dataclass(frozen=True, slots=True)
class Fit:
    """The fit of an edge that is in by hand.

    Attributes
    ----------
    innovation, limit : chi2 of the edge against all else before the solve, and what a gate would hold it against;
        infinite where nothing else determines what it is between
    chi2, residual : after the solve, which the edge has bent; the second in the units of its type
    """

    edge: int
    innovation: float
    limit: float
    chi2: float
    residual: tuple[float, ...]

    @property
    def text(self) -> str:
        """Return the numbers in words."""
        numbers = " ".join(f"{number:.3g}" for number in self.residual)
        after = f"chi2 {self.chi2:.4g} after the solve, residual {numbers}"
        if math.isinf(self.innovation):
            return f"edge {self.edge}: nothing else determines what it is between, {after}"
        return f"edge {self.edge}: chi2 {self.innovation:.4g} against all else, {after}"


@dataclass(frozen=True, slots=True)
class Edited:
    """The outcome of a plan.

    Attributes
    ----------
    edits : as they were applied
    chi2 : of the accepted edges, before and after
    moved : the number of the keyframe that moved farthest, and by how much [m]
    final_m : by how much the last keyframe moved [m]
    by_hand : edges that are in by hand
    outvoted : edges that were believed, and are out now
    summary : of the new run; empty where none was written
    losses : parts of the run that could not be read
    """

    edits: tuple[AppliedEdit, ...]
    chi2: tuple[float, float]
    moved: tuple[int, float]
    final_m: float
    by_hand: tuple[Fit, ...]
    outvoted: tuple[int, ...]
    summary: dict[str, Any]
    losses: list[str]

    @property
    def warnings(self) -> list[str]:
        """Sentences on edges that all else contradicts, and on those that are not believed any more."""
        out = [
            f"edge {fit.edge} is in by hand, and all else contradicts it: chi2 {fit.innovation:.4g}, above"
            f" {fit.limit:.4g}"
            for fit in self.by_hand
            if fit.limit < fit.innovation < math.inf
        ]
        if self.outvoted:
            first = " ".join(map(str, self.outvoted[:5]))
            out.append(f"edges that were believed and are out now: {len(self.outvoted)}, the first are {first}")
        return out


# -- plans -------------------------------------------------------------------------------------------------------------


def source_hash(folder: Path) -> str:
    """The hash of a run that a plan names: of its configuration, its journal and its map.

    Raises RunError: it is no run, or a file of it cannot be read.
    """
    check_run(folder)
    digest = hashlib.sha256()
    for file in (folder / CONFIG, *parts_of(folder, INGEST), *filter(os.path.lexists, [folder / MAP])):
        try:
            with opened(file, follow=False) as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise RunError(f"{file}: {error.strerror}") from None
        digest.update(f"{file.name} {content}\n".encode())
    return f"sha256:{digest.hexdigest()}"


def _content(plan: Plan) -> dict[str, Any]:
    return {"format": FORMAT, "version": VERSION, "source": plan.source, "edits": [e.values for e in plan.edits]}


def plan_text(plan: Plan) -> str:
    """A plan as JSON."""
    return json.dumps(_content(plan), indent=2, ensure_ascii=False) + "\n"


def write_empty_plan(folder: Path, file: Path) -> None:
    """Write a plan without edits for a run, to be filled. Raises GraphSlamError where something is there already."""
    if os.path.lexists(file):
        raise GraphSlamError(f"{file}: exists already: choose another name")
    write_whole(file, plan_text(Plan(source_hash(folder), ())).encode())


def read_plan(file: Path) -> Plan:
    """Read a plan. Raises FormatError: it is not a plan; the text names the edit and the key."""
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise FormatError(f"larger than {_MOST_BYTES} bytes: not read")
        return plan_of(read_text(file))
    except OSError as error:
        raise FormatError(f"{file}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise FormatError(f"{file}: not JSON: {error}") from None
    except FormatError as error:
        raise FormatError(f"{file}: {error}") from None


def plan_of(text: str) -> Plan:
    """The plan of a JSON text. Raises FormatError where it is none; the message names the edit and the key."""
    try:
        content = json.loads(text, object_pairs_hook=_without_repeats, parse_constant=_no_number)
    except (ValueError, RecursionError, FormatError) as error:
        raise FormatError(f"not JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise FormatError(f'not a plan of edits: no "format": "{FORMAT}"')
    for key in content:
        if key not in _KEYS:
            raise FormatError(f"{shortened(key)}: unknown key; a plan has {', '.join(_KEYS)}")
    if type(content.get("version")) is not int or content["version"] != VERSION:
        raise FormatError(f"version: {shortened(content.get('version'))} is not {VERSION}, which this program reads")
    source, edits = content.get("source"), content.get("edits")
    if not isinstance(source, str):
        raise FormatError(f"source: {shortened(source)} is not the hash of a run")
    if not isinstance(edits, list) or len(edits) > _MOST_EDITS:
        raise FormatError(f"edits: {shortened(edits)} is not a list of at most {_MOST_EDITS} edits")
    return Plan(source, _edits(edits))


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) < len(pairs):
        names = [name for name, _ in pairs]
        raise FormatError(f"key {shortened(next(n for n in names if names.count(n) > 1))} is there twice")
    return out


def _no_number(word: str) -> Any:
    raise FormatError(f"{word} is not a finite number")


def _edits(several: Sequence[Any]) -> tuple[Edit, ...]:
    read = list[Edit]()
    for number, values in enumerate(several, start=1):
        try:
            read.append(edit_of(values))
        except FormatError as error:
            raise FormatError(f"edit {number}: {error}") from None
        if read[-1].name in {one.name for one in read[:-1]}:
            raise FormatError(f"edit {number}: name: {shortened(read[-1].name)} is the name of another edit, too")
    return tuple(read)


# -- what a plan makes of a run ----------------------------------------------------------------------------------------


def edit(folder: Path, plan: Plan, out: Path | None) -> Edited:
    """Apply a plan to the map of a run, solve everything, and write it as another run.

    Raises GraphSlamError: the plan is for another run, has no edits, or one cannot be applied; or the map cannot be
    solved with it. Nothing was written.

    Parameters
    ----------
    out : nothing may be there; None: nothing is written
    """
    took = stopwatch()
    if out is not None:
        check_room(out, folder)
        if os.path.lexists(out):
            raise RunError(f"{out}: exists already: an edited map is written to a new folder")
    if (found := source_hash(folder)) != plan.source:
        raise GraphSlamError(f"the plan is for another run: its source is {plan.source[:80]}, and {folder} is {found}")
    if not plan.edits:
        raise GraphSlamError("the plan has no edits")
    losses, counters = list[str](), Counters()
    slam = restored(folder, losses, counters)
    rehearsal = Rehearsal(slam.view, folder)
    edited = rehearsal.attempt(plan.edits, losses)[1]
    if out is None:
        return edited
    options: dict[str, Any] = {"earlier": counters, "took": took, "recording": recording_of(folder)}
    options["more"] = lambda: {"plan": _content(plan)}
    try:
        config, state = config_to_go_on(slam, folder), rehearsal.edited(plan.edits)
        edited.summary.update(record_run(out, config, [Control("optimize")], losses, state, **options)[1])
    except Exception:
        discard(out)
        raise
    return edited


def edit_run(run: Path | str, edits: Sequence[Mapping[str, Any]], out: Path | str | None = None) -> Edited:
    """Edit the map of a run by hand, as ``graph_slam map edit`` does.

    Parameters
    ----------
    edits : each with ``name``, ``who``, ``when``, ``why``, ``do`` and the keys of its kind, as in a plan
    out : the run folder to write, where nothing may be; None: the effect is computed, and nothing is written

    Raises
    ------
    GraphSlamError
        A key of an edit is wrong, or it cannot be applied; the text names it. Nothing was written.
    """
    folder = Path(run)
    return edit(folder, Plan(source_hash(folder), _edits(edits)), None if out is None else Path(out))


class Rehearsal:
    """The map of a run in memory, on which plans are applied without being written.

    Parameters
    ----------
    view : the restored run, which stays as it is
    folder : of the run
    """

    def __init__(self, view: MapView, folder: Path) -> None:
        self._config, self._before = view.config, view
        self._state = view.snapshot(folder)
        if len(view.ledger) < view.graph.edge_count:  # it never ended
            whole = GraphSlam(view.config, start=self._state)
            whole.process(Control("optimize"))
            self._state = whole.view.snapshot(folder)

    def edited(self, edits: Sequence[Edit]) -> MapSnapshot:
        """A copy of the map to which edits were applied; nothing is solved. Raises GraphSlamError where one fails."""
        state = self._state.copy()
        editor = MapEditor(state, self._config)
        for one in edits:
            editor.apply(one)
        return state

    def attempt(self, edits: Sequence[Edit], losses: Sequence[str] = ()) -> tuple[MapView, Edited]:
        """The map with edits, solved, and what changed. Raises GraphSlamError where one fails."""
        before, state = self._before, self.edited(edits)
        known = len(before.edits)
        done = tuple(state.edits[known:])
        added = [edge for one in done if one.edit.do in ("add_closure", "let_in_edge") for edge in one.added]
        added = [edge for edge in added if not state.ledger.is_withdrawn(edge)]
        costs = _innovations(state, self._config, added)
        try:
            slam = GraphSlam(self._config, start=state)
            slam.process(Control("optimize"))
        except (GaugeError, SingularError) as error:
            raise GraphSlamError(f"the map cannot be solved with these edits: {error}") from None
        if not (after := slam.view).is_solved:
            raise GraphSlamError(f"the map cannot be solved with these edits: {after.failing}")
        n, by_hand = after.space.dimensions, {edge for one in done for edge in one.edges}
        distances = np.linalg.norm(after.trajectory()[:, :n] - before.trajectory()[:, :n], axis=1)
        farthest, inside = int(distances.argmax()), before.ledger.inside.tolist()
        return after, Edited(
            done,
            (before.solver.evaluate().chi2_final, after.solver.evaluate().chi2_final),
            (after.keyframes.first + farthest, float(distances[farthest])),
            float(distances[-1]),
            tuple(_fit(after, edge, cost) for edge, cost in zip(added, costs, strict=True)),
            tuple(edge for edge in inside if edge not in by_hand and not after.ledger.is_inside(edge)),
            {},
            [*losses],
        )


def _innovations(state: MapSnapshot, config: Config, edges: Sequence[int]) -> list[float]:
    """chi2 of edges against a solution of all else; infinite where nothing else determines what they are between."""
    if not edges:
        return []
    graph = state.graph.copy()
    graph.set_weights(np.array(edges), 0.0)
    solver = Solver(graph, config.solver_settings())
    solver.add(state.vertices, graph.edge_ids.since())
    solver.start_at(state.values)
    for vertex in state.vertices:
        if vertex < state.frozen:
            solver.hold(vertex)
    try:
        solver.optimize()
        return innovations(graph, solver, edges)
    except (GaugeError, SingularError):
        return [math.inf] if len(edges) == 1 else [cost for one in edges for cost in _innovations(state, config, [one])]


def _fit(view: MapView, edge: int, innovation: float) -> Fit:
    (chi2,), residual = view.solver.chi2_of([edge])[0].tolist(), tuple(view.solver.residuals_of([edge]).tolist())
    limit = view.backend.decisions.gate_scale * quantile(view.config.robust.gate, len(residual))
    return Fit(edge, innovation, limit, chi2, residual)
