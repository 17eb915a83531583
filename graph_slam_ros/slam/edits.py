"""Edits by hand, while the robot drives or afterwards: each kind is done by the part that knows how."""

import re
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edits import AppliedEdit, Value, aliases, edit_of
from graph_slam_ros.measurements.types import Control, Event
from graph_slam_ros.slam.anchor import Anchor
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.drive_cut import DriveCut
from graph_slam_ros.slam.edit_tools import BY_HAND, EditTools
from graph_slam_ros.slam.failure_guard import FailureGuard
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.landmark_edits import LandmarkEdits
from graph_slam_ros.slam.landmarks.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.path_edits import PathEdits
from graph_slam_ros.slam.robust.gating import CANDIDATES
from graph_slam_ros.slam.robust.landmark_support import landmark_of
from graph_slam_ros.slam.robust.ledger import Reason

SOURCE = "edit"
_IF_CONDENSED = ("remove_edge", "let_in_edge", "add_closure", "rename_landmark")  # possible if visits are condensed
_EDIT = re.compile(r"\s*(edge|landmark)\s+(\S.{0,127}?)\s*", re.DOTALL)
_ID = re.compile(r"\d{1,18}", re.ASCII)


def removal(text: str) -> Control:
    """The event that a text of ``~/remove`` asks for: ``edge 231`` or ``landmark dock``.

    Raises
    ------
    GraphSlamError
        It is neither.
    """
    found = _EDIT.fullmatch(text[:1000])
    if found and found[1] == "landmark":
        return Control("remove", (("landmark", found[2]),))
    if found and _ID.fullmatch(found[2]):
        return Control("remove", (("edge", int(found[2])),))
    raise GraphSlamError(f"~/remove: {text[:40]!r} is neither 'edge ID' nor 'landmark NAME'")


