"""The weak parts of a run: the weakest pose and landmark, and the stretches of the path that are weak, with the reason.

All sigmas are relative to what holds the map: the anchor at the first keyframe, fixes, surveyed landmarks.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.runs.folder import RunError
from graph_slam_ros.slam.weak_direction import WeakDirection, position_covariance, weakest_position, weakest_turn
from graph_slam_ros.typing import Array, Numbers

POSITION, HEADING, LANDMARK, SIGHTINGS = "position", "heading", "landmark", "sightings"
_WEAK = 1.5  # of the usual sigma, the median of the run
_SHOWN = 3  # stretches of each quantity
_MOSTLY, _FEW = 0.5, 0.5  # of the length of a stretch; sightings for each keyframe
_LEAST_M = 1.0  # a shorter stretch is not reported


@dataclass(frozen=True, slots=True)
class Weakest:
    """The vertex at which a quantity is known least.

    Attributes
    ----------
    what : ``position`` or ``heading`` of a keyframe, or ``landmark``: its position
    about : the keyframe or landmark by its name
    vertex, value : its vertex, and the estimate
    keyframe : index of the keyframe among those in the graph; of a landmark the first that saw it
    direction : the weakest direction, with sigma [m or rad]
    usual : the median of this sigma in the run
    functional : (dof,) of the vertex' tangent space: the direction as a linear function of its error
    """

    what: str
    about: str
    vertex: int
    value: Numbers
    keyframe: int
    direction: WeakDirection
    usual: float
    functional: Array


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of the path where a quantity is weak, or where no landmark was seen.

    Attributes
    ----------
    what : ``position`` or ``heading``; ``sightings``: only no landmark was seen
    keyframes : the first and the last, by their numbers
    stamps_ns : of both
    begins_m, length_m : the way driven until the first, and from there to the last
    sigma, usual : the largest sigma in it, and the median of the run [m or rad]; None of sightings
    reason : why it is weak, in words
    """

    what: str
    keyframes: tuple[int, int]
    stamps_ns: tuple[int, int]
    begins_m: float
    length_m: float
    sigma: float | None
    usual: float | None
    reason: str


