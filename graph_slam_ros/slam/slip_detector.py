"""Detection of slip: stretches of odometry whose errors are larger than its noise.

A view is everything that was measured from one keyframe. If the last 1 to 16 views contradict odometry more than is
usual in this drive, some of their keyframes are tested as the start of a slip, of translation or of rotation, beside
the hypothesis that the robot was moved. The best must be a slip, exceed the odds against it, and be likelier than none
also without any one landmark. Then edges with more noise replace the odometry edges of the stretch, and new odometry
gets more noise, too. The slip ends when odometry with its own noise is likelier again for some views. If that is true
of the whole stretch, the slip is taken back, and everything is as before.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from statistics import median

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.pipeline import OdometryConfig
from graph_slam_ros.errors import GraphSlamError, SingularError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.evidence import CARRIED, LOG_ODDS, SLIPS, Choice, Hypothesis, Moved, Stretch, carried
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.odometry_jumps import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.measured_noise import MeasuredNoise
from graph_slam_ros.slam.odometry_edges import replace_odometry, restore_odometry
from graph_slam_ros.slam.robust.landmark_history import LandmarkHistory
from graph_slam_ros.slam.robust.odometry_errors import OdometryErrors, odometry_errors
from graph_slam_ros.slam.slip_noise import SlipNoise
from graph_slam_ros.slam.slip_review import Link, Pair, Slip, View, covariance_of, revoke_slip, slipped_pairs
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index

_VIEWS = 16
_SUMS = (1, 2, 4, 8, 16)  # views whose innovations are summed
_SURE = 1.0 - 1e-6  # probability with which clean measurements cause no comparison
_CAP = 0.9999  # no innovation counts for more than this quantile: one alone does not decide
_USUAL, _FEWEST = 200, 30  # newest sightings whose median says how large residuals are, and how many that needs
_SINCE = (1, 2, 4, 6, 8, 12, 16)  # views before which a slip may have begun
_EARLIER = (1, 2, 3, 4, 6, 8)  # edges by which a slip may have begun before it was found
_SURELY = 1.0  # logarithm of the likelihood ratio that this needs
_AGAIN = (8, 12, 16)  # views for which odometry must be as likely by its own noise, for a slip to end
_MOST_EDGES = 60
_PART = 0.05  # of the views cause a comparison at most, but for so many that follow one another:
_BURST = 20.0
_FACTOR = 1.5  # all noise may be larger than stated by this factor

Doubt = Callable[[int, Callable[[float], Array] | None], None]


class SlipDetector:
    """Detects slips, and keeps the edges of odometry in step with them.

    Parameters
    ----------
    history : from when on each landmark is well known
    doubt : takes a stamp since when odometry has more noise, and the variances that so many seconds add; None: its own

    Attributes
    ----------
    slips : in order; the last may go on
    noise : as measured
    """

    def __init__(
        self,
        space: Geometry,
        odometry: OdometryConfig,
        backend: Backend,
        counters: Counters,
        history: LandmarkHistory,
        doubt: Doubt,
    ) -> None:
        self._space, self._config, self._backend, self._counters = space, odometry, backend, counters
        self._history, self._doubt = history, doubt
        self._links: deque[Link] = deque(maxlen=_MOST_EDGES)
        self._views: deque[View] = deque(maxlen=_VIEWS + 1)
        self._new: list[int] = []  # edges that came since the last check, whose innovation is not known yet
        self._ratios: deque[float] = deque(maxlen=_USUAL)  # of the newest squared residuals to the stated median
        self._replacing: set[int] = set()  # edges that replace others
        self._checked, self._allowed = -1, _BURST
        self.noise, self._added = MeasuredNoise(space, backend), SlipNoise(space)
        self.slips: list[Slip] = []

    @property
    def now(self) -> Slip | None:
        """The slip that goes on."""
        return self.slips[-1] if self.slips and self.slips[-1].ended_ns is None else None

    def active(self, edge: int) -> int:
        """The edge of odometry that is in the problem between the vertices of one that was added, or replaces it."""
        vertices = tuple(self._backend.graph.edge(edge).vertices)
        return next((link.edge for link in self._links if link.vertices == vertices), edge)

    def begin(self, stamp_ns: int, vertex: int | None = None) -> None:
        """Begin a segment, by default at the next keyframe: earlier odometry is not examined any more."""
        last_ns = self._links[-1].stamps_ns[1] if self._links else stamp_ns  # of the segment that ends
        self._links = deque(
            (one for one in self._links if vertex is not None and one.vertices[0] >= vertex), _MOST_EDGES
        )
        self._views = deque((one for one in self._views if vertex is not None and one.vertex >= vertex), _VIEWS + 1)
        self._new = [edge for edge in self._new if any(edge in view.edges for view in self._views)]
        if (now := self.now) is not None:
            self.slips[-1] = replace(now, ended_ns=stamp_ns if stamp_ns >= now.began_ns else last_ns)
            self._doubt(stamp_ns, None)

    def renumber(self, vertices: Index, edges: Index) -> None:
        """Take over new ids of all vertices and edges, by old ones; -1: it was removed."""
        links = [one.renumbered(vertices, edges) for one in self._links]
        self._links = deque((one for one in links if min(one.edge, one.own, *one.vertices) >= 0), _MOST_EDGES)
        views = [one.renumbered(vertices, edges) for one in self._views]
        self._views = deque((one for one in views if one.vertex >= 0 and one.edges), _VIEWS + 1)
        self._new = [int(edges[edge]) for edge in self._new if edges[edge] >= 0]
        self._replacing = {int(edges[edge]) for edge in self._replacing if edges[edge] >= 0}
        self._checked = int(vertices[self._checked]) if self._checked >= 0 else -1

    def add_odometry(self, edge: int, vertices: Sequence[int], stamps_ns: tuple[int, int], keyframe: int) -> None:
        """Add the odometry edge from one keyframe to the next. During a slip it gets more noise."""
        link = Link(edge, edge, (vertices[0], vertices[1]), stamps_ns)
        if edge in self._replacing or (self._links and self._links[-1].vertices == link.vertices):
            self._replacing.discard(edge)  # it replaces another, or another odometry measured the same motion
            return
        if self._links and self._links[-1].vertices[1] != link.vertices[0]:
            self.begin(stamps_ns[0])
        self._links.append(link)
        if (now := self.now) is not None:
            self._replace([link], now, keyframe)

    def add_seen(self, edge: int, vertex: int, what: int | str) -> None:
        """Add an edge that was measured from a keyframe: of a landmark, by its vertex, or of another class."""
        if not self._views or self._views[-1].vertex < vertex:
            self._views.append(View(vertex, [], []))
        view = next((one for one in reversed(self._views) if one.vertex == vertex), None)
        if view is not None:
            view.edges.append(edge)
            view.seen.append(what)
            self._new.append(edge)

    def check(
        self, keyframes: StampedPoses[Keyframe], stamp_ns: int, moved: Moved | None = None, *, is_decided: bool = False
    ) -> bool:
        """Examine the evidence after a solve. Returns whether a slip explains it better than that the robot was moved.

        Such a slip begins if it is sure.

        Parameters
        ----------
        stamp_ns : of the newest odometry
        moved : where the robot may have been moved to
        is_decided : whether it is decided now, if a slip does not explain it better
        """
        self._store_innovations()
        newest = self._views[-1].vertex if self._views else -1
        if not self._config.doubt or len(self._views) < 2 or not self._stretch():
            return False
        keyframe = len(keyframes) - 1
        is_new, self._checked = newest != self._checked, newest
        self._allowed = min(_BURST, self._allowed + _PART * is_new)
        try:
            if self.now is None and (is_decided or (is_new and self._allowed >= 1.0 and self._is_alarmed())):
                self._allowed = max(0.0, self._allowed - 1.0)
                choice = self._compare(moved, keyframes)
                if choice.is_slip:
                    self._begin_slip(choice, keyframe, stamp_ns)
                return choice.kind in SLIPS
            if self.now is None or not is_new:
                return False
            explains = is_decided and self._compare(moved, keyframes).kind != CARRIED
            self._update_slip(self.now, keyframe, stamp_ns)
            return explains
        except (GraphSlamError, np.linalg.LinAlgError):  # nothing can be compared: odometry counts as before
            return False

    # -- alarm -----------------------------------------------------------------------------------------------------

    def _store_innovations(self) -> None:
        """Store the innovations of the new edges."""
        new, ledger, usual = set(self._new), self._backend.ledger, self._usual()
        for view in reversed(self._views):
            for edge, what in zip(view.edges, view.seen, strict=True):
                if edge in new and edge < len(ledger) and self._is_known(what, view.vertex):
                    numbers, statistic = int(ledger.numbers.values[edge]), float(ledger.statistic.values[edge])
                    self._ratios.append(statistic / quantile(0.5, numbers))
                    view.statistic += min(statistic / usual, quantile(_CAP, numbers))
                    view.numbers += numbers
        self._new.clear()

    def _usual(self) -> float:
        """Return how large squared residuals at predicted poses are, in units of the stated noise's; at least 1."""
        return max(1.0, median(self._ratios)) if len(self._ratios) >= _FEWEST else 1.0

    def _is_known(self, what: int | str, vertex: int) -> bool:
        return isinstance(what, str) or self._history.known_from(what, self._views[0].edges[0]) < vertex

    def _is_alarmed(self) -> bool:
        views = list(self._views)
        for count in _SUMS:
            statistic = sum(view.statistic for view in views[-count:])
            numbers = sum(view.numbers for view in views[-count:])
            if numbers and statistic > quantile(_SURE, numbers):
                return True
        return False

    # -- evidence --------------------------------------------------------------------------------------------------

    def _stretch(self) -> list[Link]:
        """The links since the oldest view."""
        return [link for link in self._links if link.vertices[1] > self._views[0].vertex]

    def _begin_slip(self, choice: Choice, keyframe: int, stamp_ns: int) -> None:
        links = self._stretch()[choice.first :]
        began_ns, vertex = links[0].stamps_ns[0], links[0].vertices[0]
        slip = Slip(choice.kind, began_ns, stamp_ns, 2.0 * choice.log_ratio, choice.voters)
        self.slips.append(slip)
        self._counters.count("odometry", "slip")
        self._replace(links, slip, keyframe)
        self._admit_since(vertex, keyframe)
        self._doubt(began_ns, partial(self._added.variances, slip.kind))

    def _compare(self, moved: Moved | None, keyframes: StampedPoses[Keyframe]) -> Choice:
        """Compare the hypotheses on the window: odometry's noise, a slip from each view on, and that it was moved."""
        links = self._stretch()
        first = links[0].vertices[0]
        is_determined = cache(partial(self._is_determined, first=first))
        seen = {view.vertex: self._known_seen(view, is_determined) for view in self._views if view.vertex > first}
        self.noise.measure(keyframes)
        edges = [edge for of_view in seen.values() for edge, _ in of_view if self._backend.ledger.is_inside(edge)]
        graph, prior, size = self._backend.graph, partial(self._without, edges), len(links)
        every = [graph.edge(link.edge) for link in links]
        stretch = Stretch(self._space, graph, every, seen, prior, self.noise.of_odometry, self.noise.of_all)
        firsts = sorted({self._first_of(links, since) for since in _SINCE if since < len(self._views)})
        hypotheses = [Hypothesis(kind, k, self._added_noise(kind, links, k, size)) for kind in SLIPS for k in firsts]
        if moved is not None:
            k = next((k for k, link in enumerate(links) if link.vertices[1] >= moved.first), size - 1)
            there = moved.pose_of(links[k].vertices[1])
            hypotheses.append(carried(k, there, self._space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD), size))
        return stretch.choice(hypotheses)

    def _known_seen(self, view: View, is_determined: Callable[[int | str], bool]) -> list[tuple[int, int | str]]:
        """Edges of a view of what is determined without them, held back or not, and what they are of."""
        ledger = self._backend.ledger
        return [
            (edge, what)
            for edge, what in zip(view.edges, view.seen, strict=True)
            if edge < len(ledger) and not ledger.is_withdrawn(edge) and is_determined(what)
        ]

    def _is_determined(self, what: int | str, first: int) -> bool:
        """Return whether one observation up to a keyframe determines a landmark: then the rest can be left out."""
        if isinstance(what, str) or not self._is_known(what, first):
            return isinstance(what, str)
        graph, ledger, dof = self._backend.graph, self._backend.ledger, self._backend.graph.kind_of(what).dof
        inside = (edge for edge in self._backend.solver.edges_on(what).tolist() if ledger.is_inside(edge))
        return any(one.vertices[0] <= first and one.type.residual_size >= dof for one in map(graph.edge, inside))

    def _first_of(self, links: Sequence[Link], since: int) -> int:
        """The first link after the view that precedes the last ``since`` views."""
        before = self._views[-since - 1].vertex
        return next((k for k, link in enumerate(links) if link.vertices[0] >= before), len(links) - 1)

    def _added_noise(self, kind: str, links: Sequence[Link], first: int, end: int) -> Array:
        """Variances (n, dof) that a kind of slip adds to the links from ``first`` up to ``end``, of all links."""
        is_part = (np.arange(len(links)) >= first) & (np.arange(len(links)) < end)
        return self._added.variances(kind, np.array([link.seconds for link in links])) * is_part[:, None]

    def _without(self, edges: Sequence[int], vertices: Sequence[int]) -> tuple[Array, Array]:
        """Stored values of vertices and their joint covariance without some edges; an alarm alone changes nothing."""
        solver = self._backend.solver
        try:
            return solver.joint_marginal_without(vertices, edges)
        except SingularError:  # a copy is solved anew
            graph = self._backend.graph.copy()
        graph.set_weights(np.array(edges, dtype=np.int64), 0.0)
        out = Solver(graph, solver.settings.until_still())
        out.add(solver.vertices, range(self._backend.handed_over[1]))
        out.start_at(solver.values)
        for vertex in solver.held.tolist():
            out.hold(vertex)
        joint = out.joint_marginal(vertices)
        return np.concatenate([out.values[graph.vertex(vertex).stored] for vertex in vertices]), joint

    # -- the end -----------------------------------------------------------------------------------------------------

    def _update_slip(self, now: Slip, keyframe: int, stamp_ns: int) -> None:
        """Move the start of a slip to an earlier keyframe, or end it."""
        links, backend = self._stretch(), self._backend
        is_replaced = [link.edge != link.own for link in links]
        if not any(is_replaced):
            return
        errors = odometry_errors(backend.graph, backend.solver, [link.edge for link in links], _FACTOR)
        begin = is_replaced.index(True)
        if self._began_earlier(now, links, begin, errors, keyframe):
            return
        firsts = sorted({self._first_of(links, since) for since in _AGAIN if since < len(self._views)})
        graph, own = backend.graph, [link.own for link in links]
        gains = [(errors.log_ratio_of(covariance_of(graph, own, first, errors.covariance)), first) for first in firsts]
        gain, first = max(gains, default=(0.0, 0))
        if gain > 0.0:
            self._end(now, links[first:], gain, keyframe, stamp_ns)

    def _began_earlier(
        self, now: Slip, links: Sequence[Link], begin: int, errors: OdometryErrors, keyframe: int
    ) -> bool:
        best = (_SURELY, 0)
        for count in _EARLIER:
            if count <= begin:
                added = self._added_noise(now.kind, links, begin - count, begin)
                best = max(best, (errors.log_ratio(added.ravel()), count))
        count = best[1]
        if count:
            earlier = replace(now, began_ns=links[begin - count].stamps_ns[0])
            self._replace(links[begin - count : begin], earlier, keyframe)
            self._backend.solver.update()
        return count > 0

    def _end(self, now: Slip, links: Sequence[Link], gain: float, keyframe: int, stamp_ns: int) -> None:
        """Use odometry with its own noise again, for these links."""
        pairs = [(link.own, link.edge) for link in links if link.edge != link.own]
        restore_odometry(self._backend, pairs, keyframe, -2.0 * gain)
        for link in links:
            link.edge = link.own
        left = now.edges - len(pairs)
        if not left:
            self._counters.count("odometry", "slip_taken_back")
        outcome = "" if left else "taken back: later views agree with odometry"
        self.slips[-1] = replace(now, edges=left, ended_ns=stamp_ns, outcome=outcome)
        self._doubt(stamp_ns, None)

    def slipped(self, keyframes: StampedPoses[Keyframe]) -> tuple[tuple[Pair, ...], ...]:
        """The edges of odometry of each slip that is not taken back, each with the one that replaces it."""
        every = [slipped_pairs(self._backend, keyframes, one.began_ns, one.ended_ns) for one in self.slips]
        return tuple(tuple(pairs) for pairs in every if pairs)

    def review(self, keyframes: StampedPoses[Keyframe]) -> bool:
        """Take back the slips that all measurements together contradict. Returns whether there were any."""
        changed = False
        for k, slip in enumerate(self.slips):
            pairs = slipped_pairs(self._backend, keyframes, slip.began_ns, slip.ended_ns) if slip.ended_ns else []
            if revoke_slip(self._backend, pairs, len(keyframes) - 1, _FACTOR):
                changed = True
                self._note_revoked(k, pairs)
        return changed

    def _note_revoked(self, k: int, pairs: Sequence[Pair]) -> None:
        """Note that odometry counts again with its own noise where a slip was."""
        self._counters.count("odometry", "slip_taken_back")
        slip, restored = self.slips[k], {edge for _, edge in pairs}
        outcome = "taken back: all measurements together agree with odometry"
        self.slips[k] = replace(slip, edges=max(0, slip.edges - len(pairs)), outcome=outcome)
        for link in self._links:
            link.edge = link.own if link.edge in restored else link.edge

    # -- the graph ---------------------------------------------------------------------------------------------------

    def _replace(self, links: Sequence[Link], slip: Slip, keyframe: int) -> None:
        """Replace odometry edges by edges with more noise."""
        graph, threshold = self._backend.graph, -2.0 * LOG_ODDS
        own = [link.edge for link in links]
        noises = []
        for link in links:
            root, added = graph.edge(link.edge).sqrt_information, self._added.variances(slip.kind, link.seconds)
            noises.append(Gaussian.from_covariance(np.linalg.inv(root.T @ root) + np.diag(added)))
        new = replace_odometry(self._backend, own, noises, keyframe, slip.evidence, threshold)
        self._replacing.update(new)
        for link, edge in zip(links, new, strict=True):
            link.edge = edge
        self.slips[-1] = replace(slip, edges=slip.edges + len(new))

    def _admit_since(self, vertex: int, keyframe: int) -> None:
        """Judge again the edges that were held back since a keyframe, with the wider noise of odometry."""
        ledger = self._backend.ledger
        edges = [edge for view in self._views if view.vertex >= vertex for edge in view.edges]
        self._backend.admit([edge for edge in edges if edge < len(ledger) and not ledger.is_withdrawn(edge)], keyframe)
