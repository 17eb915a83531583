"""The anchor of the map: a prior on the first keyframe, which gives way to what measures where the map lies.

A fix or a surveyed landmark has its own frame. The first one moves the whole map rigidly onto itself, and from then on
the prior is loose in every direction that such a measurement determines. Parameters that are set are never loosened.
"""

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.survey import Surveyed
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.types import Fix
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.motion_compensation import as_matrix, axes_unknown
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_RAD
from graph_slam_ros.typing import Array, Numbers

TIGHT = 1e-3  # m, rad: the map begins where odometry begins, which is as good as any other place
_UNCERTAIN_M = 1e3  # anywhere in a town
_TILT_RAD = 0.3  # of odometry in space, whose z axis points up; positions do not tell it before the robot has moved


class Anchor:
    """The prior on the first keyframe.

    Parameters
    ----------
    backend : its graph gets the prior
    """

    def __init__(self, config: Config, backend: Backend) -> None:
        self._config, self._space = config, config.space
        self._backend, self._graph = backend, backend.graph
        self._edge = self._vertex = -1
        self._sigmas = np.full(self._space.dof, np.inf)  # along and about the axes of map; infinite: there is none

    def begin(self, vertex: int, T_map_base: Numbers) -> Array:
        """Add the prior of the first keyframe. Returns its covariance (dof, dof)."""
        settings = self._config.anchor
        self._sigmas = np.array(self._space.sigmas(settings.sigma_m or TIGHT, settings.sigma_rad or TIGHT))
        self._add(vertex, T_map_base, Gaussian.from_sigmas(*self._sigmas))
        return np.diag(np.square(self._sigmas))

    def restore(self) -> None:
        """Continue with the prior of a loaded map, if it can still be loosened: not with one that was set by hand."""
        self._edge = self._vertex = -1
        self._sigmas = np.full(self._space.dof, np.inf)
        for edge in self._graph.edges_of("anchor").tolist():
            one = self._graph.edge(edge)
            (vertex,) = one.vertices
            if vertex >= self._backend.frozen and not self._backend.ledger.is_withdrawn(edge):
                root, at = one.sqrt_information, tuple(one.measured.tolist())
                tangent = np.asarray(np.linalg.inv(root.T @ root), dtype=np.float64)
                covariance = self._space.in_parent_axes(at, tangent)
                self._edge, self._vertex, self._sigmas = edge, vertex, np.sqrt(np.diag(covariance))

    @property
    def is_located(self) -> bool:
        """Return whether the map is in the frame of surveys and fixes, by its start or by one of them."""
        is_given = self._config.start_pose is not None or self._config.anchor.sigma_m > 0.0
        return is_given or bool((self._sigmas[: self._space.dimensions] > TIGHT).all())

    def align_to_fix(self, m: Fix, T_map_base: Numbers) -> bool:
        """Loosen the prior for a more precise fix. Returns whether the map has moved.

        Parameters
        ----------
        T_map_base : where the robot is thought to be at the fix's stamp
        """
        looser = self._looser(self._determined_by(m))
        return looser is not None and self._move(self._onto_fix(m, T_map_base), looser)

    def align_to_landmark(self, known: Surveyed, at: Array) -> bool:
        """Loosen the prior for a surveyed landmark, as for a fix; returns whether the map has moved.

        Parameters
        ----------
        at : the landmark's estimate: a pose where its orientation counts, else a position (n,)
        """
        n, group = self._space.dimensions, self._space.group
        wanted = self._position()
        T_new_old = self._shifted(np.array(known.position) - at[:n])
        if len(at) > n and not self._config.anchor.sigma_rad:
            wanted[n:] = JUMP_SIGMA_RAD
            T_new_old = _floats(group.compose(known.pose, group.inverse(tuple(at.tolist()))))
        looser = self._looser(wanted)
        return looser is not None and self._move(T_new_old, looser)

    # -- how far ---------------------------------------------------------------------------------------------------

    def _looser(self, wanted: Array) -> Array | None:
        """Sigmas (dof,) with the wanted ones added; None if nothing changes."""
        settings, n = self._config.anchor, self._space.dimensions
        if self._config.start_pose is not None:  # somebody has said roughly where the robot starts
            roughly = self._config.initialpose
            wanted = np.minimum(wanted, self._space.sigmas(roughly.sigma_m, roughly.sigma_rad))
        wanted = np.where([bool(settings.sigma_m)] * n + [bool(settings.sigma_rad)] * (len(wanted) - n), 0.0, wanted)
        return np.maximum(self._sigmas, wanted) if (wanted > self._sigmas).any() else None

    def _position(self) -> Array:
        """The sigmas (dof,) that positions determine."""
        n, angles = self._space.dimensions, self._space.dof - self._space.dimensions
        return np.array([_UNCERTAIN_M] * n + [_TILT_RAD] * (angles - 1) + [JUMP_SIGMA_RAD])

    def _determined_by(self, m: Fix) -> Array:
        """The sigmas (dof,) that a fix determines, by its kind; zero for those that it does not."""
        space, n = self._space, self._space.dimensions
        out = self._position()
        match m.kind:
            case "pose":
                out[n:] = JUMP_SIGMA_RAD
            case "attitude":
                out[:n], out[n:] = 0.0, JUMP_SIGMA_RAD
            case "heading":
                out[:-1] = 0.0
            case _:
                unknown = axes_unknown(as_matrix(m.covariance))
                out[:n][unknown] = 0.0
                out[n:] *= not unknown[:2].any()
                out[n:-1] *= not unknown.any()
        return out if m.kind in space.fixes else np.zeros(space.dof)

    # -- the map moves ---------------------------------------------------------------------------------------------

    def _onto_fix(self, m: Fix, T_map_base: Numbers) -> Numbers:
        """``T_new_old`` of a map that agrees with the fix, in the directions that the fix determines."""
        space, group, n = self._space, self._space.group, self._space.dimensions
        if m.kind == "pose":
            return _floats(group.compose(m.measured, group.inverse(T_map_base)))
        if m.kind == "position":
            there = np.array(group.act(T_map_base, m.point or (0.0,) * n))
            shift = np.array(m.measured) - there
            shift[axes_unknown(as_matrix(m.covariance))] = 0.0
            return self._shifted(shift)
        if m.kind == "attitude":
            turn = group.compose(
                (*space.identity[:n], *m.measured), group.inverse((*space.identity[:n], *T_map_base[n:]))
            )
            return self._turned(turn)
        return self._turned(_about_z(space, m.measured[0] - space.heading(T_map_base)))

    def _shifted(self, shift: Array) -> Numbers:
        return (*map(float, shift), *self._space.identity[self._space.dimensions :])

    def _turned(self, turn: Numbers) -> Numbers:
        """The rotation about the first keyframe, as a motion of the map."""
        n = self._space.dimensions
        at = self._backend.solver.estimate([self._vertex])[0, :n]
        there = np.array(self._space.group.act(turn, tuple(at.tolist())))
        return (*map(float, at - there), *turn[n:])

    def _move(self, T_new_old: Numbers, sigmas: Array) -> bool:
        """Move the map, unless its start is given, and replace the prior by a looser one."""
        moves = self._config.start_pose is None
        if moves:
            self._backend.move(T_new_old)
        self._backend.hand_over()
        self._backend.withdraw([self._edge])
        self._sigmas = sigmas
        begins = self._backend.solver.estimate([self._vertex])[0] if moves else self._graph.edge(self._edge).measured
        at = tuple(begins.tolist())
        covariance = self._space.in_tangent(at, np.diag(np.square(sigmas)))
        self._add(self._vertex, at, Gaussian.from_covariance(covariance))
        return moves

    def _add(self, vertex: int, T_map_base: Numbers, noise: Gaussian) -> None:
        self._vertex = vertex
        self._edge = self._graph.add_edge(self._space.pose_prior, [vertex], T_map_base, noise, "anchor")


def _about_z(space: Geometry, angle: float) -> Numbers:
    if space.dimensions == 2:
        return 0.0, 0.0, angle
    return 0.0, 0.0, 0.0, 0.0, 0.0, float(np.sin(0.5 * angle)), float(np.cos(0.5 * angle))


def _floats(numbers: tuple[float, ...]) -> Numbers:
    return tuple(map(float, numbers))
