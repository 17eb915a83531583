"""The fit of a further visit to its place, and the factor by which errors of visits are larger than stated.

What is wrong with a calibration makes errors that last. The covariance of a visit does not have them, because they are
alike in the visit. But visits differ by them: the robot drove another way. So the variances of visits are multiplied by
chi2 per degree of freedom of all visits to places so far, which is never less than 1.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.lifelong.place import Fused, Place, fused, visit_without
from graph_slam_ros.slam.lifelong.visit import Visit
from graph_slam_ros.typing import Numbers

_STRIKES = 2  # visits in a row that contradict a place in the same landmark: then that begins anew
_WIDER = (2.0, 4.0, 9.0)  # factors of the variances of a visit that contradicts its place, the first that fits
_DEGREES = 20  # of freedom that fit, before the first visit
_CHANGE = 0.05  # of the factor, from which on places are scaled anew


@dataclass(slots=True)
class VisitScale:
    """The factor by which the variances of visits are larger than stated.

    Attributes
    ----------
    chi2, degrees : of all visits against their places, with variances as stated
    factor : in use
    """

    chi2: float = 0.0
    degrees: int = 0
    factor: float = 1.0

    def add(self, fit: Fused, gate: float) -> None:
        """Add the statistic of a visit, with variances in use. None counts for more than the quantile ``gate``."""
        if fit.degrees > 0:
            self.chi2 += self.factor * min(fit.statistic, quantile(gate, fit.degrees))
            self.degrees += fit.degrees

    def change(self) -> float:
        """Use the factor by all visits so far. Returns by how much it changed; 1 where that is next to nothing."""
        now = max(1.0, (self.chi2 + _DEGREES) / (self.degrees + _DEGREES))
        by = now / self.factor
        if abs(by - 1.0) < _CHANGE:
            return 1.0
        self.factor = now
        return by


@dataclass(frozen=True, slots=True)
class Fit:
    """A visit laid on its place.

    Attributes
    ----------
    as_is : the place with the whole visit; its statistic is how well that fits
    result : the place with that part of the visit; None if nothing is added
    visit : the part of it that is added
    without, anew : the landmark that contradicts the place and was left out, or that the place has anew
    wider : the factor of the variances of the visit
    """

    as_is: Fused
    result: Fused | None
    visit: Visit
    without: int | None = None
    anew: int | None = None
    wider: float = 1.0


def fit_of(space: Geometry, place: Place, visit: Visit, guess: Numbers, gate: float, strikes: Mapping[int, int]) -> Fit:
    """Return how a visit fits its place: as it is, without one landmark, or with larger variances.

    Parameters
    ----------
    guess : about where the pose of the visit is in the axes of the place
    gate : quantile of chi2 above which a visit contradicts its place
    strikes : visits in a row that contradicted the place, of each landmark

    Raises
    ------
    SingularError
        As for ``fused``.
    """
    done = fused(space, place, visit, guess)
    if _passes(done, gate):
        return Fit(done, done, visit)
    without = _contradicting(space, place, visit, guess, gate)
    if without is not None and strikes.get(without, 0) + 1 >= _STRIKES:
        return Fit(done, fused(space, place.without(without), visit, guess), visit, anew=without)
    if without is not None:
        rest = visit_without(visit, without)
        return Fit(done, fused(space, place, rest, guess), rest, without=without)
    for wider in _WIDER:
        unsure = replace(visit, information=visit.information / wider)
        result = fused(space, place, unsure, guess)
        if _passes(result, gate):
            return Fit(done, result, unsure, wider=wider)
    return Fit(done, None, visit)


def _passes(done: Fused, gate: float) -> bool:
    return done.degrees < 1 or done.statistic <= quantile(gate, done.degrees)


def _contradicting(space: Geometry, place: Place, visit: Visit, guess: Numbers, gate: float) -> int | None:
    """Return the landmark without which a visit fits its place best; None where it fits without none of them."""
    shared, found = place.shared(visit), list[tuple[float, int]]()
    for k, mark in enumerate(shared):
        rest = [place.members.index(one) for one in (*shared[:k], *shared[k + 1 :])]
        if not place.seen.part(rest).lays(space):
            continue
        done = fused(space, place, visit_without(visit, mark), guess)
        if _passes(done, gate):
            found.append((done.statistic, mark))
    return min(found)[1] if found else None
