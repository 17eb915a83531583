"""The newest keyframes: odometry between them, what was seen from each, and whether the sum of that contradicts it.

Each sighting has a normalised innovation squared (NIS), and sums of NIS are compared with chi-square quantiles. An
alarm of a slip is a sum over the newest views that is larger than is usual in this drive. An alarm that the robot is
elsewhere takes a few sightings of each landmark, since these err together. Some sightings have wrong identities,
however good odometry is. So the worst are left out of it, as many as the rate of such errors in this drive explains.
"""

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice, takewhile
from statistics import median

import numpy as np
from scipy.special import bdtr, betaincinv

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.evidence import covariance_of
from graph_slam_ros.slam.doubt.record import Link
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.levels import BY_CHANCE, GATE, LIKELY, TYPICAL
from graph_slam_ros.typing import Array, Mask, Numbers

_KEYFRAMES = 2000  # whose odometry is kept
_VIEWS = 50  # that are kept
_SURE = 1.0 - BY_CHANCE  # probability with which clean measurements raise no alarm
_SUMS = (1, 2, 4, 8, 16)  # views whose innovations are summed
_USUAL = 200  # newest sightings whose median says how large residuals are
_NEWEST, _LEAST = 20, 6  # sightings that are compared for the other alarm
_PER_LANDMARK = 4  # of them, at most
REACH_S = 20.0  # sightings that are older are not compared with the newest
_CALM, _CALM_SURE = 12, 0.99  # newest sightings of which three quarters must agree for an alarm to end
_SUPPORT, _FIRST = 4, 20  # accepted sightings, of the first so many, that make a landmark one to compare with
_DOUBTED = 0.3  # part of them that may be held back: else the landmark itself stands at the wrong place


@dataclass(frozen=True, slots=True)
class Seen:
    """An edge that was measured from a keyframe, and what it is of: a landmark, by its vertex, or another class.

    Attributes
    ----------
    point : a landmark's position in odometry's own frame; None where a sighting does not tell one
    variance : of it, the largest of any direction
    heading, heading_variance : of a landmark that is a pose in the plane, in the same frame; NaN where it was not seen
    """

    edge: int
    what: int | str
    point: Array | None = None
    variance: float = 0.0
    heading: float = np.nan
    heading_variance: float = 0.0


@dataclass(slots=True)
class View:
    """All that was measured from one keyframe, and the sum of its normalised innovations squared, ``statistic``."""

    vertex: int
    stamp_ns: int
    seen: list[Seen]
    statistic: float = 0.0
    numbers: int = 0


