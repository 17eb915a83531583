"""SE-Sync's certificate of a solved graph: if it applies, its verdict, and how near the two problems' optima are."""

from dataclasses import asdict, dataclass
from math import isnan, nan
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import POSE_PRIOR, POSE_PRIOR_3D, SE2, SE3, Graph
from graph_slam_ros.optimization import Solution
from graph_slam_ros.slam.landmarks.rotations import aligned
from graph_slam_ros.solver import Solver
from graph_slam_ros.tools.certificate.spectrum import least_eigenvalue, polish
from graph_slam_ros.tools.certificate.synchronization import RELATIVE, Poses, Synchronization
from graph_slam_ros.typing import Array

CERTIFIED, NOT_CERTIFIED, DOES_NOT_APPLY = "certified", "not certified", "does not apply"

_ANCHORS = (POSE_PRIOR, POSE_PRIOR_3D)
_MOST_ANISOTROPY = 1.5
_MOST_SIGMAS = 3.0
_GAP = 1e-6  # of the cost: what may be left between it and its bound
_ROUNDING = 1e3 * float(np.finfo(float).eps)  # of the largest diagonal entry: an eigenvalue's, and that of pivots
_SAME = 1e-9  # of chi2: no loss has counted


@dataclass(frozen=True, slots=True)
class Certificate:
    """The verdict on the global optimum. Numbers are NaN where they are not known.

    Attributes
    ----------
    verdict : ``certified``, ``not certified`` or ``does not apply``
    reason : why it does not apply; empty where it does
    lambda_min, tolerance : smallest eigenvalue of ``S = Q - Lambda``, and how far below zero it may be
    cost : chordal cost F at its critical point near the estimate
    cost_bound : what F is at least, at any poses: ``tr(Lambda) + d n lambda_min``, by duality
    chi2, chi2_bound : of the estimate, and what chi2 is at least at any poses, told from ``cost_bound``: near to it
        where noise is isotropic
    moved_max_m, moved_rms_m : distance from the estimate to the critical point, best aligned, of positions
    moved_sigmas : the same of the pose it is largest of, as ``sqrt(e' Sigma^-1 e)``, where the poses that hold the maps
        agree
    """

    verdict: str
    reason: str = ""
    lambda_min: float = nan
    tolerance: float = nan
    cost: float = nan
    cost_bound: float = nan
    chi2: float = nan
    chi2_bound: float = nan
    moved_max_m: float = nan
    moved_rms_m: float = nan
    moved_sigmas: float = nan

    @property
    def computed(self) -> bool:
        """Return whether the eigenvalue was computed, whatever it is worth."""
        return not isnan(self.lambda_min)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, None for what is not known."""
        return {k: None if isinstance(v, float) and isnan(v) else v for k, v in asdict(self).items()}

    def __str__(self) -> str:
        lines = [self.verdict + (f": {self.reason}" if self.reason else "")]
        if self.computed:
            sign = ">=" if self.lambda_min >= -self.tolerance else "<"
            gap = max(0.0, self.cost - self.cost_bound)
            lines += [
                f"  lambda_min     {self.lambda_min:.3e} {sign} {-self.tolerance:.1e}",
                f"  chordal cost   {self.cost:.6f}, at most {gap:.2g} above the least there is",
                f"  its optimum    {self.moved_max_m:.2g} m from here, {self.moved_rms_m:.2g} m RMS,"
                f" {self.moved_sigmas:.2g} sigma",
                f"  chi2           {self.chi2:.6f}, at any poses at least {self.chi2_bound:.6f}",
            ]
        return "\n".join(lines)


def certify(solution: Solution) -> Certificate:
    """Certify that a solved graph of relative poses is at the global optimum.

    The certificate belongs to SE-Sync's cost, which is chordal and isotropic (``precisions``). So its critical
    point near the estimate is found (``polish``) and certified: where ``S = Q - Lambda`` has no negative eigenvalue, by
    duality no poses have a lower cost (Rosen et al. 2019, Carlone et al. 2015, 2016). That the estimate is this point,
    but for the difference of the two costs, is told by their distance.

    It does not apply to graphs with landmarks, with more than one anchor, in several parts, or with anisotropic
    translations, to robust losses, and where the critical point is more than 3 sigma away. What is not certified may be
    optimal all the same: with very large noise the relaxation is not tight.
    """
    if not isinstance(solution, Solution):
        raise GraphSlamError(f"certify takes a solution, not a {type(solution).__name__}: certify(optimize(...))")
    graph = solution.file.graph
    if reason := _no_relative_poses(graph):
        return Certificate(DOES_NOT_APPLY, reason)
    problem, anchors = Synchronization.of(graph), _anchors(solution)
    if reason := _ill_fitting(solution, problem, anchors):
        return Certificate(DOES_NOT_APPLY, reason)
    root = anchors[0] if anchors else int(np.argmin(solution.file.ids))
    estimate = solution.solver.estimate(np.arange(graph.vertex_count))
    here = Poses.of(estimate)
    here = Poses(here.rotations, here.positions - here.positions[root])  # maps far from their origin lose digits
    there = polish(problem, here, root)
    d, n = problem.dimensions, problem.poses
    rounding = _ROUNDING * float(problem.data_matrix().diagonal()[n:].max())
    tolerance = max(_GAP * there.cost / (d * n), rounding)
    lambda_min = least_eigenvalue(problem.certificate_matrix(there.poses, root), n - 1, tolerance)
    if isnan(lambda_min):
        return Certificate(DOES_NOT_APPLY, "weights differ by so much that the certificate matrix cannot be factorised")
    multipliers = float(np.trace(problem.multipliers(there.poses), axis1=1, axis2=2).sum())
    bound = max(0.0, min(multipliers + d * n * min(0.0, lambda_min), there.cost))
    distance = _distances(here.positions, there.poses.positions)
    sigmas = _sigmas(graph, estimate, here, there.poses, root)
    verdict = CERTIFIED if lambda_min >= -tolerance else NOT_CERTIFIED
    if not there.converged and verdict == NOT_CERTIFIED:
        reason = "no critical point of the chordal cost was reached"
    if not sigmas <= _MOST_SIGMAS:
        verdict, reason = DOES_NOT_APPLY, _too_far(sigmas, verdict)
    return Certificate(
        verdict,
        reason,
        lambda_min,
        tolerance,
        there.cost,
        bound,
        solution.report.chi2_final,
        bound * problem.least_share(),
        float(distance.max()),
        float(np.sqrt((distance**2).mean())),
        sigmas,
    )


def _no_relative_poses(graph: Graph) -> str:
    """The reason why a graph is none of poses and relative poses, priors aside, or an empty string."""
    others = [kind.name for kind in graph.kinds if kind not in (SE2, SE3)]
    if others:
        return f"there are landmarks: vertices of kind {others[0]}"
    if len(graph.kinds) > 1:
        return "there are poses in the plane and in space"
    count = {edge: int(np.count_nonzero(table.weight.values)) for edge, table in graph.tables.items()}
    for edge, edges in count.items():
        if edges and edge not in RELATIVE + _ANCHORS:
            return f"there are {edges} edges of type {edge.name!r}, which is no relative pose"
    return "" if any(count.get(edge) for edge in RELATIVE) else "there are no relative poses"


def _anchors(solution: Solution) -> list[int]:
    """The poses that FIX lines hold or that have a prior, once for each."""
    tables = solution.file.graph.tables
    out = sorted(set(solution.file.fixed))
    for edge in _ANCHORS:
        if edge in tables:
            weighted = np.flatnonzero(tables[edge].weight.values)
            out += tables[edge].at(weighted).vertices[:, 0].tolist()
    return out


def _ill_fitting(solution: Solution, problem: Synchronization, anchors: list[int]) -> str:
    """The reason why SE-Sync's cost is far from what was minimised, or an empty string."""
    report, n = solution.report, problem.poses
    links = coo_array((np.ones(len(problem.ends)), tuple(problem.ends.T)), shape=(n, n))
    parts, _ = connected_components(links, directed=False)
    if parts > 1:
        return f"the relative poses leave the graph in {parts} parts"
    if len(anchors) > 1:
        return f"the graph has {len(anchors)} anchors (FIX lines and priors): relative poses may have one"
    if abs(report.cost_final - report.chi2_final) > _SAME * report.chi2_final:
        return "a robust loss was minimised"
    ratio = problem.anisotropy()
    beyond = int(np.count_nonzero(ratio > _MOST_ANISOTROPY))
    if beyond:
        i, j = (solution.file.ids[v] for v in problem.ends[ratio.argmax()].tolist())
        return (
            f"{beyond} of {len(ratio)} edges have anisotropic translations (information up to {ratio.max():.3g} to 1,"
            f" between vertices {i} and {j}; up to {_MOST_ANISOTROPY:g} counts as isotropic)"
        )
    return ""


