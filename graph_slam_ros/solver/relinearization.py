"""The schedule of relinearisation: when large steps are searched for, and which do not wait for that."""

import math

import numpy as np

from graph_slam_ros.graph import INVERSE_RELATIVE_POSE, RELATIVE_POSE, RELATIVE_POSE_3D, Graph, records
from graph_slam_ros.lie.addresses import integers, reals
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.batch import Settings
from graph_slam_ros.solver.clique_tree.storage import Limits
from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.typing import Index

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
                self._median = _median_class(table.pointers, known, count, components, of_label, self._times)
                self._rows[edge_type] = count
        return round(1000.0 * 2.0 ** (self._median / _PER_OCTAVE))


@kernel
def _median_class(table: Index, first: int, end: int, components: int, left_out: int, times: Index) -> int:
    """Count some rows of a table by their lengths, but for those of one label; return the class of the median."""
    size = table[records.MEASURED_SIZE]
    measured, label = reals(table[records.MEASURED], end * size), integers(table[records.LABEL], end)
    for row in range(first, end):
        square = 0.0
        for k in range(row * size, row * size + components):
            square += min(max(measured[k], -_FARTHEST_M), _FARTHEST_M) ** 2
        if label[row] != left_out:
            times[min(int(np.floor(0.5 * _PER_OCTAVE * np.log2(max(square, 1.0)))), len(times) - 1)] += 1
    total, counted = 0, 0
    for count in times:
        total += count
    for k in range(len(times)):
        counted += times[k]
        if 2 * counted >= total:
            return k
    return 0
