"""The work behind the page: what-if solved, edits tried and saved. Nothing of it changes the run that is shown."""

import getpass
import json
import os
import shlex
import threading
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.analysis.explain import STATES
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import FormatError, GaugeError, GraphSlamError, SingularError
from graph_slam_ros.graph import Loss
from graph_slam_ros.graph.losses import NAMES
from graph_slam_ros.maps.edit import FORMAT, VERSION, Edited, Rehearsal, edit, plan_of, source_hash
from graph_slam_ros.measurements.edits import ACTIONS
from graph_slam_ros.runs.folder import summary_of
from graph_slam_ros.slam import MapView
from graph_slam_ros.solver import Solver
from graph_slam_ros.tools.report.contents import Contents
from graph_slam_ros.tools.report.packing import shown
from graph_slam_ros.tools.report.verdict import verdict

_KEYS = {"without": list, "let_in": list, "loss": str, "first": bool}
_FIRST_STEPS = 3  # of an answer that is not to wait for the solution
_DECIMALS = 5  # of positions [m]
_MOST_CHANGES = 200
_MOST_PATH = 10_000  # characters


class Workbench:
    """Solves a run in other ways, and saves edits of it as other runs.

    Raises GraphSlamError: the run has no map that can be shown.

    Parameters
    ----------
    made : the contents of its report
    scale : of a loss, as the page begins with it [sigmas]
    """

    def __init__(self, made: Contents, scale: float) -> None:
        if made.saved is None:
            raise GraphSlamError(f"{made.run}: no map to show: {made.losses[0] if made.losses else 'no keyframe'}")
        self._saved: SavedGraph = made.saved
        self._run, self._source, self._scale = made.run, source_hash(made.run), scale
        self._rehearsal: Rehearsal | None = None
        self._lock = threading.Lock()

    @property
    def page_data(self) -> dict[str, Any]:
        """Return the source of plans, and the kinds of edits."""
        kinds = [
            {
                "do": do,
                "help": action.help.replace("`", ""),
                "fields": [
                    {"key": key, "kind": field.kind, "text": field.text, "is_needed": key in action.fields}
                    for key, field in action.known.items()
                ],
            }
            for do, action in ACTIONS.items()
        ]
        run = self._saved
        headings = np.round(run.whole_path.poses()[:, 2], _DECIMALS).tolist() if run.space.dimensions == 2 else []
        return {
            "plan": {"format": FORMAT, "version": VERSION, "source": self._source},
            "kinds": kinds,
            "losses": [*NAMES],
            "scale": self._scale,
            "who": _user(),
            "headings": headings,
            "run": _path(self._run),
        }

    def solve(self, body: bytes) -> dict[str, Any]:
        """Solve the run without some edges, with others, or with another loss, as ``graph_slam explain RUN --without``.

        Raises GraphSlamError: it is nothing of that kind, or cannot be solved.

        Parameters
        ----------
        body : JSON with ``without`` and ``let_in``, lists of edges, and ``loss``: NAME:SCALE, none or empty;
            ``first`` asks for the first steps. Where ``is_solved`` is false, the answer is no solution
        """
        asked = _asked(body)
        with self._lock:
            run = self._saved
            solver = run.problem(asked["without"], asked["let_in"], _loss(asked["loss"]))
            settings = solver.settings
            report = solver.optimize(replace(settings, max_iterations=_FIRST_STEPS) if asked["first"] else settings)
            moved = run.moved(solver)
            return {
                "is_solved": report.converged,
                "places": self._places(solver),
                "landmarks": _landmarks(run.view, solver),
                "chi2": [moved.before.chi2_final, moved.after.chi2_final],
                "cost": [moved.before.cost_final, moved.after.cost_final],
                "final_m": moved.final[0],
                "most": [run.keyframe(moved.most[0]), moved.most[1]],
            }

    def attempt(self, body: bytes) -> dict[str, Any]:
        """Apply a plan in memory: the map that ``save`` would write. Raises GraphSlamError where it cannot be."""
        plan = plan_of(body.decode("utf-8", "replace"))
        self._check_source(plan.source)
        with self._lock:
            if self._rehearsal is None:
                self._rehearsal = Rehearsal(self._saved.view, self._run)
            view, edited = self._rehearsal.attempt(plan.edits)
            return {
                "places": self._places(view.solver),
                "landmarks": _landmarks(view, view.solver),
                "changes": self._changes(view, edited),
                **_effect(edited),
            }

    def save(self, body: bytes) -> dict[str, Any]:
        """Write the run that a plan makes of this one, next to it: as ``graph_slam map edit``. Nothing is replaced.

        Raises GraphSlamError: the plan cannot be applied, or the run cannot be written. Nothing was written.
        """
        plan = plan_of(body.decode("utf-8", "replace"))
        self._check_source(plan.source)
        with self._lock:
            out = _free(self._run)
            edited = edit(self._run, plan, out)
        words = ["graph_slam", "map", "edit", str(self._run), "--plan", "edits.json", "--out", str(out)]
        return {
            "folder": shown(str(out), _MOST_PATH),
            "command": shown(shlex.join(words), _MOST_PATH),
            "verdict": _verdict(out),
            "next": f"graph_slam view {_path(out)}",
            "losses": [shown(one) for one in edited.losses],
            **_effect(edited),
        }

    def _check_source(self, source: str) -> None:
        if source != self._source:
            raise GraphSlamError("the plan is for another run than the one on this page")

    def _places(self, solver: Solver) -> list[list[float]]:
        n, path = self._saved.space.dimensions, self._saved.whole_path.poses(solver)
        places = np.zeros((3, len(path)))
        places[:n] = path[:, :n].T
        columns: list[list[float]] = np.round(places, _DECIMALS).tolist()
        return columns

    def _changes(self, view: MapView, edited: Edited) -> list[list[Any]]:
        """Edges whose verdict is another afterwards, and which were not named by an edit: id, before and after."""
        by_hand = {edge for one in edited.edits for edge in one.edges}
        ledger, out = view.ledger, []
        for row, e in enumerate(self._saved.entries):
            after = ledger.verdict_of(row)
            if after is not e.verdict and e.edge not in by_hand:
                out.append([e.edge, STATES[e.verdict], STATES[after]])
        return out[:_MOST_CHANGES]


