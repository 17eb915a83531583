"""Scans: the sightings without id of half a second, moved to one instant by odometry.

The sightings of one landmark in a scan are a cluster. A cluster is their mean, with the covariance of a single one,
because an error that lasts half a second is the same in all of them. The clusters of one scan are different landmarks.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.pipeline import OdometryConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.edge_noise import LEAST_M2
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.landmarks.rotations import lever, rotation, turn_of
from graph_slam_ros.typing import Array, Mask, Numbers

SCAN_NS, _SCAN_RAD = 500_000_000, 0.15  # of one scan: in it odometry errs by less than the clusters
FIT_M = 0.5  # a cluster nearer to a landmark is of it
NEARBY_NS = SCAN_NS
NEARBY_S = np.linspace(-NEARBY_NS * 1e-9, NEARBY_NS * 1e-9, 21)
"""Times relative to a scan's stamp, at which its motion by odometry is kept, for clocks that differ."""
_SAME = 0.9973  # probability with which two sightings of one thing fall into one cluster


@dataclass(frozen=True, slots=True)
class Reckoned:
    """Dead reckoning at a stamp.

    Attributes
    ----------
    pose : since odometry began, without its jumps
    turned, way, moving_s : sums of absolute steps [rad, m, s]
    segment : how often odometry has jumped
    """

    stamp_ns: int
    pose: Numbers
    turned: float = 0.0
    way: float = 0.0
    moving_s: float = 0.0
    segment: int = 0


class DeadReckoning:
    """The sum of odometry, as far back as late sightings may reach."""

    def __init__(self, space: Geometry, remembered_s: float) -> None:
        self._space, self._remembered_ns = space, round(remembered_s * 1e9)
        self._samples: list[Reckoned] = []

    def step(self, step: Step, *, stands: bool) -> None:
        """Add one step of odometry."""
        if not self._samples:
            self._samples.append(Reckoned(step.stamp_ns, self._space.identity))
            return
        a = self._samples[-1]
        if step.stamp_ns < a.stamp_ns:  # stamps begin anew: none before can be told from them
            self._samples.clear()
        if step.broken or not self._samples:
            b = Reckoned(step.stamp_ns, a.pose, a.turned, a.way, a.moving_s, a.segment + 1)
        else:
            group, moved = self._space.group, step.T_last_base
            pose = self._space.normalized(tuple(map(float, group.compose(a.pose, moved))))
            turned, way, moving_s = a.turned, a.way, a.moving_s
            if not stands:
                turned += self._space.angle(moved)
                way += float(sum(x * x for x in moved[: self._space.dimensions])) ** 0.5
                moving_s += (step.stamp_ns - a.stamp_ns) * 1e-9
            b = Reckoned(step.stamp_ns, pose, turned, way, moving_s, a.segment)
        self._samples.append(b)
        if len(self._samples) > 64 and self._samples[32].stamp_ns < step.stamp_ns - self._remembered_ns:
            del self._samples[:32]

    def rescale(self, factors: tuple[float, float]) -> None:
        """Multiply the distance and the turn of all steps that are remembered by these factors, from the first on."""
        space, n, dof = self._space, self._space.dimensions, self._space.dof
        group, by = space.group, [factors[0]] * n + [factors[1]] * (dof - n)
        before, samples = self._samples, self._samples[:1]
        for a, b in pairwise(before):
            step = group.exp(tuple(f * x for f, x in zip(by, group.log(group.between(a.pose, b.pose)), strict=True)))
            pose = space.normalized(tuple(map(float, group.compose(samples[-1].pose, step))))
            samples.append(replace(b, pose=pose))
        self._samples = samples

    def remembers(self, stamp_ns: int) -> bool:
        """Return whether a stamp is as late as what is remembered."""
        return bool(self._samples) and stamp_ns >= self._samples[0].stamp_ns

    def since_s(self, stamp_ns: int) -> float:
        """Seconds from the last step to a stamp."""
        return (stamp_ns - self._samples[-1].stamp_ns) * 1e-9 if self._samples else 0.0

    def at(self, stamp_ns: int) -> Reckoned:
        """Dead reckoning at a stamp, interpolated between two odometry messages."""
        k = bisect_right(self._samples, stamp_ns, key=lambda one: one.stamp_ns) - 1
        if k < 0:
            return self._samples[0]
        a = self._samples[k]
        if a.stamp_ns == stamp_ns or k + 1 == len(self._samples):
            return a
        b = self._samples[k + 1]
        part = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        sums = [u + part * (v - u) for u, v in ((a.turned, b.turned), (a.way, b.way), (a.moving_s, b.moving_s))]
        pose = tuple(map(float, self._space.group.interpolate(a.pose, b.pose, part)))
        return Reckoned(stamp_ns, pose, sums[0], sums[1], sums[2], a.segment if part < 1.0 else b.segment)

    def nearby(self, stamp_ns: int) -> Array:
        """Motions (S, dof) from the pose at a stamp to those at ``NEARBY_S`` from it, as way and rotation vector."""
        space, here = self._space, self.at(stamp_ns).pose
        there = [self.at(stamp_ns + round(1e9 * after_s)).pose for after_s in NEARBY_S.tolist()]
        moved = [tuple(map(float, space.group.between(here, pose))) for pose in there]
        return np.array([[*one[: space.dimensions], *turn_of(space, one)] for one in moved])