def _too_far(sigmas: float, verdict: str) -> str:
    if isnan(sigmas):
        return "the covariances are not determined"
    at_most = f"at most {_MOST_SIGMAS:g} may be between the two"
    return f"the nearest optimum of the chordal cost, {verdict}, is {sigmas:.3g} sigma away; {at_most}"


def _distances(a: Array, b: Array) -> Array:
    """The distances of points (n, d), after the rigid motion of b that makes their squares least."""
    turn, shift = aligned(b, a)
    return np.asarray(np.linalg.norm(b @ turn.T + shift - a, axis=1))


def _sigmas(graph: Graph, estimate: Array, here: Poses, there: Poses, root: int) -> float:
    """The largest of ``sqrt(e' Sigma^-1 e)`` of all poses, Sigma being what the root's place leaves open of each."""
    solver = Solver(graph)
    tables = [table for kind, table in graph.tables.items() if kind in RELATIVE]
    edges = [table.at(np.flatnonzero(table.weight.values)).ids for table in tables]
    others = np.delete(np.arange(graph.vertex_count), root)
    try:
        solver.add(np.arange(graph.vertex_count), np.sort(np.concatenate(edges)))
        solver.start_at(estimate.ravel())
        solver.hold(root)
        covariances = np.array(solver.marginal(others))
        errors = _local(here, there)[others]
        squares = np.einsum("ia,ia->i", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
    except (GraphSlamError, np.linalg.LinAlgError):
        return nan
    return float(np.sqrt(squares.max(initial=0.0)))


def _local(a: Poses, b: Poses) -> Array:
    """Steps (n, dof) from a to b in the tangent spaces of a, with their positions apart as they are in a's frames."""
    back = np.swapaxes(a.rotations, 1, 2)
    turn = back @ b.rotations
    moved = (back @ (b.positions - a.positions)[:, :, None])[:, :, 0]
    if moved.shape[1] == 2:
        return np.hstack([moved, np.arctan2(turn[:, 1, 0], turn[:, 0, 0])[:, None]])
    return np.hstack([moved, Rotation.from_matrix(turn).as_rotvec()])


def certified(solution: Solution) -> tuple[Certificate, int, str]:
    """Return the certificate of a solution, its exit code, and its lines for a person, for ``optimize``."""
    found = certify(solution)
    codes = {CERTIFIED: console.DONE, NOT_CERTIFIED: console.NOT_CERTIFIED}
    again = found.verdict == NOT_CERTIFIED and solution.start != "chordal"
    more = "\nanother start may lead to a lower optimum: --init chordal" if again else ""
    return found, codes.get(found.verdict, console.NOT_APPLICABLE), f"{found}{more}"
