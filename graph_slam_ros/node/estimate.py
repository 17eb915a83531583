"""The estimate that the worker's thread publishes to the other threads."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Message

from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.findings.table import explain
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.types import Odometry, check_space, from_record
from graph_slam_ros.recordings.mcap_records import records
from graph_slam_ros.runs.journal import CORRECTION, parts_of
from graph_slam_ros.runs.outcome import VISITS, condensed_text, contradicted, of_map
from graph_slam_ros.runs.tables import accepted_lately, condensed_part
from graph_slam_ros.slam import Config, GraphSlam, MapView
from graph_slam_ros.slam.solution import Correction
from graph_slam_ros.slam.weak_direction import WeakDirection, position_covariance, weakest_position, weakest_turn
from graph_slam_ros.typing import Numbers

OFF = "off, not corrected, in the covariances"
_IN_TURN = 4  # landmarks whose covariance is computed anew at an update
_FEWEST_JUDGED = 20  # edges of an input: of fewer nothing is said


@dataclass(frozen=True, slots=True)
class UnseenWay:
    """The distance driven since a landmark was last seen."""

    keyframes: int  # that are counted already
    changes: int  # of landmarks, that are
    length_m: float = 0.0  # by odometry, from keyframe to keyframe
    since_ns: int = 0  # stamp of the keyframe at which it began; 0 before the first
    direction: Numbers = ()  # of the last keyframe from the one before, in odometry's frame

    def goes_on(self, view: MapView) -> "UnseenWay":
        """Return the distance after an update."""
        count, changes = len(view.keyframes), view.landmark_changes
        since = max(self.keyframes - 1 - view.keyframes.first, 0)
        positions = view.keyframes.poses[since:, : view.space.dimensions]
        steps = np.diff(positions, axis=0)
        length_m, direction = self.length_m, self.direction
        if len(steps) and view.segments[-1] < self.keyframes:  # a jump of odometry is no way
            length_m += float(np.linalg.norm(steps, axis=1).sum())
            direction = tuple(steps[-1].tolist())
        since_ns = self.since_ns if changes == self.changes and self.since_ns else view.keyframes[-1].stamp_ns
        return UnseenWay(count, changes, length_m if changes == self.changes else 0.0, since_ns, direction)


class WeakestLandmark:
    """The landmark that is known least. A few covariances are computed anew at each update, in turn."""

    def __init__(self) -> None:
        self._found: dict[str, WeakDirection] = {}
        self._next = 0

    def goes_on(self, view: MapView) -> str:
        """Return the weakest landmark after an update, in words; empty where none is known."""
        names = list(view.landmarks)
        if not names or not view.is_solved:
            return ""
        self._found = {name: one for name, one in self._found.items() if name in view.landmarks}
        turn = [names[(self._next + k) % len(names)] for k in range(min(_IN_TURN, len(names)))]
        self._next = (self._next + len(turn)) % len(names)
        chosen = list(dict.fromkeys([*([self._name] if self._found else []), *turn]))
        for name, covariance in zip(chosen, view.landmark_covariances(chosen), strict=True):
            if np.isfinite(covariance).all():
                value = tuple(view.solver.estimate([view.landmarks[name].vertex])[0].tolist())
                self._found[name] = weakest_position(position_covariance(view.space, value, covariance))
        if not self._found:
            return ""
        return f"landmark {self._name} {self._found[self._name].sigma:.3f} m {self._found[self._name].words}"

    @property
    def _name(self) -> str:
        return max(self._found, key=lambda name: self._found[name].sigma, default="")


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """The state of the pipeline after an update, for threads that cannot wait for the next one.

    Attributes
    ----------
    T_odom_keyframe, covariance, stamp_ns : odometry's pose, tangent covariance and stamp of the newest keyframe
    is_confirmed : whether the robot knows where it is in a map that was loaded
    is_resumed : whether a drive that was cut off goes on by odometry alone: nothing was recognised since
    is_lost : whether that is so since odometry jumped
    fit : chi2 per degree of freedom; NaN before it was looked at
    doubted : inputs of which most measurements are not believed lately, and ids that are all new from some time on
    findings : what else is wrong with the map and its motion
    weakest_landmark, condensed, gyro, calibration : in words; empty where there is nothing to say
    """

    T_map_odom: Numbers
    T_odom_keyframe: Numbers
    covariance: Any
    stamp_ns: int
    source: str
    is_confirmed: bool
    keyframes: int
    landmarks: int
    edges: int
    segments: int
    solves: int
    correction: Correction
    solve_s: float
    slowest_solve_s: float
    fit: float
    unseen: UnseenWay
    doubted: tuple[Finding, ...] = ()
    findings: tuple[Finding, ...] = ()
    weakest_landmark: str = ""
    condensed: str = ""
    gyro: str = ""
    is_resumed: bool = False
    is_lost: bool = False
    calibration: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_located(self) -> bool:
        """Return whether pose and ``map -> odom`` may be published."""
        return self.is_confirmed or self.is_resumed

    def weakest(self, space: Geometry) -> dict[str, str]:
        """The weakest direction of the newest keyframe's position and orientation, and of all landmarks, in words."""
        pose = space.group.compose(self.T_map_odom, self.T_odom_keyframe)
        path = space.turn(self.T_map_odom) @ np.array(self.unseen.direction) if self.unseen.direction else None
        position = weakest_position(position_covariance(space, pose, self.covariance), path)
        turn = weakest_turn(space, pose, self.covariance)
        return {
            "position": f"{position.sigma:.3f} m {position.words}",
            "orientation": f"{np.degrees(turn.sigma):.2f} deg {turn.words}",
        } | ({"landmark": self.weakest_landmark} if self.weakest_landmark else {})


