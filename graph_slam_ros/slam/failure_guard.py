"""Recovery from a solve that fails: the last good estimate stays, and soon what has come since is doubted.

All of it follows from the ingest sequence: a replay fails where the live run did, and recovers as it did.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.errors import DivergedError, SingularError, message_of
from graph_slam_ros.graph import GROUPS
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.robust.gating import CANDIDATES
from graph_slam_ros.slam.robust.landmark_support import landmark_of
from graph_slam_ros.slam.robust.ledger import Reason
from graph_slam_ros.typing import Array, Result

_FAR = 1.0  # m, rad: a number that changed by less has not diverged
_RISE = 10.0  # times the cost before, or of residuals as large as their noise: more is no solution
_TRIALS = 30  # solves in search of what is to blame


@dataclass(frozen=True, slots=True)
class _Suspect:
    """Edges that are accepted or rejected together: one, or all of a landmark that is new or not determined."""

    edges: tuple[int, ...]
    landmark: int | None = None


class FailureGuard:
    """Runs solves of a back-end, and restores the last good estimate after a failure.

    Parameters
    ----------
    landmarks : forgets those that are no part of the problem any more

    Attributes
    ----------
    failing : why the last solve failed; empty where it did not
    """

    def __init__(self, backend: Backend, counters: Counters, landmarks: Landmarks) -> None:
        self.failing = ""
        self._backend, self._counters, self._landmarks = backend, counters, landmarks
        self._graph, self._solver = backend.graph, backend.solver
        self._good = np.empty(0)  # stored numbers of all vertices after the last solve that succeeded
        self._good_vertices = self._good_edges = 0  # it had those below
        self._in_a_row = 0  # failures since
        self._undetermined = set[int]()  # vertices that these named

    def solve(self, work: Callable[[], Result]) -> Result | None:
        """Solve by ``work`` and return its result; None if it fails, or if its result is impossible."""
        try:
            return self.checked(work)
        except Exception as error:
            self._fail(error)
        is_new = all(vertex >= self._good_vertices for vertex in self._undetermined)
        if (is_new and self._in_a_row == 1) or self._in_a_row.bit_count() > 1:  # at 2, 4, 8, ...: it costs some solves
            return None
        try:
            return self.checked(work, again=False) if self._quarantine() else None
        except Exception:  # it is the same solve: counted already
            self.go_back()
            return None

    def checked(self, work: Callable[[], Result], *, again: bool = True) -> Result:
        """Run the work, and check the estimate. If steps overshoot, it is repeated after a damped solve of everything.

        Raises
        ------
        DivergedError
            The estimate is impossible, and stays so. So it is with any exception of the work.

        Parameters
        ----------
        again : whether it may be repeated
        """
        done = work()
        try:
            self._refuse_absurd()
        except DivergedError:
            if not again:
                raise
            self.go_back()
            self._solver.optimize()
            return self.checked(work, again=False)
        self.note_good()
        return done

    def note_good(self) -> None:
        """Remember the present estimate as good."""
        self._good, self._good_vertices = self._solver.values, self._graph.vertex_ids.next
        self._good_edges, self._in_a_row, self.failing = self._graph.edge_ids.next, 0, ""
        self._undetermined.clear()

    def note_moved(self) -> None:
        """Move the remembered estimate with the map."""
        self._good = self._solver.values[: len(self._good)]

    def go_back(self) -> None:
        """Return to the last good estimate, in a new solver."""
        self._solver.start_at(self._last_good())
        with suppress(Exception):  # e.g. no memory for it: the estimate is good without
            self._solver.rebuild()

    def _fail(self, error: Exception) -> None:
        self._counters.count_failure("solver", error)
        self.failing = message_of(error)
        self._in_a_row += 1
        self._note_undetermined(error)
        self.go_back()
        self._drop_unmeasured()

    def _note_undetermined(self, error: Exception) -> None:
        if isinstance(error, SingularError) and error.vertex is not None:
            self._undetermined.add(error.vertex)

    def _drop_unmeasured(self) -> None:
        """Remove vertices that lost their edges by a fault, and are undetermined."""
        vertices = self._solver.vertices
        unmeasured = set(vertices[vertices >= self._good_vertices].tolist())
        for edge in self._graph.edge_ids.since(self._good_edges).tolist():
            unmeasured.difference_update(self._graph.edge(edge).vertices)
        for vertex in unmeasured:
            self._solver.remove(vertex)
        self._landmarks.forget(unmeasured)

    def _last_good(self) -> Array:
        """The last good estimate, with newer vertices at their initial values."""
        out: Array = self._graph.initial.values.copy()
        out[: len(self._good)] = self._good
        return out

    def _refuse_absurd(self) -> None:
        """Raise if the estimate is not finite, or far from the last one with a much worse fit."""
        values, before = self._solver.values, self._last_good()
        if not np.isfinite(values).all():
            raise DivergedError("the estimate is not finite")
        if (np.abs(values - before) <= _FAR).all():
            return
        now = self._solver.evaluate()
        if now.cost_final <= _RISE * sum(one.residuals for one in now.classes.values()):
            return
        then = self._solver.evaluate(at=before)
        if not now.cost_final <= _RISE * then.cost_final:
            raise DivergedError(f"the cost rose from {then.cost_final:.3g} to {now.cost_final:.3g}")

    # -- quarantine --------------------------------------------------------------------------------------------------

    def _quarantine(self) -> bool:
        """Remove candidates permanently without which the problem can be solved. Returns whether it can.

        They are those that are new, and those on landmarks that the failures named: a landmark can move so far away in
        later solves that nothing determines it any more.
        """
        while True:
            named, suspects = set(self._undetermined), self._suspects()
            self._exclude(suspects)
            if self._is_solvable():
                break
            self._include(suspects)
            if self._undetermined <= named:
                return False
        blamed = self._to_blame(suspects)
        if not blamed and self._in_a_row > 1:  # rounding decides: every trial succeeds, and the same solve fails again
            blamed = [one for one in suspects if one.landmark in self._undetermined]
            self._exclude(blamed)
        for one in blamed:
            self._counters.count(self._graph.label_of(one.edges[0]), "quarantined", len(one.edges))
            out = one.edges if one.landmark is None else self._solver.edges_on(one.landmark).tolist()
            self._backend.withdraw(out, Reason.QUARANTINED)  # also edges that were held back before
        self._landmarks.forget({one.landmark for one in blamed if one.landmark is not None})
        return True

    def _suspects(self) -> list[_Suspect]:
        edges = self._solver.edges
        found: dict[tuple[bool, int], _Suspect] = {}
        for vertex in sorted(self._undetermined & set(self._solver.vertices.tolist())):
            on = np.intersect1d(self._solver.edges_on(vertex), edges)
            if self._graph.kind_of(vertex) not in GROUPS and self._graph.has_label(on, CANDIDATES).all():
                found[True, vertex] = _Suspect(tuple(on.tolist()), vertex)
        new = np.setdiff1d(edges[edges >= self._good_edges], [edge for one in found.values() for edge in one.edges])
        for edge in new[self._graph.has_label(new, CANDIDATES)].tolist():
            landmark = landmark_of(self._graph, edge)
            if landmark is None or landmark < self._good_vertices:
                found[False, edge] = _Suspect((edge,))
            else:
                before = found.get((True, landmark), _Suspect(()))
                found[True, landmark] = _Suspect((*before.edges, edge), landmark)
        return list(found.values())

    def _to_blame(self, suspects: list[_Suspect]) -> list[_Suspect]:
        """The suspects that must stay rejected, found by halving. The others are accepted again."""
        blamed, groups = list[_Suspect](), [suspects] if suspects else []
        for _ in range(_TRIALS):
            if not groups:
                break
            group = groups.pop()
            self._include(group)
            if self._is_solvable():
                continue
            self._exclude(group)
            half = len(group) // 2
            if half:
                groups += [group[half:], group[:half]]
            else:
                blamed += group
        return blamed + [one for group in groups for one in group]

    def _is_solvable(self) -> bool:
        try:
            self._solver.optimize()
            self._refuse_absurd()
        except Exception as error:
            self._note_undetermined(error)
            self.go_back()
            return False
        return True

    def _exclude(self, suspects: Sequence[_Suspect]) -> None:
        for one in suspects:
            for edge in one.edges:
                self._solver.set_weight(edge, 0.0)
        for one in suspects:
            if one.landmark is not None:
                self._solver.remove(one.landmark)

    def _include(self, suspects: Sequence[_Suspect]) -> None:
        for one in suspects:
            if one.landmark is not None:
                self._solver.add([one.landmark], [])
            for edge in one.edges:
                self._solver.set_weight(edge, 1.0)