class Window:
    """The newest keyframes.

    Attributes
    ----------
    links : odometry by the vertex of the later keyframe
    views : of keyframes from which anything was seen, in order
    first : vertex of the segment's first keyframe; what was before it is forgotten
    is_whole : whether all views since then are kept
    """

    def __init__(self, space: Geometry, backend: Backend) -> None:
        self._space, self._backend = space, backend
        self._start = backend.graph.vertex_ids.next  # landmarks of a map that was loaded are known
        self._surveyed: set[int] = set()
        self._earliest: dict[int, list[tuple[int, int]]] = {}  # (edge, keyframe) of each landmark's first sightings
        self._known: dict[int, int] = {}  # what was looked up since the last solve
        self.links: dict[int, Link] = {}
        self.views: deque[View] = deque()
        self.first, self.is_whole = 0, True
        self._new: list[tuple[View, Seen]] = []  # since the last solve, whose innovation is not known yet
        self._ratios: deque[float] = deque(maxlen=_USUAL)  # of the newest squared residuals to the stated median
        self._held_back, self._count = 0, 0  # of sightings in views that were left behind

    # -- what came -----------------------------------------------------------------------------------------------

    def begin(self, vertex: int) -> None:
        """A segment begins at a keyframe: what was before tells nothing of where the robot is."""
        self.first, self.is_whole = vertex, True
        self.links = {end: link for end, link in self.links.items() if end >= vertex}
        self.views = deque(view for view in self.views if view.vertex >= vertex)
        self._new = [one for one in self._new if one[0].vertex >= vertex]

    def forget_before(self, first: int) -> None:
        """Forget what has left the graph with the keyframes before one, by its vertex."""
        graph = self._backend.graph
        self.first, self._start = max(self.first, first), first
        self._earliest = {
            landmark: [one for one in earliest if graph.edge_ids.has(one[0])]
            for landmark, earliest in self._earliest.items()
            if landmark >= first and graph.vertex_ids.has(landmark)
        }
        self._known.clear()
        self._new.clear()
        self.links = {end: link for end, link in self.links.items() if end > first}
        for view in self.views:
            kept = [one for one in view.seen if graph.edge_ids.has(one.edge)]
            self.is_whole &= len(kept) == len(view.seen)
            view.seen = kept
        self.is_whole &= all(view.vertex in self.links for view in self.views)
        self.views = deque(view for view in self.views if view.vertex in self.links and view.seen)

    def add_odometry(self, edge: int, vertices: Sequence[int], stamps_ns: tuple[int, int]) -> Link | None:
        """Add an edge of odometry from one keyframe to the next. Returns None where it replaces another."""
        last, now = vertices
        if now in self.links:
            self.links[now].edge = edge
            return None
        if self.links and last not in self.links:
            self.begin(now)
        one, before = self._backend.graph.edge(edge), self.links.get(last)
        pose = self._space.group.compose(before.pose if before else self._space.identity, tuple(one.measured.tolist()))
        variances, n = covariance_of(one).diagonal(), self._space.dimensions
        drift = np.array([variances[:n].max(), variances[n:].max()]) + (before.drift if before else 0.0)
        link = self.links[now] = Link(edge, edge, (last, now), stamps_ns, tuple(map(float, pose)), drift)
        if len(self.links) > _KEYFRAMES:
            oldest = next(iter(self.links))
            del self.links[oldest]
            if self.views and self.views[0].vertex <= oldest:
                self._leave_behind(self.views.popleft())
        return link

    def add_survey(self, landmark: int) -> None:
        """Note a landmark, by its vertex, whose position is surveyed."""
        self._surveyed.add(landmark)

    def add_seen(self, edge: int, vertex: int, what: int | str, stamp_ns: int) -> None:
        """Add an edge that was measured from a keyframe: of a landmark, by its vertex, or of another class."""
        if not isinstance(what, str) and len(earliest := self._earliest.setdefault(what, [])) < _FIRST:
            earliest.append((edge, vertex))
        if not self.views or self.views[-1].vertex < vertex:
            self.views.append(View(vertex, stamp_ns, []))
            if len(self.views) > _VIEWS:
                self._leave_behind(self.views.popleft())
        view = next((one for one in reversed(self.views) if one.vertex == vertex), None)
        if view is not None:
            seen = Seen(edge, what)
            if not isinstance(what, str) and vertex in self.links:
                seen = self._located(seen, self.links[vertex].pose)
            view.seen.append(seen)
            self._new.append((view, seen))

    def _located(self, seen: Seen, base: Numbers) -> Seen:
        """A sighting with the position and the heading that it tells by itself."""
        space, one = self._space, self._backend.graph.edge(seen.edge)
        n, covariance = space.dimensions, covariance_of(one)
        if one.type is space.sightings["range_bearing"]:
            at = motion_compensation.point_of(space, tuple(one.measured[:n].tolist()))
            point = np.array(space.group.act(tuple(one.measured[n:].tolist()), tuple(at.tolist())))
            variance = max(covariance[0, 0], point @ point * covariance.diagonal()[1:].max())
        elif one.type in (space.relative_pose, space.tag_position, space.sightings["position"]):
            point, variance = one.measured[:n], np.linalg.eigvalsh(covariance[:n, :n])[-1]
        else:
            return seen
        out = replace(seen, point=np.array(space.group.act(base, tuple(point.tolist()))), variance=float(variance))
        if one.type is not space.relative_pose or n != 2:
            return out
        return replace(out, heading=base[2] + float(one.measured[2]), heading_variance=float(covariance[2, 2]))

    def _leave_behind(self, view: View) -> None:
        """Count the sightings of a view that is dropped: they say how many identities are wrong."""
        self.is_whole, ledger = False, self._backend.ledger
        is_standing = ledger.is_standing()
        for one in view.seen:
            if not isinstance(one.what, str) and is_standing(one.edge) and self.known_from(one.what) < view.vertex:
                self._count += 1
                self._held_back += not ledger.is_inside(one.edge)

    # -- what it tells -------------------------------------------------------------------------------------------

    def known_from(self, landmark: int | str) -> int:
        """The keyframe, by its vertex, from which on a landmark was well known; -1 of other classes.

        What is held back in this window tells nothing against it.
        """
        if isinstance(landmark, str) or landmark < self._start or landmark in self._surveyed:
            return -1
        if landmark not in self._known:
            graph, ledger = self._backend.graph, self._backend.ledger
            oldest = self.views[0].seen[0].edge if self.views else graph.edge_ids.next
            earliest = [one for one in self._earliest[landmark] if one[0] < ledger.ids.next]
            are_inside = ledger.are_inside(edge for edge, _ in earliest)
            accepted = [keyframe for (_, keyframe), is_in in zip(earliest, are_inside, strict=True) if is_in]
            doubted = sum(edge < oldest and not is_in for (edge, _), is_in in zip(earliest, are_inside, strict=True))
            is_known = len(accepted) >= _SUPPORT and doubted <= _DOUBTED * (doubted + len(accepted))
            self._known[landmark] = accepted[_SUPPORT - 1] if is_known else graph.vertex_ids.next
        return self._known[landmark]

    @property
    def newest_ns(self) -> int:
        """The stamp of the newest keyframe."""
        return next(reversed(self.links.values())).stamps_ns[1] if self.links else 0

    def stretch(self, views: int, most: int) -> list[Link]:
        """The newest links since the oldest of so many views, at most so many, and none of a map that is held."""
        oldest, first = self.views[-min(views, len(self.views))].vertex, self._backend.first_free_edge
        newest = takewhile(lambda link: link.vertices[1] > oldest and link.own >= first, reversed(self.links.values()))
        return list(islice(newest, most))[::-1]

    def drift_since(self, variances: Array, pose: Numbers, keyframe: int) -> tuple[float, float]:
        """Sigmas [m, rad] of odometry up to a keyframe, since it had these variances and was there."""
        link, n = self.links[keyframe], self._space.dimensions
        since, lever = link.drift - variances, float(np.linalg.norm(np.subtract(link.pose[:n], pose[:n])))
        return float(np.sqrt(since[0] + since[1] * lever**2)), float(np.sqrt(since[1]))

    def note_solved(self) -> None:
        """Add the innovations of what came since the last solve to the sums."""
        ledger, usual = self._backend.ledger, self._usual()
        self._known.clear()
        for view, one in self._new:
            if one.edge < ledger.ids.next and self.known_from(one.what) < view.vertex:
                row = ledger.ids.row(one.edge)
                numbers, statistic = int(ledger.numbers.values[row]), float(ledger.statistic.values[row])
                self._ratios.append(statistic / quantile(0.5, numbers))
                view.statistic += min(statistic / usual, quantile(GATE, numbers))  # one alone does not decide
                view.numbers += numbers
        self._new.clear()

    def _usual(self) -> float:
        """Return how large squared residuals at predicted poses are, in units of the stated noise's; at least 1."""
        return max(1.0, median(self._ratios)) if len(self._ratios) >= TYPICAL else 1.0

    @property
    def is_alarmed(self) -> bool:
        """Return whether the newest views contradict odometry more than is usual in this drive."""
        views = list(self.views)
        for count in _SUMS:
            numbers = sum(view.numbers for view in views[-count:])
            if numbers and sum(view.statistic for view in views[-count:]) > quantile(_SURE, numbers):
                return True
        return False

    def contradiction(self) -> tuple[int, int, bool]:
        """Of the newest sightings, how many are held back, all, and whether they contradict odometry.

        They do where neither noise nor wrong identities explain them; a few tell nothing.
        """
        newest = list(self._newest())
        if len(newest) < _LEAST:
            return 0, 0, False
        wrong = _wrong_by_chance(len(newest), self._held_back, self._count)
        is_beyond, is_out = self._is_beyond(newest, wrong, _SURE)
        landmarks = {newest[k].what for k in np.flatnonzero(is_out).tolist()}
        return int(np.count_nonzero(is_out)), len(newest), is_beyond and len(landmarks) >= 2

    @property
    def is_calm(self) -> bool:
        """Return whether most of the newest sightings agree with odometry."""
        newest = list(islice(self._newest(), _CALM))
        return bool(newest) and not self._is_beyond(newest, len(newest) // 4, _CALM_SURE)[0]

    def _is_beyond(self, newest: Sequence[Seen], left_out: int, sure: float) -> tuple[bool, Mask]:
        """Whether the costs of sightings now, without the worst, are beyond noise in sum; and which are held back."""
        edges, backend = np.array([one.edge for one in newest]), self._backend
        innovations, numbers = backend.solver.chi2_of(edges)
        is_out = ~np.array(backend.ledger.are_inside(edges.tolist()), dtype=bool)
        innovations[is_out] = backend.decisions.innovations(edges[is_out].tolist())
        counted = np.argsort(innovations / numbers, kind="stable")[: len(newest) - left_out]
        limit = backend.decisions.stated_scale * quantile(sure, int(numbers[counted].sum()))  # NaN of none
        return float(innovations[counted].sum()) > limit, is_out

    def _newest(self) -> Iterator[Seen]:
        """The newest sightings of well known landmarks, the newest first."""
        times = Counter[int]()
        is_standing = self._backend.ledger.is_standing()
        for view in reversed(self.views):
            for one in reversed(view.seen):
                if times.total() == _NEWEST or (self.views[-1].stamp_ns - view.stamp_ns) * 1e-9 > REACH_S:
                    return
                if isinstance(one.what, str) or times[one.what] == _PER_LANDMARK or not is_standing(one.edge):
                    continue
                if self.known_from(one.what) < view.vertex:
                    times[one.what] += 1
                    yield one


@lru_cache(maxsize=64)
def _wrong_by_chance(count: int, held_back: int, seen: int) -> int:
    """The most of a count that are wrong, at the rate by which some of those seen were held back."""
    rate = betaincinv(1 + held_back, 1 + seen - held_back, LIKELY)
    return next((k for k in range(count) if bdtr(k, count, rate) >= _SURE), count)