def estimate_of(slam: GraphSlam, **known: Any) -> Estimate:
    """Return the estimate of a pipeline that has keyframes, with the attributes that only the node knows."""
    view, newest = slam.view, slam.view.keyframes[-1]
    return Estimate(
        T_map_odom=view.T_map_odom,
        T_odom_keyframe=newest.T_odom_base,
        covariance=view.pose_covariance,
        stamp_ns=newest.stamp_ns,
        source=view.odometry_source,
        keyframes=len(view.keyframes),
        landmarks=len(view.landmarks),
        edges=view.graph.edge_count,
        segments=len(view.segments),
        solves=view.solves,
        findings=tuple(_found(slam)),
        condensed=condensed_text(condensed_part(view)),
        gyro=str(view.gyro or ""),
        calibration={f"corrected {name}": str(value) for name, value in view.corrections.lines().items()}
        | ({OFF: ", ".join(off)} if (off := view.trials.contradicted()) else {}),
        **known,
    )


def _found(slam: GraphSlam) -> Iterator[Finding]:
    """Yield that the robot is elsewhere, what the end of a run would say, too, and that odometry stands."""
    view = slam.view
    if view.displaced:
        yield Finding("elsewhere", "error", text=str(view.displaced), follows=("contradicted", "ids_renewed"))
    yield from of_map(
        {
            "uncorrected": [one.as_dict() for one in view.trials.uncorrected_so_far()],
            "gyro": view.gyro and asdict(view.gyro),
            "association": view.association_report,
            "rivals": [asdict(one) for one in view.backend.rivals],
            "landmarks": len(view.landmarks),
            "waiting": view.waiting,
            "counters": {"map": {name: slam.counters["map", name] for name in VISITS}},
        }
    )
    if view.odometry_is_frozen:
        name = view.odometry_source
        yield Finding("frozen", "error", text=f"{name}: {explain('frozen').meaning}", source=name)