class Edits:
    """Changes a map by hand; whatever cannot be done is counted under ``edit``.

    Parameters
    ----------
    backend : has the graph, its solver and the ledger
    landmarks : the landmarks of the graph, and the association of those without identity
    guard : keeps the estimate to go back to
    """

    def __init__(
        self,
        space: Geometry,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        anchor: Anchor,
        guard: FailureGuard,
        counters: Counters,
    ) -> None:
        self._backend, self._frontend, self._landmarks, self._counters = backend, frontend, landmarks.map, counters
        self._tools = tools = EditTools(backend, landmarks.map, counters)
        self._of_landmarks = LandmarkEdits(tools, frontend)
        on_moved = landmarks.forget_where, guard.note_moved
        self._of_path = PathEdits(space, tools, frontend, anchor, on_moved)
        self._cut = DriveCut(space, tools, frontend, self._of_landmarks, self._of_path, anchor)
        self._landmarks.aliases = aliases(backend.edits)

    def change(self, event: Event, values: Mapping[str, Value], keyframe: int) -> bool:
        """Change what a control event asks for; returns whether all is to be solved at once."""
        if event == "edit":
            self.apply(values, keyframe)  # others may follow: ``optimize`` solves
            return False
        return self.remove(values, keyframe)

    def apply(self, values: Mapping[str, Value], keyframe: int) -> None:
        """Apply an edit of a plan, and note it in the map; nothing is solved.

        Raises
        ------
        GraphSlamError
            It cannot be applied to this map: nothing has changed.
        """
        edit, backend = edit_of(values), self._backend
        if any(one.edit.name == edit.name for one in backend.edits):
            raise GraphSlamError(f"edit {edit.name}: the map has an edit of that name already")
        if not self._frontend.path.keyframes:
            raise GraphSlamError(f"edit {edit.name}: there is no map yet")
        if self._frontend.path.keyframes.first and edit.do not in _IF_CONDENSED:
            raise GraphSlamError(f"edit {edit.name}: {self._tools.refusal('condensed_in_map')}")
        backend.gate_new(keyframe)
        edges, changes = backend.graph.edge_count, len(backend.ledger.history)
        try:
            self._apply(edit.do, dict(edit.arguments), keyframe)
        except GraphSlamError as error:
            of = [edit.do] * (edit.name != edit.do)
            of += [f"{key} {edit.arguments[key]}" for key in ("edge", "landmark") if key in edit.arguments]
            name = f"{edit.name} ({', '.join(of)})" if of else edit.name
            raise GraphSlamError(f"edit {name}: {error}") from None
        decided = [one.edge for one in backend.ledger.history[changes:] if one.reason is Reason.BY_HAND]
        out = tuple(edge for edge in dict.fromkeys(decided) if edge < edges)
        added, number = range(edges, backend.graph.edge_count), backend.graph.edge_ids.of
        ids = (tuple(map(number, some)) for some in (out, added))
        backend.edits.append(AppliedEdit(edit, len(self._frontend.path.keyframes) - 1, *ids))
        self._landmarks.aliases = aliases(backend.edits)

    def _apply(self, do: str, a: dict[str, Any], keyframe: int) -> None:
        marks, path = self._of_landmarks, self._of_path
        match do:
            case "remove_edge":
                self._remove_edge(self._row(a["edge"]), keyframe, Reason.BY_HAND)
            case "let_in_edge":
                self._include_by_hand(self._row(a["edge"]), keyframe)
            case "add_closure":
                ends = path.at(a["from_keyframe"]), path.at(a["to_keyframe"])
                path.add_closure(ends, a["pose"], (a["sigma_m"], a["sigma_rad"]), keyframe)
            case "remove_landmark":
                marks.remove(a["landmark"], keyframe)
            case "rename_landmark":
                marks.rename_landmark(a["landmark"], a["to"])
            case "merge_landmarks":
                marks.merge(a["landmark"], a["into"], keyframe)
            case "split_landmark":
                chosen = a.get("edges") or marks.edges_between(a["landmark"], *path.between(a["from"], a["until"]))
                marks.split(a["landmark"], a["to"], chosen, keyframe)
            case "move_anchor":
                path.anchor_at(path.at(a["keyframe"]), a["pose"], (a["sigma_m"], a["sigma_rad"]), keyframe)
            case "move_map":
                path.move(a["pose"], (a["sigma_m"], a["sigma_rad"]), keyframe)
            case "cut":
                self._cut.cut(*path.between(a["from"], a["until"]), keyframe)

    def remove(self, what: Mapping[str, Value], keyframe: int) -> bool:
        """Remove what a control event names, an edge or a landmark; returns whether it was there."""
        try:
            if "edge" in what:
                self._remove_edge(self._row(int(str(what["edge"]))), keyframe, Reason.WITHDRAWN)
            elif self._frontend.path.keyframes.first:
                self._refuse("condensed_in_map")
            else:
                self._of_landmarks.remove(str(what["landmark"]), keyframe, Reason.WITHDRAWN)
        except GraphSlamError:  # it is counted
            return False
        return True

    def clear_closures(self, keyframe: int) -> bool:
        """Remove all loop closures, but for those of a frozen map; returns whether there was any."""
        ledger = self._backend.ledger
        self._backend.hand_over()
        closures = [edge for edge in self._backend.graph.edges_of("closures").tolist() if edge >= ledger.final]
        self._backend.withdraw(closures, keyframe)
        if closures:
            self._counters.count("closures", "cleared", len(closures))
        return bool(closures)

    def _row(self, lasting: int) -> int:
        """The edge of the graph that has a lasting id."""
        row = self._backend.graph.edge_ids.find(lasting) if lasting >= 0 else lasting
        if row is None:
            self._refuse("condensed_in_map")
        return row

    def _remove_edge(self, edge: int, keyframe: int, reason: Reason) -> None:
        """Remove a loop closure, a fix or an observation of a landmark, by its id.

        A landmark is removed with the last of its edges.
        """
        backend = self._backend
        backend.hand_over()
        if not 0 <= edge < backend.graph.edge_count or backend.ledger.is_withdrawn(edge):
            self._refuse("unknown_edge")
        if backend.graph.label_of(edge) not in (*CANDIDATES, BY_HAND) or self._of_path.anchors() == [edge]:
            self._refuse("needed_edge")
        if edge < backend.ledger.final:
            self._refuse("held_in_map")
        vertex = landmark_of(backend.graph, edge)
        if vertex is not None and self._tools.determining(vertex) == [edge]:
            self._of_landmarks.remove(self._name_of(vertex), keyframe, reason)
            return
        backend.withdraw([edge], keyframe, reason)
        self._counters.count(SOURCE, "removed")

    def _include_by_hand(self, edge: int, keyframe: int) -> None:
        """An edge without a loss, which is never judged, replaces an edge that may be out."""
        backend, graph = self._backend, self._backend.graph
        if edge >= graph.edge_count:
            self._refuse("unknown_edge")
        one = graph.edge(edge)
        if one.label not in CANDIDATES:
            self._refuse("needed_edge")
        if edge < backend.ledger.final:
            self._refuse("held_in_map")
        if not np.isin(one.vertices, backend.solver.vertices).all():
            raise GraphSlamError("its landmark or keyframe is not in the map any more")
        self._tools.add(
            one.type, one.vertices, tuple(one.measured), Gaussian(one.sqrt_information), keyframe, one.source
        )
        self._tools.withdraw([edge], keyframe)
        self._counters.count(SOURCE, "let_in")

    def _name_of(self, vertex: int) -> str:
        return next((name for name, mark in self._landmarks.known.items() if mark.vertex == vertex), "")

    def _refuse(self, reason: str) -> NoReturn:
        raise GraphSlamError(self._tools.refusal(reason))
