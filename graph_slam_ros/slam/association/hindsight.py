"""Explains all scans at once, in the background on a copy. The result is used at a fixed later keyframe.

The scans are solved in stages, from the graph's assignment on the present path. Then moves correct the association. The
result does not depend on when the work is done.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.config import Config
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.association.beam import NOTHING, BeamSettings, Ids
from graph_slam_ros.slam.association.belief import SolverBelief
from graph_slam_ros.slam.association.explanation import SCALES, UNUSED, Costs, Drive, Estimate
from graph_slam_ros.slam.association.moves import LEAST_SCANS, refined, without_few
from graph_slam_ros.slam.association.presence_check import NOTHING_SEEN, Presence, presence
from graph_slam_ros.slam.association.scans import Cluster, Motion, Scan
from graph_slam_ros.slam.association.stretches import laid_on_the_map
from graph_slam_ros.slam.background import Background, Work
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.landmarks.rotations import matrices_of, poses_of
from graph_slam_ros.slam.levels import ROUNDING
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Executor

_APART_NS = 100_000_000_000  # between scans that stand for the map: no stretch of the drive has two of them
_LEAST_M2 = 1e-6  # variance of their landmarks
_FIRST, _MORE = 100, 2.0  # scans at the first time; then times as many
_AMBIGUITY_CHI2 = 6.0  # by which every alternative is worse where a stretch is laid on others: likelier by e^3
_GATE_OTHER = 0.99999  # an observation outside this probability of every landmark is not used
_LEAST_LANDMARK = 1.0  # chi2: a landmark costs something, however dense they are
_SURE = 0.015  # standard deviation of a scale of odometry below which a part of a drive corrects it
_SCALE_SIGMA = 0.02  # of odometry's scales, once they were found
_MOST_SCANS = 1000  # of a drive that is explained as if it had not been displaced, too
_DISPLACED = 2.0 * float(np.log(1e4))  # minus twice the log of how probable it is that a robot is moved in a drive


@dataclass(frozen=True, slots=True)
class FrozenScans:
    """The input of an explanation: copies of the scans and of the present assignment.

    Attributes
    ----------
    poses : (N, 3) or (N, 7) of the scans, by the solver
    given : (M,) the number of each cluster's landmark
    nearby : (N, S, dof) how the robot moved around each scan, by odometry
    of_map : the first so many scans stand for the map (``after_map``); clusters_of_map : theirs
    times : (M,) how often the robot has seen what a cluster stands for; empty: once each
    displaced : keyframes at which the robot is thought to have been moved, by their vertices
    undisplaced : the motions as if it had not been; empty: it was nowhere
    """

    scans: tuple[Scan, ...]
    motions: tuple[Motion, ...]
    nearby: Array
    poses: Array
    scales: Array
    given: Ids
    of_map: int = 0
    clusters_of_map: int = 0
    times: Array = field(default_factory=lambda: np.empty(0))
    displaced: frozenset[int] = frozenset()
    undisplaced: tuple[Motion, ...] = ()

    @property
    def count(self) -> int:
        """The number of scans of the robot."""
        return len(self.scans) - self.of_map

    def after_map(self, belief: SolverBelief, known: Mapping[int, Landmark]) -> "FrozenScans":
        """Put scans before these that stand for landmarks of the map whose sightings are final.

        They see these from the pose of the first scan. Together they know as much of their places, relative to that
        pose, as the solver does.

        Parameters
        ----------
        known : the landmarks, by number

        Raises
        ------
        GraphSlamError
            The solver has no covariance.
        """
        if not known or not self.scans:
            return self
        first, marks, count, dof = self.scans[0], list(known.values()), LEAST_SCANS, self.nearby.shape[-1]
        points, covariances = belief.seen_from(first, [mark.name for mark in marks])
        n = points.shape[1]
        clusters = tuple(
            Cluster(point, count * (covariance + _LEAST_M2 * np.eye(n)), (), mark.sort)
            for mark, point, covariance in zip(marks, points, covariances, strict=True)
        )
        still = Motion(np.zeros(n), np.zeros(dof - n), ROUNDING * np.eye(dof), 1e-3, is_broken=False)
        stamps_ns = [first.at.stamp_ns - k * _APART_NS for k in range(count, 0, -1)]
        before = np.array([mark.sightings - len(mark.seen) for mark in marks])
        return replace(
            self,
            scans=(*(Scan(replace(first.at, stamp_ns=at), first.where, clusters) for at in stamps_ns), *self.scans),
            motions=(still,) * count + self.motions,
            nearby=np.concatenate([np.zeros((count, *self.nearby.shape[1:])), self.nearby]),
            poses=np.concatenate([np.tile(self.poses[:1], (count, 1)), self.poses]),
            given=np.concatenate([np.tile(list(known), count), self.given]),
            of_map=count,
            clusters_of_map=count * len(known),
            times=np.concatenate([np.tile(before / count, count), np.ones(len(self.given))]),
        )


@dataclass(frozen=True, slots=True)
class Found:
    """An explanation of frozen scans; ``undecided`` stretches fit several places.

    Attributes
    ----------
    is_whole : whether all moves were tried
    scales : of odometry, by name, with standard deviations
    clocks : of each input the correction of its stamps [s], and its standard deviation
    presence : which landmarks in view were seen
    rejoined : keyframes at which the robot was not moved after all, by their vertices
    """

    frozen: FrozenScans
    estimate: Estimate
    undecided: int = 0
    is_whole: bool = True
    scales: dict[str, tuple[float, float]] = field(default_factory=dict)
    clocks: dict[str, tuple[float, float]] = field(default_factory=dict)
    presence: Presence = NOTHING_SEEN
    rejoined: frozenset[int] = frozenset()

    def numbers(self, given: Mapping[int, int], fresh: Callable[[], int]) -> Ids:
        """The number of each landmark: that of the map or of most of its clusters, each used once, or a fresh one."""
        which, of_map = self.estimate.which, self.frozen.clusters_of_map
        before = np.concatenate([self.frozen.given[:of_map], np.array(list(given.values()))[: len(which) - of_map]])
        both = np.stack([which, before])[:, which >= 0]
        pairs, of = np.unique(both, axis=1, return_inverse=True)
        sizes = np.bincount(of.ravel(), np.where(np.arange(len(which)) < of_map, len(which), 1)[which >= 0])
        out, used = np.full(len(self.estimate.landmarks), NOTHING), {NOTHING}
        for landmark, number in pairs[:, np.argsort(-sizes, kind="stable")].T.tolist():
            if out[landmark] == NOTHING and number not in used:
                out[landmark] = number
                used.add(number)
        for landmark in np.flatnonzero(out == NOTHING).tolist():
            out[landmark] = fresh()
        return out

    def changes(self, given: Mapping[int, int], numbers: Ids) -> tuple[dict[int, int], dict[int, int]]:
        """The new landmark of each changed cluster, later clusters included, and the successor of each removed one."""
        which, before = self.estimate.which[self.frozen.clusters_of_map :], np.array(list(given.values()))
        after, frozen = before.copy(), before[: len(which)]
        of_none = np.where(np.isin(frozen, _indices(frozen)[0]), NOTHING, frozen)
        after[: len(which)] = np.where(which >= 0, numbers[which], of_none)
        now, since = after[: len(which)], np.arange(len(before)) >= len(which)
        gone: dict[int, int] = {}
        for landmark in np.setdiff1d(frozen, np.append(now, NOTHING)).tolist():
            names, counts = np.unique(now[frozen == landmark], return_counts=True)
            gone[landmark] = int(names[counts.argmax()])
            after[since & (before == landmark)] = gone[landmark]
        is_other = after != before
        return dict(zip(np.array(list(given))[is_other].tolist(), after[is_other].tolist(), strict=True)), gone

    def carried_to(self, space: Geometry, solver: Solver, keyframes: StampedPoses[Keyframe]) -> Array:
        """Stored numbers with the keyframes moved to this explanation. Keyframes between scans are interpolated."""
        group, values = space.group, solver.values
        n, scans = space.dimensions, self.frozen.scans
        found = tuple(poses_of(space, self.estimate.position, self.estimate.turn).T)
        correction = np.stack(group.compose(found, group.inverse(tuple(self.frozen.poses.T))), axis=-1)
        at = np.array([scan.where.keyframe for scan in scans]) - keyframes.first
        at, last = np.unique(at[::-1], return_index=True)
        correction = correction[::-1][last]
        k = np.arange(len(keyframes.ids))
        after = np.clip(np.searchsorted(at, k), 0, len(at) - 1)
        before = np.clip(np.searchsorted(at, k, side="right") - 1, 0, len(at) - 1)
        stamps = keyframes.stamps_ns
        part = (stamps - stamps[at[before]]) / np.maximum(stamps[at[after]] - stamps[at[before]], 1)
        poses = tuple(solver.estimate(keyframes.ids).T)
        a, b = (group.compose(tuple(correction[side].T), poses) for side in (before, after))
        way = group.local(a, b)
        moved = np.stack(group.retract(a, tuple(np.clip(part, 0.0, 1.0) * d for d in way)), axis=-1)
        where = solver.graph.begins(keyframes.ids)[:, None] + np.arange(space.pose.size)
        values[where] = moved if n == 2 else np.hstack([moved[:, :3], _unit(moved[:, 3:])])
        return values


class Hindsight:
    """Explains all scans at once, at growing intervals.

    Attributes
    ----------
    is_on : whether it does
    scales : (2,) of odometry, as last found, and their standard deviation
    found_scales : the same by name, as the last explanation has them, with its standard deviations
    newest : the explanation that was found last
    """

    def __init__(self, config: Config, settings: BeamSettings, executor: Executor, counters: Counters) -> None:
        self._space, self._settings = config.space, settings
        unused = quantile(_GATE_OTHER, config.space.dimensions)
        self._costs = Costs(max(-2.0 * settings.log_new, _LEAST_LANDMARK), unused, _AMBIGUITY_CHI2)
        after = config.robust.apply_after_keyframes
        self._background = Background[Found | None]("second_look", executor, after, counters)
        self._next = _FIRST
        self._explained = 0  # scans of the last explanation that was begun
        self._last: Ids | None = None
        self.is_on = True
        self.scales: tuple[Array, float] = np.zeros(2), settings.scale_sigma
        self.found_scales: dict[str, tuple[float, float]] = {}
        self.newest: Found | None = None

    def is_due(self, scans: int) -> bool:
        """Return whether an explanation is due at this number of scans."""
        return self.is_on and not self._background.is_busy and scans >= self._next

    def start(self, freeze: Callable[[], FrozenScans], keyframes: int) -> None:
        """Start with the present scans."""

        def begun() -> Work[Found | None]:
            frozen = freeze()
            self._next, self._explained = round(_MORE * frozen.count), frozen.count
            return lambda _: explained(self._space, frozen, self._settings, self._costs)

        self._background.begin(begun, keyframes)

    def restart(self) -> None:
        """Drop the explanation in the background, and start another soon: what it began with is wrong."""
        if self._background.is_busy:
            self._background.cancel()
            self._next = 0

    def rescale(self, factors: tuple[float, float]) -> None:
        """Use scales of odometry that was corrected by these factors."""
        self.restart()
        values, sigma = self.scales
        self.scales = (1.0 + values) / np.array(factors) - 1.0, sigma
        for name, factor in zip(SCALES, factors, strict=True):
            if name in self.found_scales:
                value, own = self.found_scales[name]
                self.found_scales[name] = (1.0 + value) / factor - 1.0, own / factor

    def covers(self, scans: int) -> bool:
        """Return whether so many scans were explained, and the result used. If not, that is due."""
        if not self._background.is_busy and self._explained < scans:
            self._next = 0
        return not self._background.is_busy and self._explained >= scans

    @property
    def is_doubtful(self) -> bool:
        """Return whether the last explanation has landmarks where none are seen."""
        return self.newest is not None and self.newest.presence.is_doubtful

    def forget(self, scans: int) -> None:
        """Note that the oldest scans have left."""
        self._next, self._explained, self._last = self._next - scans, self._explained - scans, None

    def outcome(self, keyframes: int) -> Found | None:
        """The explanation that is due at a keyframe. It waits for it."""
        due = self._background.due(keyframes)
        return self._noted(due()) if due is not None else None

    def found(self, freeze: Callable[[], FrozenScans]) -> Found | None:
        """Explain the present scans at once; None if that was done before, or finds nothing."""
        self._background.cancel()
        if not self.is_on:
            return None
        frozen = freeze()
        if self._last is not None and np.array_equal(self._last, frozen.given[frozen.clusters_of_map :]):
            return None
        self._explained = frozen.count
        return self._noted(explained(self._space, frozen, self._settings, self._costs))

    def note(self, given: Mapping[int, int]) -> None:
        """Note that everything was explained, and the landmark of each cluster."""
        self._last = np.array(list(given.values()))

    @property
    def report(self) -> dict[str, Any]:
        """The report on the last explanation: how many scans, whether moves are left, undecided stretches, clocks."""
        if self.newest is None:
            return {}
        return {
            "scans": self.newest.frozen.count,
            "is_whole": self.newest.is_whole,
            "undecided": self.newest.undecided,
            "missing_part": self.newest.presence.missing_part,
            "lost_part": self.newest.presence.lost_part,
            "is_doubtful": self.newest.presence.is_doubtful,
            "clocks": {topic: {"value": c, "sigma": sigma} for topic, (c, sigma) in self.newest.clocks.items()},
        }

    def _noted(self, found: Found | None) -> Found | None:
        if found is not None:
            self.scales, self.newest = (found.estimate.scales, _SCALE_SIGMA), found
            scales = {} if found.presence.is_doubtful else dict(found.scales)
            if found.frozen.of_map:  # a part of the drive has few passes, whose errors are alike
                scales = {name: one for name, one in scales.items() if one[1] < _SURE} or self.found_scales
            self.found_scales = scales
        return found


def explained(space: Geometry, frozen: FrozenScans, settings: BeamSettings, costs: Costs) -> Found | None:
    """Explain all scans, from the graph's assignment on the present path; None if too little was seen.

    Where the robot was moved, it is done once more as if it had not been. The larger evidence decides.
    """
    drive = _drive(frozen, settings, costs)
    best = _given(space, drive, frozen)
    if best is None or not frozen.undisplaced or frozen.of_map or frozen.count > _MOST_SCANS:
        return best
    whole = replace(frozen, motions=frozen.undisplaced)
    drive_whole = _drive(whole, settings, costs)
    if (found := _given(space, drive_whole, whole)) is None:
        return best
    worth = _log_volume(frozen.motions) - _log_volume(whole.motions) + _DISPLACED * len(frozen.displaced)
    is_better = drive_whole.total(found.estimate) < drive.total(best.estimate) + worth
    return replace(found, rejoined=frozen.displaced) if is_better else best


def _drive(frozen: FrozenScans, settings: BeamSettings, costs: Costs) -> Drive:
    return Drive(frozen.scans, frozen.motions, frozen.nearby, settings, costs, frozen.times)


def _log_volume(motions: Sequence[Motion]) -> float:
    return float(np.linalg.slogdet(np.array([motion.covariance for motion in motions]))[1].sum())


def _given(space: Geometry, drive: Drive, frozen: FrozenScans) -> Found | None:
    """Explain all scans, from the graph's assignment on the present path; None if too little was seen."""
    numbers, which = _indices(frozen.given)
    if not len(numbers):
        return None
    no_landmarks, clocks = np.empty((0, drive.n)), np.zeros(len(drive.topics))
    start = Estimate(*matrices_of(space, frozen.poses), no_landmarks, frozen.scales, clocks, which)
    staged = drive.staged(start)
    drive.begin_moves()
    return _laid(drive, Found(frozen, refined(drive, staged), is_whole=drive.may_move))


def _laid(drive: Drive, found: Found) -> Found:
    """Lay stretches of an explanation on other landmarks, and say what is known of it."""
    drive.begin_moves()
    estimate, undecided = laid_on_the_map(drive, found.estimate)
    unknowns = drive.named(estimate)
    return replace(
        found,
        estimate=estimate,
        undecided=undecided,
        is_whole=found.is_whole and drive.may_move,
        scales={name: one for name, one in unknowns.items() if name in SCALES},
        clocks={name: one for name, one in unknowns.items() if name not in SCALES},
        presence=presence(drive, estimate, found.frozen.of_map),
    )


def _indices(given: Ids) -> tuple[Ids, Ids]:
    """Numbers of the landmarks that were seen often enough, and the index among them for each cluster."""
    numbers, indices = np.unique(given, return_inverse=True)
    which = without_few(np.where(given == NOTHING, UNUSED, indices))
    used = np.unique(which[which >= 0])
    index = np.full(len(numbers) + 1, UNUSED)
    index[used] = np.arange(len(used))
    return numbers[used], index[which]


def _unit(quaternions: Array) -> Array:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