def doubted_lately(view: MapView) -> tuple[Finding, ...]:
    """Return of which inputs most measurements are not believed lately, and that ids are new."""
    lately = ((name, *of) for name, of in accepted_lately(view).items() if of[1] >= _FEWEST_JUDGED)
    found = (one for of in lately for one in contradicted(*of))
    return (*(one for one in found if one.severity == "error"), *of_map({"renewed_ids": view.renewed_ids()}))


class Resumption:
    """Compares the odometry before a restart with the first after it: the last correction counts if it goes on."""

    def __init__(self, config: Config, T_map_odom: Numbers, odometry: Sequence[Odometry]) -> None:
        self.T_map_odom = T_map_odom
        self._is_on: bool | None = None
        self._space, self._fastest_m_s, self._last = config.space, config.odometry.max_speed_m_s, odometry

    @classmethod
    def of(cls, run: Path, config: Config) -> "Resumption | None":
        """Read the last correction, and the odometry around it, at the end of a run's journal; None without one."""
        for file in reversed(parts_of(run)):
            last_bytes = _TAIL_BYTES
            while last_bytes < 8 * max(file.stat().st_size, _TAIL_BYTES):
                ending = records(file, [], follow=False, last_bytes=last_bytes)
                read = [json.loads(one.data) for one in ending if isinstance(one, Message)]
                if corrections := [one for one in read if one["type"] == CORRECTION]:
                    last, of = corrections[-1], ("odometry", corrections[-1]["source"])
                    odometry = [from_record(one) for one in read if (one["type"], one.get("source")) == of]
                    if odometry and isinstance(odometry[-1], Odometry):
                        now = replace(odometry[-1], T_odom_base=last["T_map_odom"])  # checked as any pose is
                        check_space(now, config.space.dimensions)
                        return cls(config, now.T_odom_base, [one for one in odometry if isinstance(one, Odometry)])
                last_bytes *= 8
        return None

    def goes_on(self, stamp_ns: int, T_odom_base: Numbers, source: str) -> bool:
        """Return whether odometry continues: the first one after the restart decides."""
        if self._is_on is None:
            self._is_on = self._is_continuous(stamp_ns, T_odom_base, source)
        return self._is_on

    def _is_continuous(self, stamp_ns: int, T_odom_base: Numbers, source: str) -> bool:
        last, n = self._last[-1], self._space.dimensions
        since_s = (stamp_ns - last.stamp_ns) * 1e-9
        is_same = source.partition("#")[0] == last.source.partition("#")[0]  # publishers are numbered anew
        if not is_same or not 0.0 < since_s <= _LONGEST_S:
            return False
        moved = self._space.group.between(last.T_odom_base, T_odom_base)
        far_m = math.hypot(*moved[:n])
        if far_m > self._fastest_m_s * since_s:
            return False
        way_m = sum(math.dist(a.T_odom_base[:n], b.T_odom_base[:n]) for a, b in pairwise(self._last))
        usual_m = way_m / max((last.stamp_ns - self._last[0].stamp_ns) * 1e-9, _LEAST_S) * since_s
        far, from_begin = self._size(moved), self._size(T_odom_base)
        is_as_fast = _LEAST * usual_m <= far_m <= _MOST * usual_m and from_begin > _NEAR
        return is_as_fast or far <= _NEAR or from_begin >= far  # or it has begun anew, if nearer to its origin

    def _size(self, pose: Numbers) -> float:
        """The distance of a pose from the identity. A metre counts as much as a radian."""
        return math.hypot(*pose[: self._space.dimensions]) + self._space.angle(pose)


_LEAST_S, _LONGEST_S = 1e-3, 60.0  # without odometry: after more, the robot may have been carried
_TAIL_BYTES = 2**16  # some seconds of a robot's journal
_LEAST, _MOST = 0.3, 1.2  # times the way at the speed before: so far it has driven since
_NEAR = 0.1  # m and rad: an odometry that begins anew so close to where it was does no harm