@dataclass(frozen=True, slots=True)
class Motion:
    """The motion between two scans.

    Attributes
    ----------
    way : (n,) in the frame of the earlier one
    turn : (1,) or (3,) rotation vector
    covariance : (dof, dof), of way and turn
    moving_s : for so long the robot moved
    is_broken : whether odometry jumped in between
    """

    way: Array
    turn: Array
    covariance: Array
    moving_s: float
    is_broken: bool

    def rescaled(self, factors: tuple[float, float]) -> "Motion":
        """The motion with its distance and turn multiplied."""
        way = factors[0] * rotation(0.5 * (factors[1] - 1.0) * self.turn) @ self.way
        return replace(self, way=way, turn=factors[1] * self.turn)


def rescaled_nearby(space: Geometry, nearby: Array, factors: tuple[float, float]) -> Array:
    """Motions (S, dof) as of ``DeadReckoning.nearby``, their distance and turn multiplied."""
    n = space.dimensions
    way, turn = nearby[:, :n], nearby[:, n:]
    way = factors[0] * (rotation(0.5 * (factors[1] - 1.0) * turn) @ way[..., None])[..., 0]
    return np.concatenate([way, factors[1] * turn], axis=1)


def interpolated_nearby(nearby: Array, at_s: Array) -> tuple[Array, Array]:
    """Motions (m, dof) at times relative to the stamps, from those (m, S, dof) at ``NEARBY_S``, and their rates.

    Beyond these times the motion goes on as at the end.
    """
    k = np.clip(np.searchsorted(NEARBY_S, at_s, side="right") - 1, 0, len(NEARBY_S) - 2)
    rows = np.arange(len(k))
    before, after = nearby[rows, k], nearby[rows, k + 1]
    rate = (after - before) / (NEARBY_S[k + 1] - NEARBY_S[k])[:, None]
    return before + (at_s - NEARBY_S[k])[:, None] * rate, rate


def motion_between(space: Geometry, noise: OdometryConfig, a: Reckoned, b: Reckoned, jump: Array) -> Motion:
    """The motion from one instant to another.

    Parameters
    ----------
    jump : (dof, dof) covariance added where odometry jumped
    """
    n, dof = space.dimensions, space.dof
    moved = tuple(map(float, space.group.between(a.pose, b.pose)))
    way = np.array(moved[:n])
    turned, far, moving_s = b.turned - a.turned, b.way - a.way, max(b.moving_s - a.moving_s, 1e-3)
    own = np.empty(dof)
    own[n:] = noise.turn_per_rad * turned + noise.turn_per_m * far + noise.turn_per_s * moving_s
    own[0] = noise.way_per_m * far + noise.way_per_s * moving_s
    own[1:n] = 0.25 * own[0]
    j = np.eye(dof)
    j[:n, n:] = 0.5 * lever(way)
    covariance = j @ np.diag(own) @ j.T + 1e-9 * np.eye(dof)
    is_broken = a.segment != b.segment
    return Motion(way, turn_of(space, moved), covariance + jump if is_broken else covariance, moving_s, is_broken)