def _effect(edited: Edited) -> dict[str, Any]:
    return {
        "texts": [shown(one.edit.text) for one in edited.edits],
        "chi2": list(edited.chi2),
        "final_m": edited.final_m,
        "most": list(edited.moved),
        "notes": [shown(one) for one in (*(fit.text for fit in edited.by_hand), *edited.warnings)],
    }


def _verdict(out: Path) -> str:
    """The first sentence of the report on a run that was just written; empty where it cannot be read."""
    losses: list[str] = []
    try:
        saved = SavedGraph(out, losses)
        return verdict(out, summary_of(out), saved, None, losses)[0]
    except (GraphSlamError, OSError):
        return ""


def _landmarks(view: MapView, solver: Solver) -> dict[str, list[Any]]:
    """Positions of the landmarks that are in a solution, by name: as the page shows names."""
    inside = set(solver.vertices.tolist())
    marks = {name: mark.vertex for name, mark in view.landmarks.items() if mark.vertex in inside}
    n = view.space.dimensions
    return {
        shown(name): np.round(place[:n], _DECIMALS).tolist()
        for name, vertex in marks.items()
        for place in (solver.estimate([vertex])[0],)
    }


def _asked(body: bytes) -> dict[str, Any]:
    try:
        asked = json.loads(body)
    except (ValueError, RecursionError):
        raise FormatError("not JSON") from None
    if not isinstance(asked, dict) or set(asked) != set(_KEYS):
        raise FormatError(f"a what-if has the keys {', '.join(_KEYS)}")
    for key, kind in _KEYS.items():
        if not isinstance(asked[key], kind):
            raise FormatError(f"{key}: not a {kind.__name__}")
    for key in ("without", "let_in"):
        if not all(type(one) is int for one in asked[key]):
            raise FormatError(f"{key}: not a list of whole numbers")
    return asked


def _loss(text: str) -> Loss | None:
    """The loss of ``none`` or ``NAME:SCALE``; None for an empty text."""
    if not text:
        return None
    name, _, scale = text.partition(":")
    try:
        return Loss.named(name, float(scale) if name != "none" else 1.0)
    except ValueError:
        raise FormatError(f"loss: {scale[:40]!r} is not a number") from None


def _free(run: Path) -> Path:
    """A folder next to a run where nothing is."""
    run = run.resolve()
    for k in count(1):
        out = run.with_name(f"{run.name}_edited" + (f"_{k}" if k > 1 else ""))
        if not os.path.lexists(out):
            return out
    raise AssertionError("count() ends never")


def _path(folder: Path) -> str:
    return shown(shlex.quote(str(folder)), _MOST_PATH)


def _user() -> str:
    try:
        name = getpass.getuser()
    except (KeyError, OSError, ImportError):
        return ""
    return "" if name == "root" else name  # which is nobody's


def readable(error: Exception) -> str:
    """The line that the page shows of a fault."""
    if isinstance(error, GaugeError | SingularError):
        return f"it cannot be solved: {error}"
    return shown(str(error)) or type(error).__name__
