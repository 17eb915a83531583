"""The landmark of each cluster in the graph. It is assigned at once, and changed when another one fits better."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.association.beam import NOTHING
from graph_slam_ros.slam.association.moves import LEAST_SCANS
from graph_slam_ros.slam.association.scans import Cluster, Seen
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.noise.scale import ALIKE_NS

NOT_IN_MAP = ""  # in place of a name, where the map is held and nothing in it fits
NAME = "unnamed"
"""What landmarks are called that have no name; a number follows."""
_CONFIRMED = 5  # sightings, which last longer than alike errors: clutter is seen for less, from one place
_OF_MEDIAN = 0.1  # part of the scans of the median landmark that one is seen in to be believed
_GIVE_UP_NS = 60 * 10**9  # a landmark that is not confirmed goes when it was not seen for this long
_FROM_MAP = -100  # numbers of landmarks that no cluster of this drive began, downwards


@dataclass(frozen=True, slots=True)
class Assigned:
    """A sighting, and the name of its landmark."""

    topic: str
    name: str
    sighting: Sighting
    where: PoseAtStamp


def last_number(names: Iterable[str]) -> int:
    """The highest number after ``NAME``; 0 if there is none."""
    numbers = (name.removeprefix(NAME) for name in names)
    return max((int(number) for number in numbers if number.isdecimal()), default=0)


class Assignments:
    """The clusters and their landmarks.

    Parameters
    ----------
    backend : is told what is new in the graph

    Attributes
    ----------
    count : clusters so far; each keeps its number, which is that of the landmark that it began, too
    given : by cluster the number of its landmark, or ``NOTHING``
    seen : by cluster its sightings
    names : of landmarks by number
    """

    def __init__(self, landmarks: Landmarks, counters: Counters, backend: Backend) -> None:
        self._landmarks, self._counters, self._backend = landmarks, counters, backend
        self.count = 0
        self.given: dict[int, int] = {}
        self.names: dict[int, str] = {}
        self.seen: dict[int, tuple[Seen, ...]] = {}
        self._scans: Counter[int] = Counter()  # of each landmark
        self._begun, self._fresh = 0, _FROM_MAP
        self._final = 0  # the first cluster whose landmark may change
        self._given_up: dict[int, list[int]] = {}  # landmarks that were, with their clusters

    def restore(self) -> bool:
        """Continue with the landmarks of a map, if there are any. New names differ from theirs."""
        unnamed = [name for name, mark in self._landmarks.known.items() if mark.is_unnamed]
        self._begun = last_number(unnamed)
        self.names = {self.fresh(): name for name in unnamed}
        return bool(unnamed)

    @property
    def final(self) -> dict[int, Landmark]:
        """The landmarks that have sightings which cannot be taken back, by number."""
        marks = {k: self._landmarks.known[name] for k, name in self.names.items() if name in self._landmarks.known}
        return {k: mark for k, mark in marks.items() if len(mark.seen) < mark.sightings}

    def fresh(self) -> int:
        """A number for a landmark that no cluster has begun."""
        self._fresh -= 1
        return self._fresh

    def finish(self) -> None:
        """Fix the assignment of all present clusters."""
        self._final = self.count

    def forget_before(self, first: int) -> None:
        """Forget the clusters before one: their landmarks are final."""
        for cluster in [one for one in self.given if one < first]:
            del self.seen[cluster]
            del self.given[cluster]
        up = {k: [one for one in clusters if one >= first] for k, clusters in self._given_up.items()}
        self._given_up = {k: clusters for k, clusters in up.items() if clusters}
        used, known = {*self.given.values(), *self._given_up}, self._landmarks.known
        self.names = {k: name for k, name in self.names.items() if k in used or name in known}
        self._scans = Counter({k: count for k, count in self._scans.items() if k in used or k in self.names})

    def append(self, clusters: Sequence[Cluster]) -> int:
        """Add clusters without a landmark. Returns the number of the first."""
        first, self.count = self.count, self.count + len(clusters)
        for number, cluster in enumerate(clusters, first):
            self.seen[number], self.given[number] = cluster.seen, NOTHING
        return first

    def begin(self, first: int, landmarks: Mapping[int, int]) -> list[Assigned]:
        """Assign new clusters, from a number on. Returns their sightings, each with its landmark's name."""
        out = []
        for cluster in range(first, self.count):
            landmark = self.given[cluster] = landmarks.get(cluster, NOTHING)
            self._scans[landmark] += 1
            for one in self.seen[cluster]:
                if landmark == NOTHING:
                    self._counters.count(one.topic, "unclear_which")
                else:
                    out.append(Assigned(one.topic, self._name(landmark), one.sighting, one.where))
        return out

    def give(self, changed: Mapping[int, int]) -> bool:
        """Assign clusters to other landmarks, unless theirs are final. Returns whether there were any."""
        changed = {c: k for c, k in changed.items() if c >= self._final and self.given.get(c, k) != k}
        lost: dict[str, set[tuple[int, str, Sighting]]] = {}
        for cluster in changed:
            name = self.names.get(self.given[cluster], NOT_IN_MAP)
            lost.setdefault(name, set()).update((s.where.stamp_ns, s.topic, s.sighting) for s in self.seen[cluster])
            self._scans[self.given[cluster]] -= 1
        for name, seen in lost.items():
            if name in self._landmarks.known:
                self._landmarks.remove_sightings(name, seen)
        for cluster, landmark in changed.items():
            self.given[cluster] = landmark
            self._scans[landmark] += 1
            self._add(cluster)
        if changed:
            self._counters.count("landmarks", "reassigned", len(changed))
            self._backend.hand_over()
        return bool(changed)

    def _add(self, cluster: int) -> None:
        """Add the sightings of a cluster to its landmark."""
        landmark = self.given[cluster]
        name = self._name(landmark) if landmark != NOTHING else NOT_IN_MAP
        if name != NOT_IN_MAP:
            for one in self.seen[cluster]:
                with suppress(GraphSlamError):  # as when it was new
                    self._landmarks.add(one.topic, name, one.sighting, one.where)

    def _name(self, landmark: int) -> str:
        if landmark in self._given_up:  # it is seen again, and with it what was seen before
            for cluster in self._given_up.pop(landmark):
                if self.given[cluster] == landmark:
                    self._add(cluster)
        return self.names.get(landmark) or self._new_name(landmark)

    def _new_name(self, landmark: int) -> str:
        if not self._landmarks.begins_new:
            return NOT_IN_MAP
        self._begun += 1
        while f"{NAME}{self._begun}" in self._landmarks.known:
            self._begun += 1
        return self.names.setdefault(landmark, f"{NAME}{self._begun}")

    def judge(self, now_ns: int) -> None:
        """Accept landmarks that were seen often enough, and remove those that were not seen again."""
        known = self._landmarks.known
        counts = [n for k, n in self._scans.items() if n >= LEAST_SCANS and k != NOTHING]
        least = _OF_MEDIAN * float(np.median(counts)) if counts else 0.0
        for number, name in self.names.items():
            mark = known.get(name)
            if mark is None or self._landmarks.is_held(name):
                continue
            for_long = mark.last_seen_ns - mark.first_seen_ns >= ALIKE_NS
            often = number < _FROM_MAP or self._scans[number] >= least
            is_sure = mark.sightings >= _CONFIRMED and for_long and often
            is_sure |= len(mark.seen) < mark.sightings and not mark.is_tentative  # some cannot be taken back any more
            if is_sure == mark.is_tentative:
                self._landmarks.confirm(name, is_sure=is_sure)
            if not is_sure and now_ns - mark.last_seen_ns > _GIVE_UP_NS:
                self._landmarks.prune(name)
                self._given_up[number] = [cluster for cluster, k in self.given.items() if k == number]
                self._counters.count("landmarks", "given_up")
