"""Consistency: whether a run's covariances and its configured noise agree with its errors.

Errors are seen from the first keyframe with a true pose. Where the truth is positions only, those of the plane are seen
from the line between two of them: the first, and the one that is farthest from it.

NEES is the normalised estimation error squared, ``e' Sigma^-1 e`` (Bar-Shalom, Li, Kirubarajan, "Estimation with
applications to tracking and navigation", 2001, section 5.4). For a consistent estimate it is chi-square
distributed, with as many degrees of freedom as e has components. This number is also its mean.
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.trajectories import Truth
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import GraphSlamError, message_of
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.runs import outcome
from graph_slam_ros.runs.folder import COVARIANCES, SUMMARY, run_config, summary_of
from graph_slam_ros.runs.trajectory import LandmarkTable, Trajectory, read_covariances, read_landmarks, read_rows
from graph_slam_ros.slam import Config
from graph_slam_ros.slam.noise.scale import NoiseScale
from graph_slam_ros.slam.weak_direction import position_covariance
from graph_slam_ros.typing import Array

_TINY = 1e-300  # m
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
_BAND = (0.025, 0.975)
_ESTIMATED = "robust.noise_scale=estimated"
_WORTH_SAYING = 0.2  # log of a factor of a sigma
_MOST = 500  # poses for which joint covariances are computed
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


_All = tuple[Nees | None, Nees | None, Nees | None]  # of the last pose, of poses, of landmarks


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
    why, grows = _not_smaller(one, over_confident), ", more in motion" * (one.per_rad > 0.0 or one.per_m > 0.0)
    return f"not smaller{grows}: {why}" if why else f"{one.factor:.3g} times as large{grows}"


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


def line_covariances(saved: SavedGraph, line: tuple[int, int], vertices: Sequence[int | None]) -> Array:
    """Covariances (n, 2, 2) of positions in the axes of map, seen from the line between those of two keyframes.

    What a position has in common with the line is no error as seen from there. NaN where there is no vertex.
    """
    ends, space, out = [saved.vertices[k] for k in line], saved.space, np.full((len(vertices), 2, 2), np.nan)

    def value(vertex: int) -> Array:
        return np.asarray(saved.solver.estimate([vertex])[0])

    def by_position(pose: Array) -> Array:
        """The Jacobian of a position by the tangent space of its vertex."""
        return np.eye(2) if len(pose) == 2 else np.hstack([space.turn(tuple(pose)), np.zeros((2, space.dof - 2))])

    def across(arm: Array) -> Array:
        return np.array([-arm[1], arm[0]])

    first, last = map(value, ends)
    along = (last - first)[:2]
    for k, vertex in enumerate(vertices):
        if vertex in ends:
            out[k] = 0.0
        elif vertex is not None:
            point = value(vertex)
            turned = np.outer(across(point[:2] - first[:2]), across(along)) / (along @ along)
            of_ends = (turned - np.eye(2)) @ by_position(first), -turned @ by_position(last)
            jacobian = np.hstack([*of_ends, by_position(point)])
            out[k] = jacobian @ saved.solver.joint_marginal([*ends, vertex]) @ jacobian.T
    return out


def consistency_of(run: Path, known: Truth, keyframes: slice, *, is_first: bool) -> Consistency | None:
    """Return the consistency of a drive of a run; None if it has no covariances.

    Parameters
    ----------
    keyframes : of the drive
    is_first : whether the map began with this drive
    """
    if not os.path.lexists(run / COVARIANCES):
        return None
    path, covariances = read_rows(run / "path.tum"), read_covariances(run / COVARIANCES)
    if len(covariances) != len(path.stamps_s):
        raise GraphSlamError(f"{run / COVARIANCES}: {len(covariances)} rows for {len(path.stamps_s)} poses of path.tum")
    path, covariances = path.at(keyframes), covariances[keyframes]
    is_planar = covariances.shape[1] == 3
    true = interpolated(known.trajectory.in_plane() if is_planar else known.trajectory, path.stamps_s)
    is_held, noise = _noise(run)
    config = run_config(run)
    is_applied = config.robust.noise_scale == "estimated"
    reason = _why_no_nees(known, true, is_first=is_first, is_held=is_held, is_planar=is_planar)
    if reason:
        found = Consistency(None, None, None, noise, {"poses and landmarks": reason})
    else:
        landmarks = read_landmarks(run / "landmarks.csv")
        drive, frame = _Compared(run, path, true, landmarks, known), ""
        if not known.trajectory.has_orientation:
            several, frame = drive.positions()
        elif np.isfinite(true[0]).all() and np.isfinite(covariances[0]).all():  # that of a condensed one is not known
            several = drive.poses(0, covariances, landmarks.covariances)
        else:
            several, frame = drive.later()
        found = Consistency(*several, noise, _left_out(*several, known, len(landmarks)), frame=frame)
    is_void = any(one.severity == "error" for one in outcome.findings(summary_of(run)))
    config_of = None if is_void else config  # such a run says nothing of odometry's noise
    advice = noise_advice(noise, is_applied=is_applied, config=config_of, over_confident=found.over_confidence)
    return replace(found, advice=advice)


class _Compared:
    """A drive and its truth, in the frames that they can be compared in."""

    def __init__(self, run: Path, path: Trajectory, true: Array, landmarks: LandmarkTable, known: Truth) -> None:
        self._run, self._path, self._true, self._names = run, path, true, landmarks.names
        unknown = (np.nan, np.nan, np.nan)
        self._places = landmarks.positions
        self._true_places = np.array([known.landmarks.get(name, unknown) for name in self._names]).reshape(-1, 3)
        self._with_truth = np.flatnonzero(np.isfinite(true).all(axis=1))

    def poses(self, first: int, covariances: Array, spreads: Array) -> _All:
        """NEES seen from a pose whose covariance all others contain; ``covariances`` begin there."""
        estimate, true = self._path.poses[first:], self._true[first:]
        errors, relative = pose_errors(estimate, true, covariances)
        seen = landmark_errors(self._places, self._true_places, spreads, estimate[0], true[0], covariances[0])
        return Nees.of(errors[-1:], relative[-1:]), Nees.of(errors, relative), Nees.of(*seen)

    def later(self) -> tuple[_All, str]:
        """NEES seen from the first keyframe with truth, where that is not the first: it alone holds the map then."""
        saved = self._saved()
        first, space = int(self._with_truth[0]), saved.space
        solver = saved.problem([e.edge for e in saved.entries if e.is_in and len(e.vertices) == 1])
        solver.hold(saved.vertices[first])
        solver.optimize()
        known = [k for k in saved.numbers if first <= k < len(self._true)]
        covariances = np.full((len(self._true) - first, space.dof, space.dof), np.nan)
        covariances[np.array(known) - first] = solver.marginal([saved.vertices[k] for k in known])
        spreads = np.full((len(self._names), 3, 3), np.nan)
        for spread, name in zip(spreads, self._names, strict=True):
            if (vertex := saved.landmarks.get(name)) is not None:
                value, n = tuple(solver.estimate([vertex])[0].tolist()), space.dimensions
                spread[:n, :n] = position_covariance(space, value, solver.marginal([vertex])[0])
                spread[n:], spread[:, n:] = 0.0, 0.0
        found = self.poses(first, covariances, spreads)
        return found, f"seen from keyframe {first}, the first in the graph with a true pose"

    def positions(self) -> tuple[_All, str]:
        """NEES of positions in the plane, seen from the line between two of them."""
        path, true = self._path.poses[:, :2], self._true[:, :2]
        saved = self._saved()
        first, some = int(self._with_truth[0]), self._some()
        last = int(some[np.argmax(np.linalg.norm(true[some] - true[first], axis=1))])
        line, true_line = path[last] - path[first], true[last] - true[first]
        angle = np.arctan2(line[1], line[0]) - np.arctan2(true_line[1], true_line[0])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

        def errors(estimate: Array, truth: Array) -> Array:
            return path[first] + (truth[:, :2] - true[first]) @ turn.T - estimate[:, :2]

        some = some[some != first]
        off = errors(path[some], true[some])
        covariances = line_covariances(saved, (first, last), [saved.vertices[k] for k in some])
        of_landmarks = line_covariances(saved, (first, last), [saved.landmarks.get(name) for name in self._names])
        seen = Nees.of(errors(self._places, self._true_places), of_landmarks)
        found = Nees.of(off[-1:], covariances[-1:]), Nees.of(off, covariances), seen
        text = f"of positions, seen from the line between keyframes {first} and {last}: the truth has no heading"
        return found, text

    def _saved(self) -> SavedGraph:
        """Return the graph of the run; from now on only keyframes that are in it count."""
        saved = SavedGraph(self._run, [])
        self._with_truth = np.intersect1d(self._with_truth, saved.numbers)
        if not len(self._with_truth):
            raise GraphSlamError(f"{self._run}: no keyframe with a truth is in the graph: visits were condensed")
        return saved

    def _some(self) -> Array:
        """The keyframes with truth, at most so many as are computed, the first and last among them."""
        known = self._with_truth
        return known[np.unique(np.linspace(0, len(known) - 1, min(_MOST, len(known))).astype(int))]


def _why_no_nees(known: Truth, true: Array, *, is_first: bool, is_held: bool, is_planar: bool) -> str:
    """Return why errors and covariances cannot be compared; empty if they can."""
    if is_held:
        return "fixes hold the map, not its first pose, and how their frame lies in that of the truth is not known"
    if not is_first:
        return "the map was there before the drive, so the first pose of the drive does not hold it"
    if np.count_nonzero(np.isfinite(true).all(axis=1)) < 2:
        return "fewer than two keyframes have a truth within 0.05 s"
    if not (known.trajectory.has_orientation or is_planar):
        return f"{known.source} has no orientation, which says how the map lies in its frame"
    return ""


def _left_out(
    last: Nees | None, poses: Nees | None, of_landmarks: Nees | None, known: Truth, landmarks: int
) -> dict[str, str]:
    out = {}
    if poses is None:
        out["poses"] = "none but the first has a truth within 0.05 s and a covariance"
    elif last is None:
        out["last pose"] = "it has no truth within 0.05 s, or no covariance"
    if of_landmarks is None and landmarks:
        why = "none of them has a covariance and is among the true ones"
        out["landmarks"] = why if known.landmarks else "the truth has none (/landmarks_ground_truth)"
    return out


def _noise(run: Path) -> tuple[bool, tuple[NoiseScale, ...]]:
    """Return whether fixes or surveyed landmarks hold the map, and the noise estimated, by the summary of a run."""
    try:
        summary = summary_of(run)
        is_held = bool({"fixes", "surveyed"} & set(summary["classes"]))
        return is_held, tuple(NoiseScale.from_dict(one) for one in summary.get("noise", ()))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"not a summary of a run ({message_of(error)}): graph_slam replay {run} --out NEW makes one"
        raise GraphSlamError(f"{run / SUMMARY}: {why}") from None
