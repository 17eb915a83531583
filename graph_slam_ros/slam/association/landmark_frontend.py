"""The front end of landmarks: assigns sightings to landmarks, refuses new ones, reviews sightings without id."""

from dataclasses import replace

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Sightings
from graph_slam_ros.slam.association.anonymous import AnonymousLandmarks
from graph_slam_ros.slam.association.assignments import Assigned
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp, off_the_pole
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.typing import Executor


class LandmarkFrontend:
    """Associates sightings with landmarks.

    Parameters
    ----------
    backend : no new landmark begins while it does not trust sightings
    executor : begins work in the background

    Attributes
    ----------
    map : the landmarks
    anonymous : the association of those without identity
    """

    def __init__(self, config: Config, backend: Backend, counters: Counters, executor: Executor) -> None:
        self._config, self._space = config.landmarks, config.space
        self._backend, self._counters = backend, counters
        self.map = Landmarks(config, backend, counters)
        self.anonymous = AnonymousLandmarks(config, self.map, backend, counters, executor)

    def forget_before(self, keyframe: int) -> None:
        """Forget what has left the graph with the keyframes before a number."""
        self.map.forget_removed()
        self.anonymous.forget_before(keyframe)

    def identified(self, m: Sightings, where: PoseAtStamp) -> list[Assigned]:
        """The sightings that can be used now, each with its landmark. The others are counted."""
        how = self._config.association
        if how == "none":
            self._counters.count(m.topic, "not_used", len(m.sightings))
            return []
        m = replace(m, sightings=tuple(off_the_pole(self._space, s) for s in m.sightings))
        if how != "id":
            return self._passed(self.anonymous.identified(m, where))
        named = [Assigned(m.topic, s.id, s, where) for s in m.sightings if s.id]
        if len(named) < len(m.sightings):
            self._counters.count(m.topic, "no_id", len(m.sightings) - len(named))
        return self._passed(named)

    def travel(self, step: Step) -> list[Assigned]:
        """Add a step of odometry. Returns the sightings of earlier scans that can be used now."""
        return self._passed(self.anonymous.travel(step)) if self.is_anonymous else []

    def end_scan(self) -> list[Assigned]:
        """End the scan. Returns its sightings that can be used."""
        return self._passed(self.anonymous.end_scan())

    @property
    def is_anonymous(self) -> bool:
        """Return whether landmarks are told apart without identities, so that they need each step of odometry."""
        return self._config.association == "joint"

    def _passed(self, named: list[Assigned]) -> list[Assigned]:
        """The sightings that may be used: none begins a landmark in a held map, or while the pose is unknown."""
        if not self.map.begins_new:
            reason = "not_in_map"
        elif not self._backend.trusts_sightings:
            reason = "new_while_elsewhere"
        else:
            return named
        known = self.map.known
        for one in named:
            if one.name not in known:
                self._counters.count(one.topic, reason)
        return [one for one in named if one.name in known]