class Weakness:
    """The sigmas of all keyframes and landmarks of a run.

    Attributes
    ----------
    poses : (n, 3) or (n, 7) estimated poses of the keyframes
    travelled_m : (n,) the way driven until each keyframe; jumps between segments do not count

    Raises
    ------
    GaugeError, SingularError
        As of ``Solver.marginal``.
    RunError
        All keyframes are of a frozen map.
    """

    def __init__(self, run: SavedGraph) -> None:
        self.run = run
        space, n = run.space, run.space.dimensions
        self.poses = run.solver.estimate(run.keyframes)
        steps = np.diff(self.poses[:, :n], axis=0, prepend=self.poses[:1, :n])
        steps[np.isin(run.numbers, run.segments)] = 0.0
        self._steps, whole = steps, run.whole_path.poses(run.solver)[:, :n]
        driven = np.diff(whole, axis=0, prepend=whole[:1])
        driven[run.segments] = 0.0
        self.travelled_m = np.cumsum(np.linalg.norm(driven, axis=1))[run.numbers]
        self._free = np.flatnonzero(~np.isin(run.keyframes, run.held))
        if not len(self._free):
            raise RunError(f"{run.folder}: all keyframes are of a frozen map: nothing of it is estimated")
        self._covariances = run.solver.marginal([run.keyframes[k] for k in self._free])
        at = [tuple(self.poses[k].tolist()) for k in self._free]
        pairs = list(zip(at, self._covariances, strict=True))
        self._positions = [position_covariance(space, pose, covariance) for pose, covariance in pairs]
        self._turns = [weakest_turn(space, pose, covariance) for pose, covariance in pairs]
        self._sigmas = {
            POSITION: _largest_sigmas(self._positions),
            HEADING: np.array([one.sigma for one in self._turns]),
        }

    def held_by(self) -> str:
        """Name what the sigmas are relative to: the anchor, fixes, surveyed landmarks, a frozen map."""
        run = self.run
        labels = {entry.label for entry in run.entries if entry.is_in and len(entry.vertices) == 1}
        names = {"anchor": "the anchor at the first keyframe", "fixes": "fixes", "surveyed": "surveyed landmarks"}
        return ", ".join(
            [name for label, name in names.items() if label in labels] + ["a frozen map"] * bool(len(run.held))
        )

    # -- the weakest -----------------------------------------------------------------------------------------------

    def weakest(self) -> Iterator[Weakest]:
        """The weakest position and heading of a keyframe, and the weakest landmark, if there is one."""
        for what, sigmas in self._sigmas.items():
            k = int(sigmas.argmax())
            keyframe = int(self._free[k])
            vertex, about = self.run.keyframes[keyframe], f"keyframe {self.run.numbers[keyframe]}"
            if what == POSITION:
                direction = weakest_position(self._positions[k], self.path_at(keyframe))
            else:
                direction = self._turns[k]
            yield self._weakest(what, about, vertex, keyframe, direction, sigmas)
        free = {name: vertex for name, vertex in self.run.landmarks.items() if vertex not in self.run.held}
        if free:
            covariances = [
                position_covariance(self.run.space, self.value(vertex), covariance)
                for vertex, covariance in zip(free.values(), self.run.solver.marginal([*free.values()]), strict=True)
            ]
            sigmas = _largest_sigmas(covariances)
            k = int(sigmas.argmax())
            name, vertex = [*free.items()][k]
            keyframe = next((at for at, seen in enumerate(self.seen) if name in seen), 0)
            direction = weakest_position(covariances[k])
            yield self._weakest(LANDMARK, f"landmark {name}", vertex, keyframe, direction, sigmas)

    def _weakest(
        self, what: str, about: str, vertex: int, keyframe: int, direction: WeakDirection, sigmas: Array
    ) -> Weakest:
        space, value, dof = self.run.space, self.value(vertex), self.run.graph.kind_of(vertex).dof
        in_map = np.zeros(dof)
        in_map[slice(space.dimensions, None) if what == HEADING else slice(space.dimensions)] = direction.axis
        functional = in_map if len(value) == space.dimensions else self._in_tangent(value, in_map)
        return Weakest(what, about, vertex, value, keyframe, direction, float(np.median(sigmas)), functional)

    def value(self, vertex: int) -> Numbers:
        """The estimate of a vertex."""
        return tuple(self.run.solver.estimate([vertex])[0].tolist())

    def path_at(self, keyframe: int) -> Array:
        """The direction (n,) in which the robot drives at a keyframe, in the map; of one that stands, of its x axis."""
        nearby = [k for k in (keyframe, keyframe + 1) if k < len(self._steps)]
        path: Array = self._steps[nearby].sum(axis=0)
        if np.linalg.norm(path) > 0.0:
            return path
        return self.run.space.turn(tuple(self.poses[keyframe].tolist()))[:, 0]

    def _in_tangent(self, pose: Numbers, in_map: Array) -> Array:
        """A linear function of an error in the axes of the map as one of the tangent space of the pose."""
        space = self.run.space
        turn: Array = space.group.adjoint((*space.identity[: space.dimensions], *pose[space.dimensions :]))
        return turn.T @ in_map

    # -- stretches -------------------------------------------------------------------------------------------------

    @cached_property
    def seen(self) -> list[list[str]]:
        """The landmarks that are seen from each keyframe by accepted sightings, one for each sighting."""
        return self._landmarks_of(is_in=True)

    def _landmarks_of(self, *, is_in: bool) -> list[list[str]]:
        at = {vertex: k for k, vertex in enumerate(self.run.keyframes)}
        out: list[list[str]] = [[] for _ in at]
        for entry in self.run.entries:
            names = self.run.landmarks_of(entry) if entry.label == PLACES else [entry.landmark] * bool(entry.landmark)
            if names and entry.is_in == is_in and entry.vertices[0] in at:
                out[at[entry.vertices[0]]] += names
        return out

    def stretches(self) -> Iterator[Stretch]:
        """The weak stretches, the weakest of each quantity first."""
        for what, sigmas in self._sigmas.items():
            usual = float(np.median(sigmas))
            found = [
                self._stretch(what, int(self._free[a]), int(self._free[b - 1]), float(sigmas[a:b].max()), usual)
                for a, b in _runs(sigmas > _WEAK * usual)
            ]
            long = [one for one in found if one.length_m >= _LEAST_M]
            yield from sorted(long, key=lambda one: -(one.sigma or 0.0))[:_SHOWN]

    def longest_unseen(self) -> Stretch | None:
        """The longest part of the path without an accepted sighting; None where the run has no landmark.

        The path of a frozen map does not count.
        """
        if not any(self.seen):
            return None
        is_unseen = np.array([not names for names in self.seen]) & ~np.isin(self.run.keyframes, self.run.held)
        unseen = [(max(a - 1, 0), min(b, len(is_unseen) - 1)) for a, b in _runs(is_unseen)]
        longest = max(unseen, key=lambda one: self._length(*one), default=None)
        if longest is None or self._length(*longest) < _LEAST_M:
            return None
        return self._stretch(SIGHTINGS, *longest)

    def _length(self, first: int, last: int) -> float:
        return float(self.travelled_m[last] - self.travelled_m[first])

    def _stretch(
        self, what: str, first: int, last: int, sigma: float | None = None, usual: float | None = None
    ) -> Stretch:
        numbers, stamps_ns = ((of[first], of[last]) for of in (self.run.numbers, self.run.stamps_ns))
        reason = "no landmark seen" if what == SIGHTINGS else self._reason(first, last)
        begins_m = float(self.travelled_m[first])
        return Stretch(what, numbers, stamps_ns, begins_m, self._length(first, last), sigma, usual, reason)

    def _reason(self, first: int, last: int) -> str:
        """Return the reason why a stretch is weak: what was seen in it, and what of that is known from elsewhere."""
        within = self.seen[first : last + 1]
        sightings = [name for names in within for name in names]
        names = set(sightings)
        if not sightings:
            refused = sum(map(len, self._landmarks_of(is_in=False)[first : last + 1]))
            return f"{refused} sightings refused, none accepted" if refused else "no landmark seen"
        gaps = _runs(np.array([not names for names in within]))
        blind = max((self._length(first + a, min(first + b, last)) for a, b in gaps), default=0.0)
        if blind > _MOSTLY * self._length(first, last):
            return f"no landmark seen for {blind:.0f} m of it"
        if len(names) == 1:
            return f"only landmark {sightings[0]} seen"
        elsewhere = {name for seen in (*self.seen[:first], *self.seen[last + 1 :]) for name in seen}
        if not names & elsewhere:
            return f"{len(names)} landmarks seen, none of them from anywhere else"
        few = f"{len(sightings)} sightings of {len(names)} landmarks from {len(within)} keyframes"
        if len(sightings) < _FEW * len(within):
            return f"only {few}"
        return f"loosely tied to what holds the map, by {few}"


def _largest_sigmas(covariances: Sequence[Array]) -> Array:
    return np.sqrt([max(float(np.linalg.eigvalsh(one)[-1]), 0.0) for one in covariances])


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The runs of true flags, as first and behind the last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