@dataclass(frozen=True, slots=True)
class Seen:
    """A sighting without id: its input, and the robot's pose."""

    topic: str
    sighting: Sighting
    where: PoseAtStamp

    def shared_by(self, count: int) -> "Seen":
        """The sighting as one of several with the same error: together they count as one."""
        covariance = tuple(count * c for c in self.sighting.covariance)
        return replace(self, sighting=replace(self.sighting, covariance=covariance))


@dataclass(frozen=True, slots=True)
class Cluster:
    """Sightings of one landmark: its position relative to the scan, with covariance (n, n).

    ``sort`` is the class of the landmark, empty where none of them has one.
    """

    point: Array
    covariance: Array
    seen: tuple[Seen, ...]
    sort: str = ""


@dataclass(frozen=True, slots=True)
class Scan:
    """Clusters seen at one instant; ``where`` is the pose of its middle sighting."""

    at: Reckoned
    where: PoseAtStamp
    clusters: tuple[Cluster, ...]

    @property
    def points(self) -> Array:
        """The clusters' points (k, n) in the base frame."""
        return np.array([one.point for one in self.clusters])


def _sighted_point(space: Geometry, s: Sighting) -> tuple[Array, Array]:
    """Return the observed point (n,) in the base frame, and its covariance (n, n)."""
    n, own = space.dimensions, motion_compensation.as_matrix(s.covariance)
    if s.kind == "range_bearing":
        T_base_sensor = s.T_base_sensor or space.identity
        point = tuple(motion_compensation.point_of(space, s.measured).tolist())
        to_base = space.turn(T_base_sensor) @ motion_compensation.polar_derivative(space, s.measured)
        point, own = tuple(map(float, space.group.act(T_base_sensor, point))), to_base @ own @ to_base.T
    else:
        point = s.measured[:n]
        own = space.in_parent_axes(s.measured, own)[:n, :n] if s.kind == "pose" else own
    rounding = motion_compensation.ROUNDING * (float(np.trace(own)) + sum(x * x for x in point))
    return np.array(point), own + rounding * np.eye(n)


def _with_extent(space: Geometry, s: Sighting, sigma_m: float) -> Sighting:
    """Return a sighting with a covariance that includes where on its landmark it is seen."""
    n, covariance = space.dimensions, motion_compensation.as_matrix(s.covariance)
    axes = np.eye(n)
    if s.kind == "range_bearing":
        axes = motion_compensation.gradient(space, s.kind, motion_compensation.point_of(space, s.measured))
    covariance[:n, :n] += sigma_m**2 * axes @ axes.T
    return replace(s, covariance=tuple(covariance.ravel().tolist()))


@dataclass(frozen=True, slots=True)
class _Glimpse:
    at: Reckoned
    point: Array
    covariance: Array
    seen: Seen

    @property
    def sort(self) -> str:
        return self.seen.sighting.sort


