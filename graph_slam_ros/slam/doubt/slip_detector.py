"""Detection of slip: stretches of odometry whose errors are larger than its noise.

A view is everything that was measured from one keyframe. If the last 1 to 16 views contradict odometry more than is
usual in this drive, some of their keyframes are tested as the start of a slip, of translation or of rotation, beside
the hypothesis that the robot was moved. The best must be a slip, exceed the odds against it, and be likelier than none
also without any one landmark. Then edges with more noise replace the odometry edges of the stretch, and new odometry
gets more noise, too. With each new view it is asked whether the slip began earlier, or has ended. If odometry with its
own noise is likelier in the whole stretch, the slip is taken back, and everything is as before. When everything is
solved, each slip is asked about again.
"""

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import GraphSlamError, SingularError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.evidence import (
    CARRIED,
    LOG_ODDS,
    SLIPS,
    Choice,
    Hypothesis,
    Stretch,
    carried,
    covariance_of,
)
from graph_slam_ros.slam.doubt.odometry_errors import NOISE_FACTOR, MeasuredNoise, OdometryErrors, between
from graph_slam_ros.slam.doubt.record import DOUBT, DisplacementHypothesis, Link, Slip
from graph_slam_ros.slam.doubt.window import View, Window
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.slam.revision import Replacement, Revision
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array

_VIEWS, _MOST_EDGES = 17, 60  # newest ones that are compared
_SINCE = (1, 2, 4, 6, 8, 12, 16)  # views before which a slip may have begun
_EARLIER = (1, 2, 3, 4, 6, 8)  # edges by which a slip may have begun before it was found
_SURELY = 1.0  # logarithm of the likelihood ratio that this needs
_AGAIN = (8, 12, 16)  # views for which odometry must be as likely by its own noise, for a slip to end
_PART = 0.05  # of the views cause a comparison at most, but for so many that follow one another:
_BURST = 20.0
_SLIP_M_S, _SLIP_RAD_S = 0.35, 0.35  # sigmas of what odometry does not notice: some of an indoor robot's speeds
_LASTS_S = 0.5  # correlation time of the errors of a slip
_LONGEST_S = 1.0  # of one edge; wheels that stand longer do not slip: the robot was carried
_THRESHOLD = -2.0 * LOG_ODDS  # that the evidence of a slip is compared with
_OTHERS = 1.0 / 3.0  # sigma along the other axes, relative to the first

Pair = tuple[int, int]
"""An edge of odometry that slipped, and the one that replaces it."""

Doubt = Callable[[int, Callable[[float], Array] | None], None]
SeenOf = Mapping[int, Sequence[tuple[int, int | str]]]


