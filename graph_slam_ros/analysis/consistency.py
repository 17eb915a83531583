"""Consistency: whether a run's covariances and its configured noise agree with its errors.

NEES is the normalised estimation error squared, ``e' Sigma^-1 e`` (Bar-Shalom, Li, Kirubarajan, "Estimation with
applications to tracking and navigation", 2001, section 5.4). For a consistent estimate it is chi-square
distributed, with as many degrees of freedom as e has components. This number is also its mean.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.slam import Config
from graph_slam_ros.slam.noise.scale import NoiseScale
from graph_slam_ros.typing import Array

_TINY = 1e-300  # m
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
_BAND = (0.025, 0.975)
_ESTIMATED = "robust.noise_scale=estimated"
_WORTH_SAYING = 0.2  # log of a factor of a sigma
_ALIKE = 1.5  # design effect: errors of a pass have more in common than chance gives


@dataclass(frozen=True, slots=True)
class Nees:
    """The normalised estimation errors squared of some estimates.

    Attributes
    ----------
    mean : ``dof`` is expected; if it is larger, the covariances are too small; if it is smaller, they are too large
    band : contains the mean in 95 % of runs if the n errors are independent: it is too narrow for a path
    inside, n, skipped : part of single values in their own band; how many were used, and had no covariance or truth
    """

    mean: float
    dof: int
    band: tuple[float, float]
    inside: float
    n: int
    skipped: int

    @classmethod
    def of(cls, errors: Array, covariances: Array) -> "Nees | None":
        """The NEES of errors (n, d) and covariances (n, d, d), NaN where unknown; None where all are."""
        values = _single(errors, covariances)
        values = values[np.isfinite(values)]
        n, dof = len(values), errors.shape[1]
        if not n:
            return None
        low, high = (quantile(edge, n * dof) / n for edge in _BAND)
        single = [quantile(edge, dof) for edge in _BAND]
        inside = float(((values >= single[0]) & (values <= single[1])).mean())
        return cls(float(values.mean()), dof, (low, high), inside, n, len(errors) - n)

    @property
    def verdict(self) -> str:
        """Return whether the sigmas fit the errors."""
        fits = self.band[0] <= self.mean <= self.band[1] or 0.9 <= self.inside < 1.0
        return "right" if fits else "too small" if self.mean > self.dof else "large"


@dataclass(frozen=True, slots=True)
class Consistency:
    """NEES of the last pose, of all poses and of landmarks' positions, each None if unknown, and the noise.

    Attributes
    ----------
    noise : the scale of the noise of each class of edges, input and part
    advice : what the user can do; empty if nothing
    left_out : why there is no NEES: by ``poses`` and ``landmarks``, a reason for each that is None
    frame : where errors are seen from, if not from the first pose
    """

    last_pose: Nees | None
    poses: Nees | None
    landmarks: Nees | None
    noise: tuple[NoiseScale, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)
    advice: str = ""
    frame: str = ""

    @property
    def over_confidence(self) -> str:
        """Return which errors against the truth are larger than the covariances say; empty if none are."""
        named = {"the last pose": self.last_pose, "poses": self.poses, "landmarks": self.landmarks}
        beyond = {name: nees for name, nees in named.items() if nees is not None and nees.mean > nees.band[1]}
        return ", ".join(f"NEES of {name} {nees.mean:.1f} of {nees.dof}" for name, nees in beyond.items())

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self) | {"noise": [one.as_dict() for one in self.noise]}

    def __str__(self) -> str:
        lines = []
        named = {"last pose": self.last_pose, "poses": self.poses, "landmarks": self.landmarks}
        lines += [f"{'NEES':30s}{self.frame}"] if self.frame else []
        if any(named.values()):
            head = f"{'mean':>10s}{'expected':>10s}{'95 % band':>16s}{'inside':>8s}{'n':>7s}{'skipped':>9s}   sigmas"
            lines.append(f"{'NEES':30s}{head}")
        for name, nees in named.items():
            if nees is not None:
                band = f"{nees.band[0]:.2f} to {nees.band[1]:.2f}"
                counts = f"{nees.inside:8.0%}{nees.n:7d}{nees.skipped:9d}   {nees.verdict}"
                lines.append(f"{name:30s}{nees.mean:10.2f}{nees.dof:10d}{band:>16s}{counts}")
        lines += [f"{f'NEES of {name}':30s}left out: {reason}" for name, reason in self.left_out.items()]
        if self.noise:
            head = f"{'dof':>8s}{'chi2/dof':>10s}{'repeated':>10s}"
            lines.append(f"{'noise of class, input, part':40s}{head}   configured sigmas should be")
        for one in self.noise:
            name = " ".join(filter(None, (one.label, one.source, one.part)))
            per_dof = f"{one.per_dof:.3f}" if np.isfinite(one.per_dof) else "-"
            should = should_be(one, self.over_confidence)
            lines.append(f"{name:40s}{one.dof:8.0f}{per_dof:>10s}{one.design_effect:10.2f}   {should}")
        lines += [self.advice] if self.advice else []
        return "\n".join(lines)


def _growth(one: NoiseScale) -> str:
    """Say that the noise is larger in motion, if it is."""
    return ", more in motion" if one.per_rad > 0.0 or one.per_m > 0.0 else ""


def pose_errors(estimate: Array, truth: Array, covariances: Array) -> tuple[Array, Array]:
    """Errors (n - 1, d) of all poses but the first, in their tangent spaces, and their covariances (n - 1, d, d).

    The origin of a map is the robot's first pose, so its position in the world is not an error of the estimate. The
    first pose is moved onto its true pose. All other covariances contain that of the first pose, so it is subtracted.
    This is valid if only the first pose holds the map.

    Parameters
    ----------
    estimate, truth : (n, 7) T_map_base and T_world_base, of the latter NaN where unknown
    covariances : (n, 3, 3) or (n, 6, 6) in the tangent space of each estimate
    """
    planar = covariances.shape[1] == 3
    true = np.stack(se3.compose(_T_map_world(estimate, truth), tuple(truth.T)), axis=1)
    errors = np.stack(se3.local(tuple(true.T), tuple(estimate.T)), axis=1)[1:]
    first, relative = _in_six(covariances[0]), np.empty_like(covariances[1:])
    for k, pose in enumerate(estimate[1:]):
        step = se3.between(tuple(estimate[0]), tuple(pose))
        inherited = se3.propagate(first, tuple(map(float, step)), np.zeros((6, 6)))
        relative[k] = covariances[k + 1] - (inherited[_PLANAR] if planar else inherited)
    return errors[:, [0, 1, 5]] if planar else errors, relative


def nees_of_each(estimate: Array, truth: Array, covariances: Array) -> tuple[Array, tuple[float, float]]:
    """NEES (n - 1,) of all poses but the first, NaN where unknown, and the band of 95 % of single ones.

    As ``pose_errors``.
    """
    errors, relative = pose_errors(estimate, truth, covariances)
    low, high = (quantile(edge, errors.shape[1]) for edge in _BAND)
    return _single(errors, relative), (low, high)


def _single(errors: Array, covariances: Array) -> Array:
    """NEES (n,) of errors (n, d) and covariances (n, d, d), NaN where unknown."""
    known = np.asarray(np.isfinite(errors).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))
    known[known] = np.linalg.eigvalsh(covariances[known])[:, 0] > 0.0  # of what is certain no error has a size
    out, e = np.full(len(errors), np.nan), errors[known]
    out[known] = np.einsum("ni,ni->n", e, np.linalg.solve(covariances[known], e[:, :, None])[:, :, 0])
    return out


def landmark_errors(
    positions: Array, truth: Array, covariances: Array, first: Array, true_first: Array, first_covariance: Array
) -> tuple[Array, Array]:
    """Errors (m, d) of landmarks' positions in the axes of map, and their covariances (m, d, d), as ``pose_errors``.

    An error is measured along the arc around the first pose. To the first order that is the difference of positions.
    It stays right where the first orientation is known badly: what that turns lies on an arc, not on a line.

    Parameters
    ----------
    positions, truth : (m, 3) in map and in world, of the latter NaN where unknown
    covariances : (m, 3, 3) in the axes of map
    first, true_first : (7,) the first pose in map and in world; first_covariance : (3, 3) or (6, 6)
    """
    dimensions = 2 if len(first_covariance) == 3 else 3
    true = np.stack(se3.act(_T_map_world(first[None], true_first[None]), tuple(truth.T)), axis=1)
    turn, inherited = so3.matrix(tuple(first[3:])), _in_six(first_covariance)
    relative = np.empty((len(positions), dimensions, dimensions))
    for k, position in enumerate(positions):
        seen = se3.act(se3.inverse(tuple(first)), tuple(position))
        by_first = turn @ np.hstack([np.eye(3), -so3.hat(tuple(map(float, seen)))])
        relative[k] = (covariances[k] - by_first @ inherited @ by_first.T)[:dimensions, :dimensions]
    return _along_arcs(positions - first[:3], true - first[:3])[:, :dimensions], relative


def _along_arcs(estimate: Array, truth: Array) -> Array:
    """Errors (m, 3) from points to true ones (m, 3): of their distance from 0, and along the arc around it."""
    far, true_far = (np.linalg.norm(points, axis=1, keepdims=True) for points in (estimate, truth))
    ahead = estimate / np.maximum(far, _TINY)
    along = np.sum(truth * ahead, axis=1, keepdims=True)
    aside = truth - along * ahead
    width = np.linalg.norm(aside, axis=1, keepdims=True)
    arc = far * np.arctan2(width, along) * aside / np.maximum(width, _TINY)
    return np.where(far > _TINY, (true_far - far) * ahead + arc, truth)


def should_be(one: NoiseScale, over_confident: str = "") -> str:
    """Return what the configured sigmas of a group should be, for a person; ``over_confident`` as below."""
    if one.reason:
        return f"not known: {one.reason}"
    why = _not_smaller(one, over_confident)
    return f"not smaller{_growth(one)}: {why}" if why else f"{one.factor:.3g} times as large{_growth(one)}"


def noise_advice(
    noise: Sequence[NoiseScale], *, is_applied: bool, config: Config | None = None, over_confident: str = ""
) -> str:
    """The advice if residuals contradict the configured sigmas; else empty.

    Smaller sigmas are not advised where residuals cannot show them: where errors of a pass are alike, or where errors
    against the truth are larger than the covariances say.

    Parameters
    ----------
    is_applied : whether the run used the factors already
    config : parameters of the run; with these, parameters of odometry that say what was found
    over_confident : which errors against the truth are larger than the covariances say; empty where none are known
    """
    wrong = [one for one in noise if not one.reason and _is_wrong(one)]
    if not wrong:
        return ""
    kept = [" ".join(filter(None, one.key)) for one in noise if _not_smaller(one, over_confident)]
    if kept:
        out = f"no smaller sigmas are advised ({'; '.join(kept)})"
        why = f": errors against the truth are larger than the covariances say ({over_confident})"
        out += why if over_confident else ""
        out += "; the run used these factors" if is_applied else ""
    else:
        out = "the run used these factors" if is_applied else f"replay with --set {_ESTIMATED} to use these factors"
    of_odometry = [_not_below(one) if over_confident else one for one in wrong if one.label == "odometry"]
    line = motion_setting([one for one in of_odometry if _is_wrong(one)], config) if config else ""
    return f"{out}\nnoise of this odometry in every run: {line}" if line else out


def _not_smaller(one: NoiseScale, over_confident: str) -> str:
    """Return why smaller sigmas of a group are not advised; empty if they may be, or if they are not smaller."""
    if one.reason or one.factor >= 1.0:
        return ""
    if over_confident:
        return "errors against the truth are larger than the covariances say"
    return "errors of a pass are alike" if one.design_effect > _ALIKE else ""


def _not_below(one: NoiseScale) -> NoiseScale:
    """The noise of a part of odometry whose configured variance is not made smaller."""
    if one.factor >= 1.0:
        return one
    return replace(one, factor=1.0, per_s=one.per_s / one.factor**2)


def _is_wrong(one: NoiseScale) -> bool:
    return one.per_rad > 0.0 or one.per_m > 0.0 or abs(np.log(one.factor)) > _WORTH_SAYING


def motion_setting(noise: Sequence[NoiseScale], config: Config) -> str:
    """Parameters of ``odometry.noise: motion`` that say the estimated noise of odometry; empty where there is none."""
    c = config.odometry
    if not noise or c.noise == "density":
        return ""
    values = dict[str, float]()
    for one in noise:
        name = {"rotation": "turn", "position": "way"}[one.part]
        # a position's is summed over its directions
        along = 1.0 if name == "turn" else 1.0 + (c.lateral_density / c.translation_density) ** 2
        found = {"per_rad": one.per_rad / along, "per_m": one.per_m / along, "per_s": one.per_s / along}
        if c.noise == "motion":
            found["per_s"] = one.factor**2 * getattr(c, f"{name}_per_s")
            found["per_m"] += one.factor**2 * getattr(c, f"{name}_per_m")
            found["per_rad"] += one.factor**2 * getattr(c, f"{name}_per_rad", 0.0)
        values |= {f"{name}_{per}": value for per, value in found.items() if hasattr(c, f"{name}_{per}")}
    return "--set odometry.noise=motion " + " ".join(f"--set odometry.{k}={v:.2g}" for k, v in values.items())


def _in_six(covariance: Array) -> Array:
    """(6, 6) of (3, 3) over x, y and heading, with zeros for the rest; or of (6, 6)."""
    if len(covariance) == 6:
        return covariance
    out = np.zeros((6, 6))
    out[_PLANAR] = covariance
    return out


def _T_map_world(estimate: Array, truth: Array) -> se3.Pose:
    return se3.compose(tuple(estimate[0]), se3.inverse(tuple(truth[0])))