class ScanBuilder:
    """Collects sightings until a scan is full. Stamps alone decide that, never arrival times.

    Parameters
    ----------
    sigma_m : of where on a landmark it is seen
    added_m : of errors that messages do not contain
    """

    def __init__(self, space: Geometry, sigma_m: float, added_m: float) -> None:
        self._space, self._sigma_m = space, sigma_m
        self._extent = max(added_m**2 + sigma_m**2, LEAST_M2) * np.eye(space.dimensions)
        self._glimpses: list[_Glimpse] = []

    @property
    def began_ns(self) -> int | None:
        """Stamp of the first sighting; None if there is none."""
        return self._glimpses[0].at.stamp_ns if self._glimpses else None

    def is_full(self, at: Reckoned) -> bool:
        """Return whether a sighting at this instant belongs to another scan."""
        if not self._glimpses:
            return False
        first = self._glimpses[0].at
        is_over = at.stamp_ns - first.stamp_ns >= SCAN_NS or at.turned - first.turned >= _SCAN_RAD
        return is_over or at.segment != first.segment

    @property
    def oldest_keyframe(self) -> int | None:
        """The number of the oldest keyframe that something was seen from; None if nothing was."""
        return min((one.seen.where.keyframe for one in self._glimpses), default=None)

    def reckon_anew(self, at: Callable[[int], Reckoned]) -> None:
        """Take over dead reckoning that was corrected."""
        self._glimpses = [replace(one, at=at(one.at.stamp_ns)) for one in self._glimpses]

    def add(self, at: Reckoned, topic: str, s: Sighting, where: PoseAtStamp) -> None:
        """Add a sighting."""
        point, covariance = _sighted_point(self._space, s)
        whole = _with_extent(self._space, s, self._sigma_m)
        self._glimpses.append(_Glimpse(at, point, covariance, Seen(topic, whole, where)))

    def close(self) -> Scan | None:
        """End the scan and begin another. Returns it; None if nothing was seen."""
        glimpses, self._glimpses = sorted(self._glimpses, key=lambda one: one.at.stamp_ns), []
        if not glimpses:
            return None
        middle = glimpses[(len(glimpses) - 1) // 2]
        carried = [self._carried(one, middle.at) for one in glimpses]
        points, covariances = [point for point, _ in carried], [c + self._extent for _, c in carried]
        groups = _clustered(points, covariances, glimpses)
        clusters = []
        for members in groups:
            point = np.mean([carried[k][0] for k in members], axis=0)
            covariance = np.mean([carried[k][1] for k in members], axis=0) + self._extent
            seen = tuple(glimpses[k].seen.shared_by(len(members)) for k in members)
            sort = next((glimpses[k].sort for k in members if glimpses[k].sort), "")
            clusters.append(Cluster(point, covariance, seen, sort))
        return Scan(middle.at, middle.seen.where, tuple(clusters))

    def _carried(self, one: _Glimpse, at: Reckoned) -> tuple[Array, Array]:
        moved = tuple(map(float, self._space.group.between(at.pose, one.at.pose)))
        turn = self._space.turn(moved)
        return turn @ one.point + np.array(moved[: self._space.dimensions]), turn @ one.covariance @ turn.T


def _clustered(points: Sequence[Array], covariances: Sequence[Array], glimpses: Sequence[_Glimpse]) -> list[list[int]]:
    """Indices of the sightings of each landmark. Those of one message are of one landmark only if they are close."""
    groups: list[list[int]] = []
    means: list[Array] = []
    limit = quantile(_SAME, len(points[0]))
    for k, point in enumerate(points):
        best, least = -1, limit
        for at, (group, mean) in enumerate(zip(groups, means, strict=True)):
            first = group[0]
            away = point - mean
            # nearer they may be one: two poles of a group, or one of them seen twice
            is_far = float(np.linalg.norm(away)) > FIT_M
            is_other = bool(glimpses[k].sort) and any(glimpses[i].sort not in ("", glimpses[k].sort) for i in group)
            if is_other or (is_far and _same_message(glimpses, group, k)):
                continue
            chi2 = float(away @ np.linalg.solve(covariances[k] + covariances[first], away))
            if chi2 < least:
                best, least = at, chi2
        if best < 0:
            groups.append([k])
            means.append(point)
        else:
            groups[best].append(k)
            means[best] = np.mean([points[i] for i in groups[best]], axis=0)
    return groups


def _same_message(glimpses: Sequence[_Glimpse], group: Sequence[int], k: int) -> bool:
    one = glimpses[k]
    return any(glimpses[i].at.stamp_ns == one.at.stamp_ns and glimpses[i].seen.topic == one.seen.topic for i in group)


def are_others(a: Any, b: Any) -> Mask:
    """Return whether two sorts differ, elementwise; one that is not known differs from none."""
    return np.asarray((a != b) & (a != "") & (b != ""))
