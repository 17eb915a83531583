"""The end of a visit when it is condensed, and the limits of places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array, Numbers

ITSELF, PLACE = "it contradicts itself", "it contradicts its place"
"""Why the sightings of a visit are lost."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the size of places, and of what is believed.

    Attributes
    ----------
    members : landmarks of one place, at most; places : of one cell, at most
    closures : between the same two bases, at most: those that agree are one
    others : to so many vertices each vertex has closures; two that both have more are not joined any more
    gate : quantile of chi2 above which a visit contradicts itself or its place
    """

    members: int = 48
    places: int = 8
    closures: int = 4
    others: int = 10
    gate: float = 0.9999


@dataclass(frozen=True, slots=True)
class RemovedPose:
    """A removed keyframe relative to another vertex, which may be removed later.

    Attributes
    ----------
    covariance : (dof, dof) of ``T_base_vertex`` in its tangent space; None where no closure can begin there
    """

    vertex: int
    base: int
    T_base_vertex: Numbers
    covariance: Array | None = None


@dataclass(frozen=True, slots=True)
class Condensed:
    """The end of one visit.

    Attributes
    ----------
    how : ``first`` (of a place), ``again`` (added to a place), ``composed`` (odometry, closures and fixes are kept, by
        edges of fewer keyframes; sightings, if any, contradicted something and are lost), ``waits`` (until the
        keyframes after it see enough places), ``kept`` (it cannot be condensed)
    why : of ``composed`` and ``kept``
    statistic, degrees : chi2 of the visit against all before in its place
    without, anew : the landmark that contradicts the place and was left out, or that the place has anew
    wider : factor of the variances of the visit, without which it contradicts its place
    removed : the keyframes that left the problem, in order of time
    seen : (keyframe, landmark) of each sighting that is in the place now
    """

    how: str
    why: str = ""
    statistic: float = 0.0
    degrees: int = 0
    without: int | None = None
    anew: int | None = None
    wider: float = 1.0
    removed: tuple[RemovedPose, ...] = ()
    seen: tuple[tuple[int, int], ...] = ()

    @property
    def is_contradiction(self) -> bool:
        """Return whether the visit contradicts itself or its place."""
        return self.why in (ITSELF, PLACE)


def poses_of(space: Geometry, removed: Sequence[RemovedPose], kept: Mapping[int, Numbers]) -> dict[int, Numbers]:
    """Return the present poses of keyframes, removed ones included.

    Parameters
    ----------
    removed : in the order of their removal; kept : the present poses of all others that are a base
    """
    out = dict(kept)
    for one in reversed(removed):
        out[one.vertex] = tuple(map(float, space.group.compose(out[one.base], one.T_base_vertex)))
    return out