class SlipDetector:
    """Detects slips, and keeps the edges of odometry in step with them.

    Parameters
    ----------
    doubt : takes a stamp since when odometry has more noise, and the variances that so many seconds add; None: its own

    Attributes
    ----------
    slips : in order; the last may go on
    """

    def __init__(self, config: Config, backend: Backend, counters: Counters, window: Window, doubt: Doubt) -> None:
        self._space, self._config = config.space, config.odometry
        self._backend, self._counters = backend, counters
        self._window, self._doubt = window, doubt
        self._checked: View | None = None
        self._allowed = _BURST
        self._noise = MeasuredNoise(config.space, backend)
        self.slips: list[Slip] = []
        self._replaced = dict[int, tuple[int, int]]()  # of edges of odometry: by which slip, and the one in its place

    @property
    def now(self) -> Slip | None:
        """The slip that goes on."""
        return self.slips[-1] if self.slips and self.slips[-1].ended_ns is None else None

    def begin(self, stamp_ns: int) -> None:
        """A segment begins: a slip has ended."""
        if (now := self.now) is not None:
            self.slips[-1] = replace(now, ended_ns=max(stamp_ns, now.began_ns))
            self._doubt(stamp_ns, None)

    def add_odometry(self, link: Link) -> None:
        """Take over odometry to a new keyframe. During a slip it gets more noise."""
        if (now := self.now) is not None:
            wider = self._wider_edges([link], now)
            self._note_replaced([link], now, self._backend.replace(wider, Reason.SLIP, now.evidence, _THRESHOLD))

    def check(self, stamp_ns: int, moved: DisplacementHypothesis | None = None, *, is_decided: bool = False) -> bool:
        """Examine the evidence after a solve. Returns whether a slip explains it better than that the robot was moved.

        Such a slip begins if it is sure.

        Parameters
        ----------
        stamp_ns : of the newest odometry
        moved : where the robot may have been moved to
        is_decided : whether it is decided now, if a slip does not explain it better
        """
        views = list(self._window.views)[-_VIEWS:]
        links = self._window.stretch(_VIEWS, _MOST_EDGES) if len(views) > 1 else []
        if not self._config.doubt or not links:
            return False
        is_new, self._checked = views[-1] is not self._checked, views[-1]
        self._allowed = min(_BURST, self._allowed + _PART * is_new)
        try:
            if self.now is None and (is_decided or (is_new and self._allowed >= 1.0 and self._window.is_alarmed)):
                self._allowed = max(0.0, self._allowed - 1.0)
                choice = self._compare(links, views, moved)
                if choice.is_slip:
                    self._begin_slip(choice, links[choice.first :], stamp_ns)
                return choice.kind in SLIPS
            if self.now is None or not is_new:
                return False
            explains = is_decided and self._compare(links, views, moved).kind != CARRIED
            self._update_slip(self.now, links, views, stamp_ns)
            return explains
        except (GraphSlamError, np.linalg.LinAlgError):  # nothing can be compared: odometry counts as before
            return False

    # -- evidence --------------------------------------------------------------------------------------------------

    def _compare(self, links: Sequence[Link], views: Sequence[View], moved: DisplacementHypothesis | None) -> Choice:
        """Compare the hypotheses: odometry's noise, a slip from each view on, and that the robot was moved."""
        self._noise.measure()
        stretch = self._stretch([link.edge for link in links], self._measured_from(links, views))
        firsts = sorted({_first_of(links, views[-since - 1]) for since in _SINCE if since < len(views)})
        every = [Hypothesis(kind, k, self._added(kind, links, k, len(links))) for kind in SLIPS for k in firsts]
        if moved is not None:
            k = next((k for k, link in enumerate(links) if link.vertices[1] >= moved.first), len(links) - 1)
            there = self._space.group.compose(moved.T_map_chain, links[k].pose)
            every.append(carried(k, there, self._space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD), len(links)))
        return stretch.choice(every)

    def _stretch(self, edges: Sequence[int], seen: SeenOf) -> Stretch:
        """A stretch of odometry, and its likelihood without what was seen along it; an alarm alone changes nothing."""
        graph, ledger, noise = self._backend.graph, self._backend.ledger, self._noise
        out = [edge for of_view in seen.values() for edge, _ in of_view if ledger.is_inside(edge)]
        prior = partial(self._without, out)
        every = [graph.edge(edge) for edge in edges]
        return Stretch(self._space, graph, every, seen, prior, noise.of_odometry, noise.of_all)

    def _without(self, edges: Sequence[int], vertices: Sequence[int]) -> tuple[Array, Array]:
        """Stored values of vertices and their joint covariance without some edges."""
        solver, graph = self._backend.solver, self._backend.graph
        try:
            return solver.joint_marginal_without(vertices, edges)
        except SingularError:  # a copy is solved anew
            graph = graph.copy()
        graph.set_weights(np.array(edges, dtype=np.int64), 0.0)
        anew = Solver(graph, solver.settings.until_still())
        anew.add(solver.vertices, graph.edge_ids.since(0, self._backend.handed_over[1]))
        anew.start_at(solver.values)
        for vertex in solver.held.tolist():
            anew.hold(vertex)
        joint = anew.joint_marginal(vertices)
        return np.concatenate([anew.values[graph.vertex(vertex).stored] for vertex in vertices]), joint

    def _measured_from(self, links: Sequence[Link], views: Sequence[View]) -> SeenOf:
        """Edges by the keyframe at the end of each link, accepted or not, of landmarks that other edges determine."""
        first, ledger = links[0].vertices[0], self._backend.ledger
        ends = {link.vertices[1] for link in links}
        is_determined = cache(partial(self._is_determined, known_by=first, keyframes=ends))
        return {
            view.vertex: [
                (one.edge, one.what)
                for one in view.seen
                if one.edge < ledger.ids.next and not ledger.is_withdrawn(one.edge) and is_determined(one.what)
            ]
            for view in views
            if view.vertex in ends
        }

    def _is_determined(self, what: int | str, known_by: int, keyframes: Container[int]) -> bool:
        """Return whether one observation from another keyframe determines a landmark: then the rest can be left out."""
        if isinstance(what, str) or self._window.known_from(what) >= known_by:
            return isinstance(what, str)
        graph, ledger, dof = self._backend.graph, self._backend.ledger, self._backend.graph.kind_of(what).dof
        inside = (edge for edge in self._backend.solver.edges_on(what).tolist() if ledger.is_inside(edge))
        return any(
            one.vertices[0] not in keyframes and one.type.residual_size >= dof for one in map(graph.edge, inside)
        )

    def _added(self, kind: str, links: Sequence[Link], first: int, end: int) -> Array:
        """Variances (n, dof) that a kind of slip adds to the links from ``first`` up to ``end``, of all links."""
        is_part = (np.arange(len(links)) >= first) & (np.arange(len(links)) < end)
        return _variances(self._space, kind, np.array([link.seconds for link in links])) * is_part[:, None]

    def _wider(self, kind: str, links: Sequence[Link], first: int, end: int) -> Array:
        """The same as covariances (n, dof, dof), as if all noise were larger."""
        return self._added(kind, links, first, end)[:, :, None] * np.eye(self._space.dof) / NOISE_FACTOR**2

    # -- a slip ------------------------------------------------------------------------------------------------------

    def _begin_slip(self, choice: Choice, links: Sequence[Link], stamp_ns: int) -> None:
        began_ns, vertex, ledger = links[0].stamps_ns[0], links[0].vertices[0], self._backend.ledger
        slip = Slip(choice.kind, began_ns, stamp_ns, 2.0 * choice.log_ratio, choice.voters)
        # what was held back since then is judged again, with the wider noise of odometry
        edges = [one.edge for view in list(self._window.views)[-_VIEWS:] if view.vertex >= vertex for one in view.seen]
        compared = [edge for edge in edges if edge < ledger.ids.next and not ledger.is_withdrawn(edge)]
        self.slips.append(slip)
        if not self._replace(links, slip, compared):
            self.slips.pop()
            return
        self._counters.count("odometry", "slip")
        self._doubt(began_ns, partial(_variances, self._space, slip.kind))

    def _update_slip(self, now: Slip, links: Sequence[Link], views: Sequence[View], stamp_ns: int) -> None:
        """Move the start of a slip to an earlier keyframe, or end it."""
        begin = next((k for k, link in enumerate(links) if link.edge != link.own), None)
        if begin is None:
            return
        graph, own, used = self._backend.graph, [link.own for link in links], [link.edge for link in links]
        errors = OdometryErrors(graph, self._backend.solver, used)
        best, first = _SURELY, begin
        for count in _EARLIER:
            if count <= begin and (gain := errors.log_ratio(self._wider(now.kind, links, begin - count, begin))) > best:
                best, first = gain, begin - count
        if first < begin:
            self._replace(links[first:begin], replace(now, began_ns=links[first].stamps_ns[0]))
            return
        narrower = between(graph, own, used)
        firsts = sorted({_first_of(links, views[-since - 1]) for since in _AGAIN if since < len(views)})
        is_since = [(np.arange(len(links)) >= first)[:, None, None] for first in firsts]
        gains = [errors.log_ratio(narrower * of_each) for of_each in is_since]
        if gains and max(gains) > 0.0:
            self._end(now, links[firsts[int(np.argmax(gains))] :], max(gains), stamp_ns)

    def _end(self, now: Slip, links: Sequence[Link], gain: float, stamp_ns: int) -> None:
        """Use odometry with its own noise again, for these links."""
        pairs = [(link.own, link.edge) for link in links if link.edge != link.own]
        if not self._restore(pairs, gain):
            return
        left = now.edges - len(pairs)
        if not left:
            self._counters.count("odometry", "slip_taken_back")
        outcome = "" if left else "taken back: later views agree with odometry"
        self.slips[-1] = replace(now, edges=left, ended_ns=stamp_ns, outcome=outcome)
        self._doubt(stamp_ns, None)

    def slipped(self) -> tuple[tuple[Pair, ...], ...]:
        """The edges of odometry of each slip that is not taken back, each with the one that replaces it."""
        every = map(self._slipped, range(len(self.slips)))
        return tuple(tuple(pairs) for pairs in every if pairs)

    def review(self) -> bool:
        """Take back the slips that all measurements together contradict. Returns whether there were any."""
        changed = False
        for k, slip in enumerate(self.slips):
            pairs = self._slipped(k) if slip.ended_ns else []
            gain = self._gain_without(pairs) if pairs else 0.0
            if gain > 0.0 and self._restore(pairs, gain):
                changed = True
                self._counters.count("odometry", "slip_taken_back")
                outcome = "taken back: all measurements together agree with odometry"
                self.slips[k] = replace(slip, edges=max(0, slip.edges - len(pairs)), outcome=outcome)
        return changed

    def _gain_without(self, pairs: Sequence[Pair]) -> float:
        """The logarithm of the likelihood ratio of no slip to a slip; 0 where it cannot be computed."""
        graph = self._backend.graph
        ends = [graph.edge(own).vertices for own, _ in pairs]
        if any(a[1] != b[0] for a, b in pairwise(ends)):
            return 0.0
        own, used = zip(*pairs, strict=True)
        try:
            return OdometryErrors(graph, self._backend.solver, used).log_ratio(between(graph, own, used))
        except (GraphSlamError, np.linalg.LinAlgError):
            return 0.0

    def _slipped(self, k: int) -> list[Pair]:
        """Odometry edges of a slip, by its place, that count as such, each with its replacement, in order of time."""
        ids, ledger, first = self._backend.graph.edge_ids, self._backend.ledger, self._backend.first_free_edge
        pairs = [(own, used) for own, (slip, used) in sorted(self._replaced.items()) if slip == k]
        there = [(own, used) for own, used in pairs if own >= first and ids.has(own) and ids.has(used)]
        is_slip = ledger.reason.values == Reason.SLIP
        return [
            (own, used)
            for own, used in there
            if is_slip[ledger.ids.row(own)] and ledger.verdict_of(used) is not Verdict.REJECTED
        ]

    # -- the graph: the ledger has both edges ------------------------------------------------------------------------

    def _replace(self, links: Sequence[Link], slip: Slip, compared: Sequence[int] = ()) -> bool:
        """Put edges with more noise in place of odometry's, and solve. Returns whether that was possible."""
        replaced, evidence = self._wider_edges(links, slip), slip.evidence
        revision = Revision(
            replaced=replaced, compared=compared, reason=Reason.SLIP, evidence=evidence, threshold=_THRESHOLD
        )
        if (applied := self._backend.apply(DOUBT, lambda: revision)) is not None:
            self._note_replaced(links, slip, applied.replaced)
        return applied is not None

    def _wider_edges(self, links: Sequence[Link], slip: Slip) -> list[Replacement]:
        out = []
        for link in links:
            own, added = self._backend.graph.edge(link.own), _variances(self._space, slip.kind, np.array(link.seconds))
            noise = Gaussian.from_covariance(covariance_of(own) + np.diag(added))
            out.append(Replacement(link.own, own.measured, noise))
        return out

    def _note_replaced(self, links: Sequence[Link], slip: Slip, pairs: Iterable[Pair]) -> None:
        for link, (own, used) in zip(links, pairs, strict=True):
            link.edge = used
            self._replaced[own] = len(self.slips) - 1, used
        self.slips[-1] = replace(slip, edges=slip.edges + len(links))

    def _restore(self, pairs: Sequence[Pair], gain: float) -> bool:
        """Use odometry's own edges again. Returns whether that could be solved."""
        if self._backend.apply(DOUBT, lambda: Revision(restored=pairs, evidence=-2.0 * gain)) is None:
            return False
        links = {link.own: link for link in self._window.links.values()}
        for own, _ in pairs:
            if own in links:
                links[own].edge = own
        return True


def _first_of(links: Sequence[Link], view: View) -> int:
    """The first link after a view, by its place."""
    return next((k for k, link in enumerate(links) if link.vertices[0] >= view.vertex), len(links) - 1)


def _variances(space: Geometry, kind: str, seconds: float | Array) -> Array:
    """Variances (..., dof) that a kind of slip adds to edges that last so long (...)."""
    n, seconds = space.dimensions, np.minimum(seconds, _LONGEST_S)
    per_s = np.zeros(space.dof)
    if kind == "translation":
        per_s[:n] = _SLIP_M_S * _OTHERS
        per_s[0] = _SLIP_M_S
    else:
        per_s[n:] = _SLIP_RAD_S * _OTHERS
        per_s[-1] = _SLIP_RAD_S
    independent = np.maximum(1.0, _LASTS_S / np.maximum(seconds, 1e-9))
    return np.asarray((np.asarray(seconds)[..., None] * per_s) ** 2 * independent[..., None])
