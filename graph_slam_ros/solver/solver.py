"""The solution: the estimate of a problem, online and in batch, and its covariances."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.graph import whole_numbers
from graph_slam_ros.solver.batch import BatchProblem, Settings, minimise
from graph_slam_ros.solver.clique_tree import incremental
from graph_slam_ros.solver.clique_tree.storage import AFFECTED, CLIQUE, DOF, NOTHING, SUBSTITUTED
from graph_slam_ros.solver.clique_tree.substitution import forget, read, show
from graph_slam_ros.solver.covariance import among, joint, joint_of_each, marginals
from graph_slam_ros.solver.cross_covariance import CrossCovariances
from graph_slam_ros.solver.entry import enter_newest
from graph_slam_ros.solver.gauge import undetermined
from graph_slam_ros.solver.left_out import without_edges
from graph_slam_ros.solver.linearization import Losses, costs, information, linearize, rows_of
from graph_slam_ros.solver.online_problem import OnlineProblem
from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.solver.problem import existing
from graph_slam_ros.solver.report import Change, Report
from graph_slam_ros.solver.transaction import Transaction
from graph_slam_ros.typing import Array, Index


class Solver(OnlineProblem):
    """Maximum-likelihood estimate of the vertices it was given, online and in batch; it owns their estimates.

    Vertices and edges are records of a ``Graph``; the solver minimises over those that were added to it. ``update``
    costs what has changed, ``optimize`` what there is; both work on one clique tree. What fails, for whatever reason,
    leaves the estimate as it was. The weight of an edge is the graph's, so a graph has but one solver that changes it.
    """

    def __init__(self, graph: Graph, settings: Settings | None = None) -> None:
        super().__init__(graph, settings)
        self._unfinished = False  # a batch stopped before the optimum

    def release(self, vertices: ArrayLike) -> None:
        """Estimate held vertices again. The whole structure is rebuilt."""
        self._grow()
        self._held[existing(vertices, self._vertices, "vertex")] = False
        self.rebuild()

    @property
    def is_current(self) -> bool:
        """Return whether nothing is pending: covariances then include all edges, and reading them changes nothing."""
        return self._numbers_current and not self._pending

    def update(self) -> Change:
        """Integrate what was added and changed, and bring the estimate to the optimum of all of it.

        It costs what the change costs. Vertices whose step has become large are linearised anew (``Settings``).

        Raises
        ------
        GaugeError, SingularError
            The estimate stays; what was added since the last update is not in it, and stays pending. So it is with
            any other exception, e.g. of a residual of one's own.
        """
        self._grow()
        state = self._tree.state
        eliminated = int(state[AFFECTED])
        found: list[Index] = []
        with Transaction(self):
            linearized, moved, solved, far = self._integrate()
            if self._unfinished:
                solved, far = self._continue_batch()
                moved = len(solved)
            if len(far):
                found.append(solved)
                for again, these in self._relinearized(far):
                    linearized, moved = linearized + again, moved + len(these)
                    found.append(these)
        if self.settings.at_once:
            self._estimates()
        else:
            for these in found:
                show(self._tree, self._kept, these)
        return Change(int(state[AFFECTED]) - eliminated, linearized, moved)

    def optimize(self, settings: Settings | None = None) -> Report:
        """Minimise the cost over everything, from the present estimate, until converged.

        Raises
        ------
        GaugeError, SingularError
            As for ``update``.
        """
        settings = settings or self.settings
        self._grow()
        if self.graph.vertex_count and not len(self.vertices):
            raise GraphSlamError("nothing to solve: give the solver vertices and edges (add), or call optimize(graph)")
        if self._solved_with == settings and not self._pending:
            return self.evaluate(settings)
        arriving = self._arriving(surely=bool(self._pending))
        self._estimates()
        with Transaction(self):
            enter_newest(self._pointers, *arriving)
            self._tree.state[SUBSTITUTED] += 1  # from here on, steps are those of the batch
            self._forget_numbers()
            self._restructure(*arriving)
            unknowns = self._unknowns()
            if len(unknowns):
                report = minimise(BatchProblem(self.graph, self._tree, self._active_rows(), unknowns), settings)
            else:
                report = self.evaluate(settings)
        forget(self._tree)
        self._kept[:] = self._tree.estimate
        self._numbers_current, self._stages.young = not len(unknowns), NONE
        self._solved_with = settings if report.converged else None
        self._unfinished = not report.converged
        return report

    def evaluate(self, settings: Settings | None = None, at: Array | None = None) -> Report:
        """Chi2 and cost of the present estimate, or at other ``values``, with the last stage of the losses.

        Pending edges do not count yet.
        """
        self._grow()
        losses = Losses(self.graph, (settings or self.settings).stages()[-1])
        where = self._estimates() if at is None else at
        now = costs(self.graph, linearize(self.graph, where, self._active_rows(), losses))
        return Report("gn", "nothing_to_do", now.chi2, now.chi2, now.cost, now.cost, (), now.classes)

    def estimate(self, ids: ArrayLike) -> Array:
        """Values of vertices of one kind, (n, size)."""
        self._grow()
        at = whole_numbers(ids, "vertex").ravel()
        if not len(at):
            return np.empty((0, 0))
        settings = self.settings
        tolerances = settings.tolerance, settings.tolerance_sigmas
        unfit, out = read(self.graph.pointers, self._pointers, self._vertices, at, *tolerances)
        if unfit != NOTHING:
            existing(at, self._vertices, "vertex")
            raise GraphSlamError("estimate: the vertices are not of one kind")
        return out

    def marginal(self, ids: ArrayLike) -> list[Array]:
        """Covariance (dof, dof) of each vertex in its tangent space; zero for a held one.

        Pending changes are integrated first.

        Raises
        ------
        GaugeError, SingularError
            A covariance that does not exist is refused.
        """
        wanted = self._with_covariance(ids)
        free = wanted[~self._held[wanted]]
        with self._tree_remade_after_error():
            numbers = joint(self._tree, free).ravel() if len(free) == 1 else marginals(self._tree, free)
        out, at = [], 0
        for vertex in wanted.tolist():
            dof = self.graph.kind_of(vertex).dof
            if self._held[vertex]:
                out.append(np.zeros((dof, dof)))
            else:
                out.append(numbers[at : at + dof**2].reshape(dof, dof))
                at += dof**2
        return out

    def joint_marginal(self, ids: ArrayLike) -> Array:
        """Covariance (D, D) of some vertices together, in the order given, each once; as ``marginal`` for each."""
        wanted = self._with_covariance(ids)
        if len(set(wanted.tolist())) < len(wanted):
            raise GraphSlamError("a joint covariance of a vertex with itself")
        held = self._held[wanted]
        with self._tree_remade_after_error():
            of_free = np.zeros((0, 0)) if held.all() else joint(self._tree, wanted[~held])
        if not held.any():
            return of_free
        free = np.repeat(~held, self._tree.vertex[wanted, DOF])
        out = np.zeros((len(free), len(free)))
        out[np.ix_(free, free)] = of_free
        return out

    def joint_marginal_without(self, ids: ArrayLike, edges: ArrayLike) -> tuple[Array, Array]:
        """Stored values of vertices and their ``joint_marginal``, as they would be without some edges.

        All others stay linearised where they are. Nothing is changed.

        Raises
        ------
        GaugeError, SingularError
            Also where the other edges do not determine these vertices, or so weakly that rounding would decide.
        """
        wanted = self._with_covariance(ids)
        left_out = existing(edges, self.graph.edge_count, "edge")
        self._estimates()
        return without_edges(self.graph, self._tree, self.joint_marginal, wanted, left_out)

    def edge_marginals(self, ends: Index, *, are_inside: bool = True) -> Array:
        """Covariances (n, D, D) as ``joint_marginal`` has them, of the vertices (n, k) of edges of one type.

        It takes longer if the edges are not in the problem.
        """
        self._with_covariance(ends)
        with self._tree_remade_after_error():
            of_each = among if are_inside else joint_of_each
            return of_each(self._tree, np.ascontiguousarray(ends)) if len(ends) else np.zeros((0, 0, 0))

    def cross_covariances(self) -> CrossCovariances:
        """Covariances of all vertices with one of them, as ``joint_marginal`` has them."""
        self._with_covariance(self.vertices)
        return CrossCovariances(self._tree, np.flatnonzero(self._inside & ~self._held))

    def information_matrix(self) -> Array:
        """H as a dense matrix, vertices in order of id, with pending edges: for tests and small examples.

        It is linearised at the present estimate with the last stage of the losses; ``marginal`` is of the tree, whose
        linearisation points may be a small step (``Settings.relinearize_above``) away.
        """
        self._grow()
        free = np.flatnonzero(self._inside & ~self._held)
        losses = self._stages.losses(self.settings)[-1]
        return information(self.graph, self._estimates(), rows_of(self.graph, self.edges), free, losses)

    def rebuild(self) -> None:
        """Rebuild everything from the graph, at the present estimate; a failure leaves all as it was.

        It is for an unforeseen fault: it removes whatever that left in the tree.
        """
        values, vertices, edges = self.values, self.vertices, np.flatnonzero(self._edge_inside)
        fresh = Solver(self.graph, self.settings)
        fresh.start_at(values)
        fresh.add(vertices, edges)
        for vertex in self.held.tolist():
            fresh.hold(vertex)
        vars(self).update(vars(fresh))

    # -- inside ------------------------------------------------------------------------------------------------------

    def _with_covariance(self, ids: ArrayLike) -> Index:
        """Check vertices whose covariance is asked for, and integrate pending changes."""
        self._grow()
        wanted = existing(ids, self._vertices, "vertex")
        if not self._inside[wanted].all():
            raise GraphSlamError(f"vertex {int(wanted[~self._inside[wanted]][0])} is not in the problem")
        if not self._held[wanted].all():
            if self._pending:
                self.update()
            elif not self._numbers_current:
                with Transaction(self):
                    enter_newest(self._pointers, NONE, NONE)
                    self._renumber_after_batch()
            if (self._tree.vertex[wanted[~self._held[wanted]], CLIQUE] == NOTHING).any():
                raise GraphSlamError("a covariance was asked for within an update")
        return wanted

    @contextmanager
    def _tree_remade_after_error(self) -> Iterator[None]:
        """Mark the tree to be rebuilt at the next update if an error occurs, which leaves scratch in it."""
        try:
            yield
        except BaseException:
            self._pending.broken = True
            raise

    def _continue_batch(self) -> tuple[Index, Index]:
        """Step on from where a batch stopped before the optimum; returns what was solved, and edges that are far."""
        self._unfinished = False
        failed, solved = incremental.renumber(self._tree, self._active(), *self._limits())
        if failed != NOTHING:
            raise undetermined(failed)
        self._schedule.hasten(self.settings.relinearize_every)
        return solved, incremental.relinearize(self._tree, solved, *self._limits()[2:])
