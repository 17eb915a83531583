"""The score of recordings as a quadratic function of the logarithms of parameters, near its least value.

It says where the least value is, how well the recordings determine it, and where it would be without one of them.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.typing import Array

STEP = math.log(1.3)  # of the design, about the centre
LONGEST = 2.0 * STEP  # from the centre to the least value: the surface is not known farther away
FACTOR = 2.0  # an interval of 95 % that reaches farther than this factor from its middle determines nothing
LEAST_RECORDINGS = 3  # whose spread says how sure a score is that is no likelihood
_SIGMAS = 1.96


def design(count: int) -> Array:
    """Points (n, count) about the centre, the first: as many as a quadratic function has coefficients."""
    points = [np.zeros(count)]
    for k in range(count):
        points += [sign * STEP * np.eye(count)[k] for sign in (1.0, -1.0)]
    points += [STEP * (np.eye(count)[a] + np.eye(count)[b]) for a, b in itertools.combinations(range(count), 2)]
    return np.array(points)


@dataclass(frozen=True, slots=True)
class Surface:
    """Quadratic functions of offsets from the centre, one for each recording; their sum is what is made small.

    Attributes
    ----------
    gradients, curvatures : (recordings, p) and (recordings, p, p)
    is_likelihood : the sum is -log p of all recordings
    """

    gradients: Array
    curvatures: Array
    is_likelihood: bool

    @classmethod
    def through(cls, scores: Array, *, is_likelihood: bool) -> "Surface":
        """Put it through the scores (recordings, n) at the points of ``design``."""
        recordings, n = scores.shape
        count = next(k for k in itertools.count(1) if len(design(k)) >= n)
        gradients, curvatures = np.zeros((recordings, count)), np.zeros((recordings, count, count))
        base, up, down = scores[:, 0], scores[:, 1 : 2 * count : 2], scores[:, 2 : 2 * count + 1 : 2]
        gradients[:] = (up - down) / (2.0 * STEP)
        for k in range(count):
            curvatures[:, k, k] = (up[:, k] + down[:, k] - 2.0 * base) / STEP**2
        for at, (a, b) in enumerate(itertools.combinations(range(count), 2), 2 * count + 1):
            curvatures[:, a, b] = (scores[:, at] - up[:, a] - up[:, b] + base) / STEP**2
            curvatures[:, b, a] = curvatures[:, a, b]
        return cls(gradients, curvatures, is_likelihood)

    def sigmas(self, free: NDArray[np.bool_]) -> Array:
        """The standard deviation (p,) of the logarithm of each parameter; infinite where it is not determined.

        Parameters
        ----------
        free : (p,) which are estimated together; the others stay at the centre

        Notes
        -----
        Of a likelihood it is that of its curvature, or that of the spread of the recordings if this is larger (it is
        where errors are not as they are described). Of another score it is that of the spread alone: H^-1 G H^-1.
        """
        out = np.full(len(free), np.inf)
        curvature = self.curvatures.sum(axis=0)[np.ix_(free, free)]
        if not free.any() or not _is_bowl(curvature):
            return out
        inverse, variances = np.linalg.inv(curvature), []
        if self.is_likelihood:
            variances.append(np.diag(inverse))
        if (count := len(self.gradients)) >= LEAST_RECORDINGS:
            spread = self.gradients[:, free] + self.curvatures[:, free][:, :, free] @ self.offset(free)[free]
            spread = (spread - spread.mean(axis=0)) * (count / (count - 1)) ** 0.5
            variances.append(np.diag(inverse @ (spread.T @ spread) @ inverse))
        if variances:
            out[free] = np.sqrt(np.max(variances, axis=0))
        return out

    def determined(self) -> NDArray[np.bool_]:
        """Return which parameters (p,) the recordings determine. Of the others the worst is fixed first, one by one."""
        free = np.ones(self.gradients.shape[1], dtype=bool)
        while free.any():
            sigmas = self.sigmas(free)
            if not np.isfinite(sigmas[free]).any():
                # Which of them is flat is seen in each by itself.
                single = np.array([self.sigmas(np.arange(len(free)) == k)[k] for k in range(len(free))])
                worst = int(np.argmax(np.where(free, single, -1.0)))
            else:
                worst = int(np.argmax(np.where(free, sigmas, -1.0)))
                if sigmas[worst] <= math.log(FACTOR) / _SIGMAS:
                    break
            free[worst] = False
        return free

    def offset(self, free: NDArray[np.bool_], without: int | None = None, longest: float = LONGEST) -> Array:
        """Return where the sum is least, (p,) from the centre, at most ``longest`` in each parameter.

        Parameters
        ----------
        without : a recording that is left out
        """
        kept = np.arange(len(self.gradients)) != (-1 if without is None else without)
        gradient, curvature = self.gradients[kept].sum(axis=0)[free], self.curvatures[kept].sum(axis=0)
        curvature = curvature[np.ix_(free, free)]
        out = np.zeros(len(free))
        if free.any():
            step = -np.linalg.solve(curvature, gradient) if _is_bowl(curvature) else -np.sign(gradient) * longest
            out[free] = np.clip(step, -longest, longest)
        return out


def _is_bowl(curvature: Array) -> bool:
    """Return whether a quadratic function has a least value."""
    eigenvalues = np.linalg.eigvalsh(curvature)
    return bool(eigenvalues[0] > 1e-9 * max(1.0, float(eigenvalues[-1])))


def interval(value: float, sigma: float) -> tuple[float, float]:
    """The interval of 95 % of a parameter from the standard deviation of its logarithm."""
    return value * math.exp(-_SIGMAS * sigma), value * math.exp(_SIGMAS * sigma)


def held_out_of(fingerprints: Sequence[str]) -> list[int]:
    """Return the recordings that are held out: every third, in order of their hashes; none of fewer than six."""
    order = sorted(range(len(fingerprints)), key=lambda k: fingerprints[k])
    return sorted(order[2::3]) if len(order) >= 6 else []
