"""The rule by which a landmark is gone: from where it was seen before, it is not seen any more.

A *view* is from where a landmark is looked at, as far as that matters: its distance in steps of a factor of 1.4, and in
steps of 22.5 degrees the direction of the line of sight in the map and the bearing to the landmark on the robot. The
views from which an input has seen a landmark are its field of view and all that hides the landmark, as learnt: nothing
is expected from elsewhere. A *pass* is one stay in the views of a landmark; what hides it does so for a whole pass.

Of each view the number of passes is counted, and of those that saw the landmark from it. A pass that does not see it
at all is as likely as its best view misses it. The score is the logarithm of how much likelier these passes are if it
is there than if it is gone. If it is there, that ever falls below ``GONE`` only once in a million times.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graph_slam_ros.typing import Array

GONE = -13.8  # the score at which a landmark is gone: the logarithm of 1e-6
FALSE = 0.02  # probability that a pass shows a landmark that is gone
ELSEWHERE = 0.02  # probability that a pass shows one that is there at another place, the same as the pass before
SECTORS = 16  # of directions and bearings
_RINGS = 2  # steps of distance in each doubling
_NEAREST_M = 0.1
_LONGEST = 4.0  # times its distance is driven in a pass at most

View = tuple[str, int]
"""The input, and the number of a view."""


def views_of(deltas: Array, yaw: float) -> tuple[list[int], list[float]]:
    """The views of points, by number, and their distances.

    Parameters
    ----------
    deltas : (k, 2) or (k, 3) from the robot to each, in the axes of map [m]
    yaw : heading of the robot in map [rad]
    """
    distances = np.sqrt(np.square(deltas).sum(axis=1))
    directions = np.arctan2(deltas[:, 1], deltas[:, 0])
    sectors = SECTORS / (2.0 * np.pi)
    rings = np.floor(_RINGS * np.log2(np.maximum(distances, _NEAREST_M) / _NEAREST_M)).astype(np.int64)
    lines = np.floor(directions * sectors).astype(np.int64) % SECTORS
    bearings = np.floor((directions - yaw) * sectors + 0.5).astype(np.int64) % SECTORS
    return ((rings * SECTORS + lines) * SECTORS + bearings).tolist(), distances.tolist()


@dataclass(slots=True)
class Pass:
    """A stay in the views of a landmark.

    Attributes
    ----------
    began_m, last_m : driven when it began, and when the landmark was last in view
    reach_m : the largest distance to it
    before : of each input, when it began, the sightings of other landmarks that were believed, and that were not
    known : views through which it led, of those that were known before
    seen : views from which the landmark was seen
    places : where sightings that are not believed show it, in map
    """

    began_m: float
    last_m: float
    reach_m: float
    before: dict[str, tuple[int, int]]
    known: set[View] = field(default_factory=set)
    seen: set[View] = field(default_factory=set)
    places: list[Array] = field(default_factory=list)

    def note(self, driven_m: float, distance_m: float) -> None:
        """The landmark is in view."""
        self.last_m, self.reach_m = driven_m, max(self.reach_m, distance_m)

    def has_ended(self, driven_m: float) -> bool:
        """Return whether the robot has driven on far enough."""
        return driven_m - self.last_m >= self.reach_m or driven_m - self.began_m >= _LONGEST * self.reach_m


@dataclass(slots=True)
class Presence:
    """The evidence on whether one landmark is still there.

    Attributes
    ----------
    views : of each view the number of passes that saw the landmark from it, and of all
    score : of the passes since it was last seen
    missed, elsewhere : how many of these did not see it, and how many showed it at another place
    place : that place, in map
    is_reported : whether it was said that it is gone
    """

    views: dict[View, list[int]] = field(default_factory=dict)
    score: float = 0.0
    missed: int = 0
    elsewhere: int = 0
    place: tuple[float, ...] = ()
    is_reported: bool = False

    @property
    def is_gone(self) -> bool:
        """Return whether it is gone."""
        return self.score < GONE

    def see(self, known: set[View], seen: set[View]) -> None:
        """A pass saw the landmark, from some of the views that it led through."""
        for view in sorted(known | seen):
            if view in self.views:
                self.views[view][0] += view in seen
                self.views[view][1] += 1
            else:
                self.views[view] = [0, 0]  # it is known because it was seen: that tells nothing of how often
        self.forget()

    def forget(self) -> None:
        """It is there: passes before tell nothing any more."""
        self.score, self.missed, self.elsewhere, self.place, self.is_reported = 0.0, 0, 0, (), False

    def miss(self, known: set[View]) -> None:
        """A pass did not see the landmark from any of the views that it led through."""
        likeliest = max((self.views[view][0] + 1) / (self.views[view][1] + 2) for view in known)
        for view in known:
            self.views[view][1] += 1
        self.score += math.log((1.0 - likeliest) / (1.0 - FALSE))
        self.missed += 1

    def show_elsewhere(self, place: tuple[float, ...], home: tuple[float, ...]) -> None:
        """A pass showed it at another place than where it stands; places that agree count."""
        if not self.place or math.dist(place, self.place) > 0.5 * math.dist(self.place, home):
            if self.elsewhere:
                self.score -= self.elsewhere * math.log(ELSEWHERE)
            self.elsewhere = 0
        self.place = place
        self.score += math.log(ELSEWHERE)
        self.elsewhere += 1

    def record(self, views: set[View] | None = None) -> list[Any]:
        """The numbers that a map keeps, with these views, or all."""
        chosen = sorted(self.views if views is None else views & self.views.keys())
        counts = [[*view, *self.views[view]] for view in chosen]
        return [self.score, self.missed, self.elsewhere, list(self.place), self.is_reported, counts]

    @staticmethod
    def is_record(record: list[Any]) -> bool:
        """Return whether ``read`` can read a record."""
        try:
            Presence().read(record)
            score, _, elsewhere, place, _, counts = record
            numbers = [score, elsewhere, *place, *(x for _, *some in counts for x in some)]
            return all(map(math.isfinite, numbers)) and all(0 <= seen <= passes for _, _, seen, passes in counts)
        except (TypeError, ValueError):
            return False

    def read(self, record: list[Any]) -> None:
        """Take over a record."""
        self.score, self.missed, self.elsewhere, place, self.is_reported, counts = record
        self.place = tuple(place)
        for topic, number, seen, passes in counts:
            self.views[topic, number] = [seen, passes]
