"""When edges are linearised anew: after which loss they are weighted, when large steps are searched for, and how large.

An edge that has just arrived is held to the first stage of its loss, one update later to the last.
"""

import math

import numpy as np

from graph_slam_ros.graph import INVERSE_RELATIVE_POSE, RELATIVE_POSE, RELATIVE_POSE_3D, Graph
from graph_slam_ros.solver.clique_tree.storage import NONE, STEP, Limits, Tree
from graph_slam_ros.solver.linearization import CHUNK, Losses, chi2_of, squares
from graph_slam_ros.solver.settings import Settings
from graph_slam_ros.typing import Array, Index


class LossStages:
    """The present stage of each edge's loss.

    Attributes
    ----------
    young : edges that have had only one update
    """

    def __init__(self, graph: Graph) -> None:
        self.young = NONE
        self._graph = graph
        self._losses: list[Losses] = []
        self._pointers = NONE
        self._made_for: tuple[int, int, Settings | None] = 0, 0, None  # so many labels and sources, and their settings

    def losses(self, settings: Settings) -> list[Losses]:
        """The losses of each stage."""
        labels, sources, made_for = self._made_for
        graph = self._graph
        if len(graph.labels) != labels or len(graph.sources) != sources or made_for is not settings:
            self._made_for = len(graph.labels), len(graph.sources), settings
            self._losses = [Losses(self._graph, given) for given in settings.stages()]
            self._pointers = np.concatenate((self._losses[0].pointers, self._losses[-1].pointers))
        return self._losses

    def pointers(self, settings: Settings) -> Index:
        """Pointers of the losses of the first stage, then of the last."""
        self.losses(settings)
        return self._pointers

    def of_new(self, edges: Index, settings: Settings) -> Index:
        """Return those of new edges that are held to the first stage: all of them, or none where there is but one."""
        return edges if len(self.losses(settings)) > 1 else NONE

    def mature(self, values: Array, settings: Settings) -> None:
        """Keep as young only edges whose weight differs between the first and the last stage of their loss."""
        if not len(self.young):
            return
        first, *_, last = self.losses(settings)
        chi2, _ = chi2_of(self._graph, values, self.young)
        young: list[int] = self._graph.edge_ids.of_all(self.young).tolist()
        differ = [first.weight(edge, c) != last.weight(edge, c) for edge, c in zip(young, chi2, strict=True)]
        self.young = self.young[differ]


_LARGEST = 1.0  # part of a residual [m, rad] that counts: where it is larger, an edge is new or its angle was wrapped


def neglected(graph: Graph, tree: Tree, edges: Index) -> tuple[float, float]:
    """Return the sum of squares of what is neglected of some edges at the estimates of a tree, and their chi2.

    Of an edge it is ``r(x [+] d) - r(x) - J d``, whitened, for the linearisation point x and the step d. The optimum
    is below chi2 by about this sum: by 0.2 to 5 times as much on public graphs. Losses do not count.
    """
    rest_squared = chi2 = 0.0
    for table, of_table in graph.rows_by_table(edges).items():
        for begin in range(0, len(of_table), CHUNK):
            rows = of_table[begin : begin + CHUNK]
            ends, measured = table.vertex_rows.values[rows], table.measured.values[rows]
            at, root = graph.offset.values[ends], table.sqrt_information.values
            here, _ = table.type.linearize(tree.estimate, at, measured)
            there, jacobian = table.type.linearize(tree.value, at, measured)
            rest = here - there - np.einsum("nij,nj->ni", jacobian, _steps(tree, ends, table.type.dofs))
            rest[np.abs(rest).max(axis=1) > _LARGEST] = 0.0
            weight = table.weight.values[rows]
            rest_squared += float(weight @ squares(root, rows, np.ascontiguousarray(rest)))
            chi2 += float(weight @ squares(root, rows, np.ascontiguousarray(here)))
    return rest_squared, chi2


def _steps(tree: Tree, ends: Index, dofs: tuple[int, ...]) -> Array:
    """Return the steps (n, width) of the vertices of some edges, side by side."""
    first = tree.vertex[ends, STEP]
    return np.concatenate([tree.step[first[:, k, None] + np.arange(dof)] for k, dof in enumerate(dofs)], axis=1)


NOT_YET, MAYBE, SURELY = range(3)
_BY_FAR = 10.0  # times the threshold: steps that are linearised anew at once
NO_LIMITS: Limits = (math.inf, math.inf, math.inf)
_MOTIONS = {RELATIVE_POSE: 2, INVERSE_RELATIVE_POSE: 2, RELATIVE_POSE_3D: 3}  # components of their positions
_SIGHTINGS = "landmarks"  # label of edges to landmarks, which may be poses, too
_TOO_MUCH, _ENOUGH = 1e-3, 2e-4  # of chi2, that linearisation neglects
_TIGHTEST = 0.2  # factor of the thresholds
_LEAST_OF_EDGE = 1e-7  # of chi2 that is neglected, for each edge: less is no reason to linearise
_FIRST_CHECK = 128  # edges
_CLASSES, _PER_OCTAVE, _FARTHEST_M = 41, 2, 1e9  # of lengths, from a metre on


