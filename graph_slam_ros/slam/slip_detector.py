"""Detection of slip: stretches of odometry whose errors are larger than its noise.

A view is everything that was measured from one keyframe. If the last 1, 4 or 16 views contradict odometry, each of
their keyframes is tested as the start of a slip, of translation or of rotation. The best hypothesis must exceed the
odds against a slip, also without any one landmark. Then edges with more noise replace the odometry edges of the
stretch, and new odometry gets more noise, too. The slip ends when odometry with its own noise is likelier again for
some views. If that is true of the whole stretch, the slip is taken back, and everything is as before.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.frontend import OdometryConfig
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.odometry_edges import replace_odometry, restore_odometry
from graph_slam_ros.slam.robust.landmark_history import LandmarkHistory
from graph_slam_ros.slam.robust.odometry_errors import OdometryErrors, odometry_errors
from graph_slam_ros.typing import Array

_VIEWS = 16
_SUMS = (1, 4, 16)  # views whose innovations are summed
_SURE = 1.0 - 1e-6  # probability with which clean measurements raise no alarm
_CAP = 0.9999  # no innovation counts for more than this quantile: one alone does not decide
_EARLIER = (1, 2, 3, 4, 6, 8)  # edges by which a slip may have begun before it was found
_SURELY = 1.0  # logarithm of the likelihood ratio that this needs
_AGAIN = (8, 12, 16)  # views for which odometry must be as likely by its own noise, for a slip to end
_MOST_EDGES = 60
_FACTOR = 1.5  # all noise may be larger than stated by this factor
_LASTS_S = 0.5  # correlation time of the errors of a slip
_SHARED = 0.5  # sigma of the fraction of the motion that is lost in the whole stretch
_OTHERS = 1.0 / 3.0  # sigma along the other axes, relative to the first


@dataclass(frozen=True, slots=True)
class Slip:
    """A stretch of odometry in which its errors are larger than its noise.

    Attributes
    ----------
    kind : ``translation`` or ``rotation``
    began_ns, decided_ns, ended_ns : stamps of odometry; the last is None while it goes on
    evidence : twice the logarithm of the likelihood ratio of slip to no slip
    landmarks : the number of landmarks, and of other classes of edges, that contradict odometry
    edges : the number of odometry edges that were replaced
    outcome : why it was taken back; empty if it was not
    segment : always None, because no new segment begins
    """

    kind: str
    began_ns: int
    decided_ns: int
    evidence: float
    landmarks: int
    edges: int = 0
    ended_ns: int | None = None
    outcome: str = ""
    segment: None = None

    def __str__(self) -> str:
        since = f"{self.began_ns * 1e-9:.1f} s"
        why = f"{self.landmarks} landmarks or other inputs contradict it, evidence {self.evidence:.0f}"
        if self.ended_ns is None:
            return f"odometry in doubt since {since}: its {self.kind} is wrong ({why}); it counts for less"
        until = f"{self.ended_ns * 1e-9:.1f} s"
        outcome = self.outcome or f"{self.edges} edges of odometry count for less"
        return f"odometry was in doubt from {since} to {until}: its {self.kind} was wrong ({why}); {outcome}"


@dataclass(slots=True)
class _Link:
    """An odometry edge of the problem: the original ``own``, or ``edge`` that replaces it."""

    edge: int
    own: int
    vertices: tuple[int, int]
    stamps_ns: tuple[int, int]

    @property
    def seconds(self) -> float:
        return (self.stamps_ns[1] - self.stamps_ns[0]) * 1e-9


@dataclass(slots=True)
class _View:
    """The edges that were measured from one keyframe, their landmarks or classes, and the sum of their innovations."""

    vertex: int
    edges: list[int]
    seen: list[int | str]
    statistic: float = 0.0
    numbers: int = 0


class SlipDetector:
    """Detects slips, and keeps the edges of odometry in step with them.

    Parameters
    ----------
    history : from when on each landmark is well known

    Attributes
    ----------
    slips : in order; the last may go on
    """

    def __init__(
        self, space: Geometry, odometry: OdometryConfig, backend: Backend, counters: Counters, history: LandmarkHistory
    ) -> None:
        self._space, self._config, self._backend, self._counters = space, odometry, backend, counters
        self._history = history
        self._links: deque[_Link] = deque(maxlen=_MOST_EDGES)
        self._views: deque[_View] = deque(maxlen=_VIEWS + 1)
        self._new: list[int] = []  # edges that came since the last check, whose innovation is not known yet
        self._added: set[int] = set()  # edges that replace others
        self._checked = -1
        self.slips: list[Slip] = []

    @property
    def now(self) -> Slip | None:
        """The slip that goes on."""
        return self.slips[-1] if self.slips and self.slips[-1].ended_ns is None else None

    def active(self, edge: int) -> int:
        """The edge of odometry that is in the problem between the vertices of one that was added, or replaces it."""
        vertices = tuple(self._backend.graph.edge(edge).vertices)
        return next((link.edge for link in self._links if link.vertices == vertices), edge)

    def begin(self, stamp_ns: int) -> None:
        """Begin a segment: earlier odometry is not examined any more."""
        self._links.clear()
        self._views.clear()
        self._new.clear()
        if (now := self.now) is not None:
            self.slips[-1] = replace(now, ended_ns=stamp_ns)

    def add_odometry(self, edge: int, vertices: Sequence[int], stamps_ns: tuple[int, int], keyframe: int) -> None:
        """Add the odometry edge from one keyframe to the next. During a slip it gets more noise."""
        link = _Link(edge, edge, (vertices[0], vertices[1]), stamps_ns)
        if edge in self._added or (self._links and self._links[-1].vertices == link.vertices):
            self._added.discard(edge)  # it replaces another, or another odometry measured the same motion
            return
        if self._links and self._links[-1].vertices[1] != link.vertices[0]:
            self.begin(stamps_ns[0])
        self._links.append(link)
        if (now := self.now) is not None:
            self._replace([link], now, keyframe)

    def add_seen(self, edge: int, vertex: int, what: int | str) -> None:
        """Add an edge that was measured from a keyframe: of a landmark, by its vertex, or of another class."""
        if not self._views or self._views[-1].vertex < vertex:
            self._views.append(_View(vertex, [], []))
        view = next((one for one in reversed(self._views) if one.vertex == vertex), None)
        if view is not None:
            view.edges.append(edge)
            view.seen.append(what)
            self._new.append(edge)

    def check(self, keyframe: int, stamp_ns: int) -> None:
        """Examine the evidence after a solve.

        Parameters
        ----------
        keyframe : index of the newest
        stamp_ns : of the newest odometry
        """
        self._store_innovations()
        newest = self._views[-1].vertex if self._views else -1
        if not self._config.doubt or newest == self._checked or len(self._views) < 2 or not self._stretch():
            return
        self._checked = newest
        now = self.now
        if now is None and not self._is_alarmed():
            return
        try:
            if now is None:
                self._search_slip(keyframe, stamp_ns)
            else:
                self._update_slip(now, keyframe, stamp_ns)
        except (GraphSlamError, np.linalg.LinAlgError) as error:
            self._counters.count("odometry", type(error).__name__)

    # -- alarm -----------------------------------------------------------------------------------------------------

    def _store_innovations(self) -> None:
        """Store the innovations of the new edges."""
        new, ledger = set(self._new), self._backend.ledger
        for view in reversed(self._views):
            for edge, what in zip(view.edges, view.seen, strict=True):
                if edge in new and edge < len(ledger) and self._is_known(what, view.vertex):
                    numbers = int(ledger.numbers.values[edge])
                    view.statistic += min(float(ledger.statistic.values[edge]), quantile(_CAP, numbers))
                    view.numbers += numbers
        self._new.clear()

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

    def _stretch(self) -> list[_Link]:
        """The links since the oldest view."""
        return [link for link in self._links if link.vertices[1] > self._views[0].vertex]

    def _errors(self, links: Sequence[_Link]) -> OdometryErrors:
        backend = self._backend
        return odometry_errors(backend.graph, backend.solver, [link.edge for link in links], _FACTOR)

    def _search_slip(self, keyframe: int, stamp_ns: int) -> None:
        links = self._stretch()
        errors, best, prior = self._errors(links), (0.0, "", 0), -float(np.log(self._config.doubt_odds))
        firsts = sorted({self._first_of(links, since) for since in range(1, len(self._views))})
        for kind in ("translation", "rotation"):
            added = self._added_noise(links, kind)
            for first in firsts:
                gain = errors.log_ratio(*self._between(added, first)) - prior
                best = max(best, (gain, kind, first), key=lambda one: one[0])
        gain, kind, first = best
        voters = self._voters(links[first].vertices[0]) if kind else set()
        if len(voters) < 2 or not self._holds_without_any(voters, links, first, kind):
            return
        slip = Slip(kind, links[first].stamps_ns[0], stamp_ns, 2.0 * (gain + prior), len(voters))
        self.slips.append(slip)
        self._counters.count("odometry", "slip")
        self._replace(links[first:], slip, keyframe)
        self._admit_since(links[first].vertices[0], keyframe)

    def _first_of(self, links: Sequence[_Link], since: int) -> int:
        """The first link after the view that precedes the last ``since`` views."""
        before = self._views[-since - 1].vertex
        return next((k for k, link in enumerate(links) if link.vertices[0] >= before), len(links) - 1)

    def _added_noise(self, links: Sequence[_Link], kind: str) -> tuple[Array, Array]:
        """Variances (n dof,) that a slip adds to links, and sigmas (n dof,) of the error that all links share."""
        variances = [self._slip_of(link, kind) for link in links]
        return np.concatenate(variances), _SHARED * np.concatenate([self._motion(link, kind) for link in links])

    def _between(self, added: tuple[Array, Array], first: int, end: int | None = None) -> tuple[Array, Array]:
        """Return the added noise of the links from ``first`` up to ``end``, and zero for the others."""
        dof = self._space.dof
        is_part = np.zeros(len(added[0]), dtype=bool)
        is_part[first * dof : None if end is None else end * dof] = True
        return added[0] * is_part, added[1] * is_part

    def _slip_of(self, link: _Link, kind: str) -> Array:
        """Variances (dof,) that a slip adds to a link."""
        n, seconds = self._space.dimensions, link.seconds
        sigmas = np.zeros(self._space.dof)
        if kind == "translation":
            sigmas[:n] = self._config.doubt_m_s * seconds * _OTHERS
            sigmas[0] = self._config.doubt_m_s * seconds
        else:
            sigmas[n:] = self._config.doubt_rad_s * seconds * _OTHERS
            sigmas[-1] = self._config.doubt_rad_s * seconds
        return np.asarray(sigmas**2 * max(1.0, _LASTS_S / max(seconds, 1e-9)))

    def _motion(self, link: _Link, kind: str) -> Array:
        """The translation or the rotation (dof,) of a link."""
        space, out = self._space, np.zeros(self._space.dof)
        measured = tuple(self._backend.graph.edge(link.edge).measured.tolist())
        motion = np.asarray(space.group.local(space.identity, measured), dtype=float)
        of_kind = slice(space.dimensions) if kind == "translation" else slice(space.dimensions, None)
        out[of_kind] = motion[of_kind]
        return out

    def _voters(self, since: int) -> set[int | str]:
        """Known landmarks, and other classes, with an accepted edge since a keyframe."""
        ledger = self._backend.ledger
        return {
            what
            for view in self._views
            if view.vertex >= since
            for edge, what in zip(view.edges, view.seen, strict=True)
            if edge < len(ledger) and ledger.is_inside(edge) and self._is_known(what, self._views[0].vertex)
        }

    def _holds_without_any(self, voters: set[int | str], links: Sequence[_Link], first: int, kind: str) -> bool:
        """Return whether the evidence is for a slip also without any one landmark or class."""
        added = self._between(self._added_noise(links, kind), first)
        for one in sorted(voters, key=str):
            with self._without(one):
                if self._errors(links).log_ratio(*added) <= 0.0:
                    return False
        return True

    @contextmanager
    def _without(self, what: int | str) -> Iterator[None]:
        """Leave out the edges of one landmark, or of one class, in the window."""
        solver, ledger = self._backend.solver, self._backend.ledger
        edges = [
            edge
            for view in self._views
            for edge, other in zip(view.edges, view.seen, strict=True)
            if other == what and edge < len(ledger) and ledger.is_inside(edge)
        ]
        for edge in edges:
            solver.set_weight(edge, 0.0)
        try:
            solver.update()
            yield
        finally:
            for edge in edges:
                solver.set_weight(edge, 1.0)
            solver.update()

    # -- the end -----------------------------------------------------------------------------------------------------

    def _update_slip(self, now: Slip, keyframe: int, stamp_ns: int) -> None:
        """Move the start of a slip to an earlier keyframe, or end it."""
        links = self._stretch()
        is_replaced = [link.edge != link.own for link in links]
        if not any(is_replaced):
            return
        errors, begin = self._errors(links), is_replaced.index(True)
        if self._began_earlier(now, links, begin, errors, keyframe):
            return
        firsts = sorted({self._first_of(links, since) for since in _AGAIN if since < len(self._views)})
        gains = [
            (errors.log_ratio_of(self._with_own_noise(links, first, errors.covariance)), first) for first in firsts
        ]
        gain, first = max(gains, default=(0.0, 0))
        if gain > 0.0:
            self._end(now, links[first:], gain, keyframe, stamp_ns)

    def _began_earlier(
        self, now: Slip, links: Sequence[_Link], begin: int, errors: OdometryErrors, keyframe: int
    ) -> bool:
        best, added = (_SURELY, 0), self._added_noise(links, now.kind)
        for count in _EARLIER:
            if count <= begin:
                best = max(best, (errors.log_ratio(*self._between(added, begin - count, begin)), count))
        count = best[1]
        if count:
            earlier = replace(now, began_ns=links[begin - count].stamps_ns[0])
            self._replace(links[begin - count : begin], earlier, keyframe)
            self._backend.solver.update()
        return count > 0

    def _end(self, now: Slip, links: Sequence[_Link], gain: float, keyframe: int, stamp_ns: int) -> None:
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

    def _with_own_noise(self, links: Sequence[_Link], first: int, covariance: Array) -> Array:
        dof, out = self._space.dof, covariance.copy()
        for k, link in enumerate(links[first:], start=first):
            rows, root = slice(k * dof, (k + 1) * dof), self._backend.graph.edge(link.own).sqrt_information
            out[rows, rows] = np.linalg.inv(root.T @ root)
        return out

    # -- the graph ---------------------------------------------------------------------------------------------------

    def _replace(self, links: Sequence[_Link], slip: Slip, keyframe: int) -> None:
        """Replace odometry edges by edges with more noise."""
        graph, threshold = self._backend.graph, -2.0 * float(np.log(self._config.doubt_odds))
        own = [link.edge for link in links]
        noises = []
        for link in links:
            root = graph.edge(link.edge).sqrt_information
            noises.append(
                Gaussian.from_covariance(np.linalg.inv(root.T @ root) + np.diag(self._slip_of(link, slip.kind)))
            )
        new = replace_odometry(self._backend, own, noises, keyframe, slip.evidence, threshold)
        self._added.update(new)
        for link, edge in zip(links, new, strict=True):
            link.edge = edge
        self.slips[-1] = replace(slip, edges=slip.edges + len(new))

    def _admit_since(self, vertex: int, keyframe: int) -> None:
        """Judge again the edges that were held back since a keyframe, with the wider noise of odometry."""
        ledger = self._backend.ledger
        edges = [edge for view in self._views if view.vertex >= vertex for edge in view.edges]
        self._backend.admit([edge for edge in edges if edge < len(ledger) and not ledger.is_withdrawn(edge)], keyframe)
