"""The integration of pending changes into the solution of a problem, at the cost of what they change."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.solver.batch import Settings
from graph_slam_ros.solver.clique_tree import incremental
from graph_slam_ros.solver.clique_tree.advance import DISSECT, DONE, more_room, restructure
from graph_slam_ros.solver.clique_tree.ordering import dissect
from graph_slam_ros.solver.clique_tree.storage import MOTION_MM, NOTHING, Limits
from graph_slam_ros.solver.compiled_update import CHECK, END, GROUP, IN_PYTHON, LINEARIZE, ORDER, SEARCH, UNSURE, update
from graph_slam_ros.solver.entry import enter_newest
from graph_slam_ros.solver.gauge import undetermined
from graph_slam_ros.solver.linearization import linearize_into
from graph_slam_ros.solver.loss_stages import LossStages
from graph_slam_ros.solver.neglected import neglected
from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.solver.problem import Problem
from graph_slam_ros.solver.relinearization import MAYBE, NO_LIMITS, SURELY, RelinearizationSchedule
from graph_slam_ros.typing import Index


class OnlineProblem(Problem):
    """A problem that integrates its pending changes, and linearises anew what is far from where it was linearised."""

    def __init__(self, graph: Graph, settings: Settings | None = None) -> None:
        super().__init__(graph, settings)
        self._stages = LossStages(graph)
        self._numbers_current = True  # the tree's numbers are those at its linearisation points
        self._schedule = RelinearizationSchedule()
        self._solved_with: Settings | None = None  # a batch that converged, and nothing was changed since

    def _after_error(self) -> None:
        """Forget what an update that failed knew of stages and numbers."""
        self._stages.young, self._numbers_current = NONE, True

    def _integrate(self) -> tuple[int, int, Index, Index]:
        """Solve with all that is pending, within a transaction.

        Returns how many edges were linearised, and how many vertices were solved; then, if edges on these are far from
        their linearisation point (now moved there), the vertices and the edges.
        """
        pending, stages, settings = self._pending, self._stages, self.settings
        due, losses = self._schedule.is_due(settings.relinearize_every), stages.pointers(settings)
        stage, vertices, edges, again = CHECK, pending.vertices, pending.new, NONE
        young = stages.of_new(edges, settings)
        if not (self._numbers_current and pending.is_plain()) or len(stages.young):
            stage, vertices, edges, again, young = self._entered(due)
            if stage == END:
                return 0, 0, NONE, NONE
        touched, unseen = pending.touched, self._schedule.unseen()
        while True:
            linear = np.union1d(edges, again) if len(again) else edges
            how, what, count, found = update(
                self.graph.pointers, self._pointers, stage, due,
                vertices, edges, linear, again, touched, unseen, young, losses, *self._limits(),
            )  # fmt: skip
            if how == UNSURE:
                stage, vertices, edges, again, young = self._entered(due)
                continue
            stages.young = young
            if how == DONE:
                break
            stage = GROUP
            if how == SEARCH:
                stage, again = LINEARIZE, self._far_from_linearization()
            elif how == IN_PYTHON:
                stage = ORDER
                self._linearize(linear)
            elif how == DISSECT:
                touched = np.concatenate((found, dissect(self._tree, what)))
            else:
                touched = found
                self._make_pools_longer()
        if what != NOTHING:
            self._refuse_floating()
            raise undetermined(what)
        stages.mature(self._tree.value, settings)
        self._solved_with, self._numbers_current = None, True
        if not len(found):
            return len(linear), count, NONE, NONE
        return len(linear), count, found[:count], found[count:]

    def _entered(self, due: int) -> tuple[int, Index, Index, Index, Index]:
        """Let all that is pending enter, of whatever kind it is.

        Returns the stage of the compiled update that comes next (END if there is nothing to do), and what it is called
        with: vertices and edges that entered, edges that are to be linearised again, and young ones.
        """
        pending, stages = self._pending, self._stages
        vertices, edges = self._arriving()
        enter_newest(self._pointers, vertices, edges)
        if not (self._numbers_current or pending.broken or pending.moved):
            self._renumber_after_batch()
        if due == MAYBE and len(edges) and not pending.broken and incremental.reach_back(self._tree, edges):
            due = SURELY
        again = self._far_from_linearization() if due == SURELY else NONE
        if not pending and not len(stages.young) and not len(again):
            return END, NONE, NONE, NONE, NONE
        fresh = np.union1d(edges, stages.young) if len(stages.young) else edges
        stages.young = young = stages.of_new(edges, self.settings)
        if pending.broken:
            self._forget_numbers()
            fresh, vertices = self._active(), self._unknowns()
            self._linearize(fresh)
            self._estimates()
            incremental.reset(self._tree, vertices)
            return ORDER, vertices, fresh, NONE, young
        if pending.moved:
            self._forget_numbers()
            again = np.setdiff1d(self._active(), fresh)
        return LINEARIZE, vertices, fresh, again, young

    def _far_from_linearization(self) -> Index:
        """Search all vertices for large steps, and move their linearisation points; return the edges on them."""
        settings = self.settings
        self._tree.state[MOTION_MM] = self._schedule.begin(self.graph)
        if self._pending.broken:
            return NONE
        if self._schedule.is_check_due(self.graph.edge_count, settings):
            edges = self._active()
            self._estimates()
            self._schedule.learn(*neglected(self.graph, self._tree, edges), len(edges))
        tightness = self._schedule.tightness
        above, error = tightness * settings.relinearize_above, tightness**2 * settings.relinearize_error
        return incremental.relinearize_changed(self._pointers, *self._limits()[:2], (above, above, error))

    def _make_pools_longer(self) -> None:
        """Make room for what an update could not place."""
        try:
            self._tree = more_room(self._tree)
        finally:  # some arrays may have grown in place
            self._locate()

    def _limits(self) -> tuple[float, float, Limits]:
        """The tolerances of steps, and the limits above which a step is far (``substitute``)."""
        return self._schedule.limits(self.graph, self.settings)

    def _relinearized(self, far: Index) -> Iterator[tuple[int, Index]]:
        """Linearise edges that are far, pass after pass; yields how many were, and the vertices that were solved."""
        limits, passes = self._limits(), self.settings.relinearize_passes
        for k in range(passes):
            self._linearize(far)
            failed, solved = incremental.renumber(self._tree, far, *limits)
            if failed != NOTHING:
                raise undetermined(failed)
            yield len(far), solved
            if k == passes - 1:
                self._schedule.note(solved)
                return
            far = incremental.relinearize(self._tree, solved, *limits[2:])
            if not len(far):
                return

    def _forget_numbers(self) -> None:
        """Set the sums to zero, because all edges are about to be linearised."""
        self._tree.blocks[:] = 0.0
        self._tree.diagonal[:] = 0.0

    def _restructure(self, vertices: Index, edges: Index) -> None:
        """Order and group what new vertices and edges touch, without numbers."""
        if self._pending.broken:
            vertices = self._unknowns()
            incremental.reset(self._tree, vertices)
        try:
            self._tree = restructure(self._tree, edges, self._pending.touched, vertices, *self._limits()[:2])
        finally:
            self._locate()

    def _renumber_after_batch(self) -> None:
        """Compute the numbers of the tree at the result of a batch. The result stays."""
        self._linearize(self._active())
        failed, _ = incremental.renumber(self._tree, self._active(), np.inf, 0.0, NO_LIMITS)
        if failed != NOTHING:
            self._pending.broken = True
        self._numbers_current = True

    def _linearize(self, edges: Index) -> None:
        """Put the blocks of edges at the linearisation points into the tree."""
        first, *_, last = 2 * self._stages.losses(self.settings)
        linearize_into(self._pointers, self.graph, self._tree, edges, last, self._stages.young, first)
