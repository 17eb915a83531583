"""SE-Sync's problem: poses whose relative rotations and translations fit what was measured best, in the chordal sense.

With n poses in d dimensions, X = [t_1 .. t_n R_1 .. R_n] (d x (1 + d)n), and for each edge measured R, t::

    F(X) = sum kappa |R_j - R_i R|^2 + tau |t_j - t_i - R_i t|^2 = tr(X M X')

which is Problem 1 of Rosen et al. (2019), and with M its Problem 2. Arrays hold X', one row for each column of X.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csc_array

from graph_slam_ros.graph import INVERSE_RELATIVE_POSE, RELATIVE_POSE, RELATIVE_POSE_3D, Graph
from graph_slam_ros.lie import so3
from graph_slam_ros.typing import Array, Index

RELATIVE = (RELATIVE_POSE, INVERSE_RELATIVE_POSE, RELATIVE_POSE_3D)


@dataclass(frozen=True, slots=True)
class Poses:
    """Rotations (n, d, d) and positions (n, d)."""

    rotations: Array
    positions: Array

    @classmethod
    def of(cls, values: Array) -> "Poses":
        """Make them from stored numbers (n, 3) or (n, 7)."""
        if values.shape[1] == 3:
            c, s = np.cos(values[:, 2]), np.sin(values[:, 2])
            return cls(np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1), values[:, :2])
        return cls(np.moveaxis(np.asarray(so3.matrix(tuple(values[:, 3:].T))), -1, 0), values[:, :3])

    def columns(self) -> Array:
        """``X'``, (n + dn, d)."""
        d = self.positions.shape[1]
        return np.vstack([self.positions, np.swapaxes(self.rotations, 1, 2).reshape(-1, d)])