class RelinearizationSchedule:
    """Counts updates, and keeps the vertices that an update solved last, to be searched by the next one."""

    def __init__(self) -> None:
        self._unseen = NONE
        self._updates = 0
        self._motions = MotionLength()
        self._limits: tuple[float, float, Limits] = 0.0, 0.0, NO_LIMITS
        self._limits_of: Settings | None = None
        self._checked_at = _FIRST_CHECK  # edges
        self._neglected = 0.0  # of chi2, at the last check
        self.tightness = 1.0

    def note(self, solved: Index) -> None:
        """Note vertices that were solved after an update's last search; the next update searches them."""
        self._unseen = solved

    def hasten(self, every: int) -> None:
        """Let the next update search all vertices."""
        self._updates = every

    def is_due(self, every: int) -> int:
        """Return whether all vertices that moved are to be searched: SURELY, NOT_YET, or MAYBE, at a closure."""
        self._updates += 1
        if self._updates >= every:
            return SURELY
        return MAYBE if 3 * self._updates >= 2 * every else NOT_YET

    def begin(self, graph: Graph) -> int:
        """Count from the present search. Returns the typical length of a motion [mm]."""
        self._updates, self._limits_of = 0, None
        return self._motions.typical_mm(graph)

    def limits(self, graph: Graph, settings: Settings) -> tuple[float, float, Limits]:
        """Return the tolerances of steps, and the limits above which a step is linearised anew at once.

        The limits are those of the graph at the last search.
        """
        if settings is not self._limits_of:
            far = NO_LIMITS
            if settings.relinearize_passes:
                component, turn, square = far_limits(graph, settings)
                far = self.tightness * component, self.tightness * turn, self.tightness**2 * square
            self._limits_of, self._limits = settings, (settings.tolerance, settings.tolerance_sigmas, far)
        return self._limits

    def is_check_due(self, edges: int, settings: Settings) -> bool:
        """Return whether the number of edges has doubled since what linearisation neglects was last checked."""
        is_due = edges >= 2 * self._checked_at and math.isfinite(settings.relinearize_neglected)
        if is_due:
            self._checked_at = edges
        return is_due

    def learn(self, neglected: float, chi2: float, edges: int) -> None:
        """Tighten or loosen the thresholds by what linearisation neglects; it falls with their fourth power.

        Where measurements fit much better than their noise says, the thresholds, which are in units of that, are too
        loose. What is neglected just after a closure passes, so they are tightened only at the second check in a row.
        """
        share = neglected / chi2 if neglected > _LEAST_OF_EDGE * edges else 0.0
        lasting, self._neglected = min(share, self._neglected), share
        if lasting > _TOO_MUCH:
            self.tightness = max(_TIGHTEST, self.tightness * (_ENOUGH / lasting) ** 0.25)
        elif self.tightness < 1.0 and share < _ENOUGH:
            self.tightness = min(1.0, 2.0 * self.tightness)

    def unseen(self) -> Index:
        """Return the vertices that the last update solved after its last search; once."""
        unseen, self._unseen = self._unseen, NONE
        return unseen


def far_limits(graph: Graph, settings: Settings) -> Limits:
    """Return the limits above which a step, or the square of one, is linearised anew at once (``is_large_step``).

    To stay linearised a turn away from the estimate costs about the square of that turn in chi2, for each degree of
    freedom of the pose. In a small graph a single turn may be a visible part of chi2, whose expected value is the
    number of measured components less the number of estimated ones.
    """
    measured = sum(table.type.residual_size * len(table) for table in graph.tables.values())
    costly = math.sqrt(settings.relinearize_neglected * max(1, measured - graph.initial.count))
    above = settings.relinearize_above
    far = _BY_FAR * above
    return far, min(far, max(above, costly)), _BY_FAR**2 * settings.relinearize_error


class MotionLength:
    """The typical length of the measured motions between two poses: their median, to a factor of the root of two.

    A false closure may be of any length, so it is no mean.
    """

    def __init__(self) -> None:
        self._rows = dict.fromkeys(_MOTIONS, 0)
        self._times = np.zeros(_CLASSES, dtype=np.int64)
        self._median = 0  # class of lengths

    def typical_mm(self, graph: Graph) -> int:
        """Return the length in mm, a metre at least."""
        for edge_type, components in _MOTIONS.items():
            table, known = graph.tables.get(edge_type), self._rows[edge_type]
            count = len(table) if table else 0
            if count < known:  # edges were removed
                self._times[:], self._rows, self._median = 0, dict.fromkeys(_MOTIONS, 0), 0
                return self.typical_mm(graph)
            if table and count > known:
                of_label = graph.labels.index(_SIGHTINGS) if _SIGHTINGS in graph.labels else -1
                moved = table.measured.values[known:count][table.label.values[known:count] != of_label, :components]
                square = (np.clip(moved, -_FARTHEST_M, _FARTHEST_M) ** 2).sum(axis=1)
                of_each = (0.5 * _PER_OCTAVE * np.log2(np.maximum(square, 1.0))).astype(np.int64)
                self._times += np.bincount(np.minimum(of_each, _CLASSES - 1), minlength=_CLASSES)
                self._median = int(np.argmax(2 * np.cumsum(self._times) >= self._times.sum()))
                self._rows[edge_type] = count
        return round(1000.0 * 2.0 ** (self._median / _PER_OCTAVE))
