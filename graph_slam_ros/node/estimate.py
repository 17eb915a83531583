"""The estimate that the worker's thread publishes to the other threads."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.reasons import explain, remedy
from graph_slam_ros.runs.outcome import (
    VISITS,
    ambiguities,
    association_faults,
    condensed_text,
    contradicts,
    renewed_text,
    visit_faults,
)
from graph_slam_ros.runs.tables import accepted_lately, condensed_part
from graph_slam_ros.runs.undetermined import wrong_sides
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.slam.calibration.uncorrected import Uncorrected
from graph_slam_ros.slam.solution import Correction
from graph_slam_ros.slam.weak_direction import WeakDirection, position_covariance, weakest_position, weakest_turn
from graph_slam_ros.typing import Numbers

OFF = "off, not corrected, in the covariances"
_IN_TURN = 4  # landmarks whose covariance is computed anew at an update
_FEWEST_JUDGED = 20  # edges of an input: of fewer nothing is said


@dataclass(frozen=True, slots=True)
class UnseenWay:
    """The distance driven since a landmark was last seen.

    Attributes
    ----------
    keyframes, changes : keyframes, and changes of landmarks, that are counted already
    length_m : by odometry, from keyframe to keyframe
    since_ns : stamp of the keyframe at which it began; 0 before the first
    direction : of the last keyframe from the one before, in odometry's frame
    """

    keyframes: int
    changes: int
    length_m: float = 0.0
    since_ns: int = 0
    direction: Numbers = ()

    def goes_on(self, slam: GraphSlam) -> "UnseenWay":
        """Return the distance after an update."""
        count, changes = len(slam.keyframes), slam.landmark_changes
        since = max(self.keyframes - 1 - slam.first_keyframe, 0)
        positions = slam.keyframes.poses[since:, : slam.space.dimensions]
        steps = np.diff(positions, axis=0)
        length_m, direction = self.length_m, self.direction
        if len(steps) and slam.segments[-1] < self.keyframes:  # a jump of odometry is no way
            length_m += float(np.linalg.norm(steps, axis=1).sum())
            direction = tuple(steps[-1].tolist())
        since_ns = self.since_ns if changes == self.changes and self.since_ns else slam.keyframes[-1].stamp_ns
        return UnseenWay(count, changes, length_m if changes == self.changes else 0.0, since_ns, direction)


class WeakestLandmark:
    """The landmark that is known least. A few covariances are computed anew at each update, in turn."""

    def __init__(self) -> None:
        self._found: dict[str, WeakDirection] = {}
        self._next = 0

    def goes_on(self, slam: GraphSlam) -> str:
        """Return the weakest landmark after an update, in words; empty where none is known."""
        names = list(slam.landmarks)
        if not names or not slam.is_solved:
            return ""
        self._found = {name: one for name, one in self._found.items() if name in slam.landmarks}
        turn = [names[(self._next + k) % len(names)] for k in range(min(_IN_TURN, len(names)))]
        self._next = (self._next + len(turn)) % len(names)
        chosen = list(dict.fromkeys([*filter(None, [self._name]), *turn]))
        for name, covariance in zip(chosen, slam.landmark_covariances(chosen), strict=True):
            if np.isfinite(covariance).all():
                value = tuple(slam.solver.estimate([slam.landmarks[name].vertex])[0].tolist())
                self._found[name] = weakest_position(position_covariance(slam.space, value, covariance))
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
    T_map_odom : the correction; of identity before the first keyframe
    T_odom_keyframe, covariance, stamp_ns : odometry's pose, tangent covariance and stamp of the newest keyframe
    source : the odometry in use
    is_confirmed : whether the robot knows where it is in a map that was loaded
    unseen : the way since a landmark was seen
    weakest_landmark : the landmark that is known least, with its weakest direction; empty where none is known
    fit : chi2 per degree of freedom; NaN before it was looked at
    doubted : inputs of which most measurements are not believed lately, and why that may be, and ids that are all new
        from some time on; empty where nothing is doubted
    ambiguity : other explanations of the same measurements that could not be ruled out; empty where there is none
    displaced : that the landmarks say that the robot is elsewhere than odometry; empty where they do not
    association : why the association of sightings without identity is not to be believed; empty if it is
    condensed : which keyframes were condensed, or why none was in a long drive; empty in a short one
    visits : why a condensed map is worse, or larger, than it should be; empty if it is not
    uncorrected : clocks, mounts and scales that are off and not corrected; empty where none is
    motion : why the gyro, or an odometry, has no part in the motion; empty where all have
    gyro : its state and its bias; empty where no input is one
    calibration : settings of odometry's factors that the association found, and what is off without being corrected
    is_resumed : whether a drive that was cut off goes on by odometry alone: nothing was recognised since
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
    doubted: str = ""
    weakest_landmark: str = ""
    displaced: str = ""
    association: str = ""
    condensed: str = ""
    visits: str = ""
    uncorrected: str = ""
    motion: str = ""
    ambiguity: str = ""
    gyro: str = ""
    is_resumed: bool = False
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

    @classmethod
    def of(
        cls,
        slam: GraphSlam,
        correction: Correction,
        *,
        is_confirmed: bool,
        is_resumed: bool,
        solve_s: float,
        slowest_solve_s: float,
        fit: float,
        doubted: str,
        unseen: UnseenWay,
        weakest_landmark: str = "",
    ) -> "Estimate":
        """Return the estimate of a pipeline that has keyframes; the rest is as of the attributes."""
        newest = slam.keyframes[-1]
        return cls(
            T_map_odom=slam.T_map_odom,
            T_odom_keyframe=newest.T_odom_base,
            covariance=slam.pose_covariance,
            stamp_ns=newest.stamp_ns,
            source=slam.odometry_source,
            is_confirmed=is_confirmed,
            keyframes=len(slam.keyframes),
            landmarks=len(slam.landmarks),
            edges=slam.graph.edge_count,
            segments=len(slam.segments),
            solves=slam.solves,
            correction=correction,
            solve_s=solve_s,
            slowest_solve_s=slowest_solve_s,
            fit=fit,
            doubted=doubted,
            unseen=unseen,
            weakest_landmark=weakest_landmark,
            displaced=str(slam.displaced or ""),
            association="; ".join(association_faults(slam.association_report)),
            condensed=condensed_text(condensed_part(slam)),
            visits="; ".join(visit_faults({name: slam.counters["map", name] for name in VISITS})),
            uncorrected="; ".join(": ".join([str(one), *_settings(one)]) for one in slam.uncorrected_so_far),
            motion="; ".join(filter(None, (_frozen(slam), slam.gyro.fault if slam.gyro else ""))),
            ambiguity=_ambiguity(slam),
            gyro=str(slam.gyro or ""),
            is_resumed=is_resumed,
            calibration=_calibration(slam.found_settings, slam.contradicted),
        )


def _frozen(slam: GraphSlam) -> str:
    name = slam.odometry_source
    return f"{name}: {explain('frozen').meaning}: {remedy(name, 'frozen')}" if slam.odometry_is_frozen else ""


def _ambiguity(slam: GraphSlam) -> str:
    rivals = ambiguities([asdict(one) for one in slam.backend.rivals])
    return "; ".join(filter(None, (*rivals, wrong_sides(len(slam.landmarks), slam.waiting))))


def doubted_lately(slam: GraphSlam) -> str:
    """Say of which inputs most measurements are not believed lately, and of ids that are new; empty where of none."""
    lately = ((name, *of) for name, of in accepted_lately(slam).items() if of[1] >= _FEWEST_JUDGED)
    renewed = [renewed_text(str(one))] if (one := slam.renewed_ids()) else []
    return "; ".join(filter(None, (*(contradicts(*of) for of in lately), *renewed)))


def _settings(one: Uncorrected) -> list[str]:
    return [f"{key}={value}" for key, value in one.as_dict()["settings"].items()]


def _calibration(found: Mapping[str, float], contradicted: Sequence[str]) -> dict[str, str]:
    settings = {f"corrected {name}": str(value) for name, value in found.items()}
    return settings | ({OFF: ", ".join(contradicted)} if contradicted else {})