@dataclass(frozen=True)
class Synchronization:
    """SE-Sync's problem on n poses that m edges join: the relative poses of a graph that have a weight.

    Attributes
    ----------
    poses : n
    ends : (m, 2) which poses
    measured : rotations and positions of the edges
    information : (m, p, p) of each, times its weight
    kappa, tau : (m,) precisions of rotation and translation, see ``precisions``
    """

    poses: int
    ends: Index
    measured: Poses
    information: Array
    kappa: Array
    tau: Array

    @classmethod
    def of(cls, graph: Graph) -> "Synchronization":
        """Make the problem of a graph whose poses are all of one kind, and which has relative poses."""
        ends, measured, information = [], [], []
        for table in (graph.tables[edge] for edge in RELATIVE if edge in graph.tables):
            some = table.at(np.flatnonzero(table.weight.values))
            root = some.sqrt_information
            ends.append(some.vertices)
            measured.append(some.measured)
            information.append((np.swapaxes(root, 1, 2) @ root) * some.weight[:, None, None])
        of_all = np.concatenate(information)
        poses = Poses.of(np.concatenate(measured))
        return cls(graph.vertex_count, np.concatenate(ends), poses, of_all, *precisions(of_all))

    @property
    def dimensions(self) -> int:
        """The dimensions of the space that the poses are in: 2 or 3."""
        return int(self.measured.positions.shape[1])

    def anisotropy(self) -> Array:
        """Largest over smallest eigenvalue of each translation's information, (m,)."""
        d = self.dimensions
        values = np.linalg.eigvalsh(self.information[:, :d, :d])
        return np.asarray(values[:, -1] / values[:, 0])

    def least_share(self) -> float:
        """The largest c such that chi2 >= c F at all poses: 1 where all noise is isotropic, in space and in the plane.

        An angle squared is at least half of |R - 1|^2, so it is where each information is at least c times the
        isotropic one: c is the smallest eigenvalue of the one relative to the other.
        """
        d, size = self.dimensions, self.information.shape[1]
        root = np.sqrt(np.where(np.arange(size) < d, self.tau[:, None], 2.0 * self.kappa[:, None]))
        relative = self.information / root[:, :, None] / root[:, None, :]
        return float(np.linalg.eigvalsh(relative)[:, 0].min())

    @cached_property
    def root(self) -> csc_array:
        """``A`` with ``M = A'A``: rows are whitened residuals, of translations, then of rotations' rows."""
        d, m = self.dimensions, len(self.ends)
        i, j = self.ends.T
        weight, turn = np.sqrt(self.tau), np.sqrt(self.kappa)
        edge = np.arange(m)
        entries = [(weight, edge, j), (-weight, edge, i)]
        for a in range(d):
            of_i = self.poses + d * i + a
            entries.append((-weight * self.measured.positions[:, a], edge, of_i))
            entries.append((turn, m + d * edge + a, self.poses + d * j + a))
            entries += [(-turn * self.measured.rotations[:, a, b], m + d * edge + b, of_i) for b in range(d)]
        data, rows, columns = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        return coo_array((data, (rows, columns)), shape=((1 + d) * m, (1 + d) * self.poses)).tocsc()

    def data_matrix(self) -> csc_array:
        """``M``: the Laplacian of translations, their coupling to rotations, and the rotations' own."""
        return (self.root.T @ self.root).tocsc()

    def cost(self, x: Poses) -> float:
        """``F``."""
        residual = self.root @ x.columns()
        return float((residual * residual).sum())

    def multipliers(self, x: Poses) -> Array:
        """``Lambda`` (n, d, d), the symmetric part of ``R_i' (X M)_i``; at a critical point there is no other.

        Where the positions are optimal for the rotations, the traces of all add up to F.
        """
        d = self.dimensions
        gradient = (self.root.T @ (self.root @ x.columns()))[self.poses :].reshape(self.poses, d, d)
        product = gradient @ x.rotations  # of the transposed gradient, so transposed itself
        return np.asarray(0.5 * (product + np.swapaxes(product, 1, 2)))

    def certificate_matrix(self, x: Poses, root: int) -> csc_array:
        """``M - diag(0, Lambda)`` without the root's position, (n - 1 + dn) squared.

        Its Schur complement in the rotations is ``S = Q - Lambda`` of Rosen et al. (2019), which is dense.
        """
        d, n = self.dimensions, self.poses
        at = n + d * np.arange(n)[:, None] + np.arange(d)
        matrix = (self.data_matrix() - _blocks(self.multipliers(x), at, (1 + d) * n)).tocsc()
        free = np.delete(np.arange((1 + d) * n), root)
        return matrix[free][:, free].tocsc()

    def newton(self, x: Poses, root: int) -> tuple[csc_array, Array, Array]:
        """H, g, and the diagonal of ``J'J``: ``F(x [+] s) = F + 2 s'g + s'Hs + ..`` with ``t + u`` and ``R Exp(w)``.

        A step is ``s = (u, w)`` of all poses but the root: moves of position, then turns, pose by pose.

        ``H = J'J - C``: beside the first derivatives of the residuals, J, what turning does to second order,
        ``C_kl = <G_k Lambda_i, G_l>`` with the generators G, which is Hess F of Rosen et al. (2019), eq. (44) of their
        report, in coordinates.
        """
        d, m = self.dimensions, len(self.ends)
        g = generators(d)
        dof = d + len(g)
        i, j = self.ends.T
        weight, turn = np.sqrt(self.tau)[:, None], np.sqrt(self.kappa)[:, None, None]
        measured = self.measured
        r_i, r_j = x.rotations[i], x.rotations[j]
        residual = np.empty((m, d + d * d))
        step = np.einsum("eab,eb->ea", r_i, measured.positions)
        residual[:, :d] = weight * (x.positions[j] - x.positions[i] - step)
        residual[:, d:] = (turn * (r_j - r_i @ measured.rotations)).reshape(m, d * d)
        jacobian = np.zeros((m, d + d * d, 2 * dof))
        jacobian[:, :d, :d] = -weight[:, :, None] * np.eye(d)
        jacobian[:, :d, dof : dof + d] = weight[:, :, None] * np.eye(d)
        for k, generator in enumerate(g):
            moved = r_i @ generator
            jacobian[:, :d, d + k] = -weight * np.einsum("eab,eb->ea", moved, measured.positions)
            jacobian[:, d:, d + k] = -(turn * (moved @ measured.rotations)).reshape(m, d * d)
            jacobian[:, d:, dof + d + k] = (turn * (r_j @ generator)).reshape(m, d * d)
        at = np.hstack([dof * i[:, None] + np.arange(dof), dof * j[:, None] + np.arange(dof)])
        size = dof * self.poses
        first = _blocks(np.swapaxes(jacobian, 1, 2) @ jacobian, at, size)
        turns = dof * np.arange(self.poses)[:, None] + np.arange(d, dof)
        second = np.einsum("kab,ibc,lac->ikl", g, self.multipliers(x), g)
        of_edges = np.einsum("erk,er->ek", jacobian, residual)
        gradient = np.bincount(at.ravel(), of_edges.ravel(), size).astype(np.float64)
        free = np.delete(np.arange(size), np.arange(dof * root, dof * (root + 1)))
        hessian = (first - _blocks(second, turns, size)).tocsc()[free][:, free]
        return hessian.tocsc(), gradient[free], first.diagonal()[free]

    def retract(self, x: Poses, step: Array, root: int) -> Poses:
        """Poses after a step of all but the root. A rotation moves on by the polar factor of ``R (1 + W)``."""
        d = self.dimensions
        g = generators(d)
        at_root = np.full(d + len(g), root * (d + len(g)))
        steps = np.insert(step, at_root, 0.0).reshape(self.poses, -1)
        turned = x.rotations @ (np.eye(d) + np.einsum("kab,ik->iab", g, steps[:, d:]))
        u, _, vt = np.linalg.svd(turned)
        return Poses(u @ vt, x.positions + steps[:, :d])


def precisions(information: Array) -> tuple[Array, Array]:
    """``kappa`` and ``tau`` (m,): the isotropic precisions of rotation and translation.

    They come from the traces of the covariances, as SE-Sync takes them from graphs in space: ``tau = d / tr``, and
    ``kappa = p / (2 tr)`` with p the degrees of freedom of a rotation, that of the isotropic Langevin distribution
    nearest to the Gaussian one. Then F and chi2 agree to second order, as |R - 1|^2 is twice the angle squared.
    (Its reader of graphs in the plane has twice that kappa.)
    """
    d = 2 if information.shape[1] == 3 else 3
    of_translation, of_rotation = information[:, :d, :d], information[:, d:, d:]
    tau = d / np.trace(np.linalg.inv(of_translation), axis1=1, axis2=2)
    kappa = 0.5 * of_rotation.shape[1] / np.trace(np.linalg.inv(of_rotation), axis1=1, axis2=2)
    return kappa, tau


def generators(dimensions: int) -> Array:
    """Skew matrices G_k with ``Exp(w) = expm(sum w_k G_k)``, (1, 2, 2) or (3, 3, 3)."""
    if dimensions == 2:
        return np.array([[[0.0, -1.0], [1.0, 0.0]]])
    return np.array([so3.hat((float(a), float(b), float(c))) for a, b, c in np.eye(3)])


def _blocks(values: Array, at: Index, size: int) -> csc_array:
    """A square matrix that small symmetric blocks (n, k, k) at indices (n, k) add up to."""
    rows, columns = np.broadcast_arrays(at[:, :, None], at[:, None, :])
    return coo_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsc()
