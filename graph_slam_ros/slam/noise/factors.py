"""The noise of edges: the configured noise times factors, by class of edges, input and part of the residual.

Odometry errs with each radian turned and each metre driven, which configured noise may not say. So the variance of an
odometry edge is the configured one times a factor, plus a variance per radian and per metre.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from graph_slam_ros.graph import EdgeType, Gaussian, Graph
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.slam.levels import ROUNDING
from graph_slam_ros.typing import Array, Index

CLASSES = ("odometry", "landmarks", "fixes", "closures")
FIRST_DUE = 50  # keyframes
LEAST_CHANGE = 0.02  # of a sigma: less changes nothing

PER_RAD, PER_M = " per rad", " per m"

Key = tuple[str, str, str]
"""Class of edges, input, part of the residual; of odometry with ``PER_RAD`` or ``PER_M`` a variance that is added."""


def grows(edge: EdgeType, label: str) -> bool:
    """Return whether the noise of these edges grows with the measured motion."""
    return label == "odometry" and edge.name.removesuffix(" 3D") == "relative pose"


def motion_sizes(measured: Array) -> tuple[Array, Array]:
    """Return radians turned and metres driven, each (n,), by motions (n, 3) or (n, 7)."""
    if measured.shape[1] == 3:
        return np.abs(measured[:, 2]), np.hypot(measured[:, 0], measured[:, 1])
    turned = 2.0 * np.arctan2(np.linalg.norm(measured[:, 3:6], axis=1), np.abs(measured[:, 6]))
    return turned, np.linalg.norm(measured[:, :3], axis=1)


def components(factors: Mapping[str, float], part: str) -> Array:
    """Return the variance (3,) of a part of odometry for each of its configured variance, radian turned and metre."""
    return np.array([factors.get(part, 1.0) ** 2, factors.get(part + PER_RAD, 0.0), factors.get(part + PER_M, 0.0)])


def grown_with(variance: Array, measured: Array, now: Array) -> Array:
    """Return what the variance (n,) of motions grew with (n, 3): what is configured, radians turned, metres driven.

    Parameters
    ----------
    now : (3,) the components that the variance has
    """
    sizes = np.stack(motion_sizes(measured), axis=1)
    own = np.maximum(variance - sizes @ now[1:], ROUNDING * variance) / now[0]
    return np.column_stack((own, sizes))


def parts_of(edge: EdgeType, measured: Array) -> dict[str, Array]:
    """Split the residual of edges into parts: orthonormal directions (n, m, k) of each.

    Parameters
    ----------
    measured : (n, p) what was measured
    """
    n, m = len(measured), edge.residual_size
    axes = np.broadcast_to(np.eye(m), (n, m, m))
    name = edge.name.removesuffix(" 3D")
    if name in ("landmark position", "tag position"):
        return _sight_parts(measured[:, :m])
    if name == "range and bearing":
        return {"range": axes[:, :, :1], "bearing": axes[:, :, 1:]}
    if name in ("relative pose", "pose prior"):
        d = {3: 2, 6: 3}[m]
        return {"position": axes[:, :, :d], "rotation": axes[:, :, d:]}
    if name.startswith("range") or name == "bearing":
        return {name.split()[0]: axes}
    return {"all": axes}


def motion_parts(edge: EdgeType, measured: Array, roots: Array) -> dict[str, Array]:
    """Split the residual of odometry's edges into parts: directions (n, m, k) of each, that are independent.

    A wrong heading at the begin of an edge moves its end sideways, so errors of position and rotation are correlated,
    often nearly to one. That is geometry: it does not change with the noise. ``position`` is therefore what is left of
    the position if the rotation is known. Its directions are not orthonormal.

    Parameters
    ----------
    roots : (n, m, m) square roots of the information
    """
    parts = parts_of(edge, measured)
    information = np.swapaxes(roots, 1, 2) @ roots
    d = parts["position"].shape[2]
    given_rotation = np.linalg.solve(information[:, :d, :d], information[:, :d, d:])
    directions = parts["position"].copy()
    directions[:, d:] = np.swapaxes(given_rotation, 1, 2)
    return parts | {"position": directions}


def _sight_parts(position: Array) -> dict[str, Array]:
    """Return the directions along the line of sight, and across it."""
    n, m = position.shape
    along = np.zeros((n, m))
    along[:, 0] = 1.0
    distance = np.linalg.norm(position, axis=1)
    seen = distance > 0.0
    along[seen] = position[seen] / distance[seen, None]
    # The reflection that takes the first axis onto the line of sight takes the others across it.
    normal = along.copy()
    normal[:, 0] += np.where(along[:, 0] >= 0.0, 1.0, -1.0)
    turned = (
        np.eye(m) - 2.0 * np.einsum("ni,nj->nij", normal, normal) / np.einsum("ni,ni->n", normal, normal)[:, None, None]
    )
    return {"range": along[:, :, None], "bearing": turned[:, :, 1:]}


def _rescale(graph: Graph, edges: range, before: Mapping[Key, float], after: Mapping[Key, float]) -> None:
    """Rescale edges from some factors to others. A solver that has used them must start over."""
    for table, rows, label, source in groups(graph, edges):
        own_before, own_after = of_group(before, label, source), of_group(after, label, source)
        if own_after:
            roots = table.sqrt_information.values
            measured = table.measured.values[rows]
            roots[rows] = _rescaled(table.type, label, measured, roots[rows], own_before, own_after)


class NoiseScales:
    """The factors of configured sigmas, and the graph whose edges agree with them.

    Attributes
    ----------
    graph
    factors : by group; a missing factor is 1
    due : the number of keyframes of the next estimate, and whether one follows at once
    """

    def __init__(self, graph: Graph, factors: Mapping[Key, float] | None = None) -> None:
        self.graph = graph
        self.factors: dict[Key, float] = dict(factors or {})
        self.due = FIRST_DUE, False

    def is_due(self, keyframes: int) -> bool:
        """Return whether the number of keyframes has doubled since the last estimate, or had at the call before.

        An estimate at other noise is another one. To repeat it at once would double the time of that update.
        """
        due, once_more = self.due
        has_doubled = keyframes >= due
        while keyframes >= due:
            due *= 2
        self.due = due, has_doubled
        return has_doubled or once_more

    def add_edge(
        self, edge: EdgeType, vertices: Sequence[int], measured: Sequence[float] | Array, noise: Gaussian, *names: str
    ) -> int:
        """Add an edge to the graph as ``Graph.add_edge`` does, its configured noise scaled."""
        label, source = (*names, "")[:2]
        factors = of_group(self.factors, label, source)
        if factors:
            z = edge.whole(np.asarray(measured, dtype=float)[None])
            noise = Gaussian(_rescaled(edge, label, z, noise.sqrt_information[None], {}, factors)[0])
        return self.graph.add_edge(edge, vertices, measured, noise, label, source)

    def change(self, factors: Mapping[Key, float], first_edge: int) -> bool:
        """Scale the edges from a number on, and all later ones, by these factors; return whether an edge changed."""
        before = {key: self.factors.get(key, neutral(key)) for key in factors}
        if all(_is_same(before[key], factor) for key, factor in factors.items()):
            return False
        _rescale(self.graph, range(first_edge, self.graph.edge_ids.next), before, factors)
        self.factors |= factors
        return True

    def neutral(self) -> dict[Key, float]:
        """Return factors of all groups that change nothing."""
        return {key: neutral(key) for key in self.factors}


def neutral(key: Key) -> float:
    """Return the factor, or the added variance, that changes nothing."""
    return 0.0 if key[2].endswith((PER_RAD, PER_M)) else 1.0


def _is_same(before: float, after: float) -> bool:
    return abs(after - before) <= LEAST_CHANGE * before


def of_group(factors: Mapping[Key, float], label: str, source: str) -> dict[str, float]:
    """Return the factors of the edges of a class and an input, by part."""
    return {part: factor for (one, other, part), factor in factors.items() if (one, other) == (label, source)}


def _rescaled(
    edge: EdgeType, label: str, measured: Array, roots: Array, before: Mapping[str, float], after: Mapping[str, float]
) -> Array:
    """Return the square roots (n, m, m) of the information of edges by other factors of their noise."""
    if not grows(edge, label):
        narrower = np.zeros((len(measured), edge.residual_size, edge.residual_size))
        for part, axes in parts_of(edge, measured).items():
            ratio = after.get(part, 1.0) / before.get(part, 1.0)
            narrower += axes @ np.swapaxes(axes, 1, 2) / ratio
        return roots @ narrower
    into, scaled = list[Array](), list[Array]()
    for part, axes in motion_parts(edge, measured, roots).items():
        spread = np.linalg.solve(np.swapaxes(roots, 1, 2), axes)
        now = np.einsum("nij,nij->n", spread, spread)
        then = grown_with(now, measured, components(before, part)) @ components(after, part)
        into.append(np.swapaxes(axes, 1, 2))
        scaled.append(into[-1] / np.sqrt(then / now)[:, None, None])
    return roots @ np.linalg.solve(np.concatenate(into, axis=1), np.concatenate(scaled, axis=1))


def groups(graph: Graph, edges: range) -> Iterator[tuple[EdgeTable, Index, str, str]]:
    """Yield table, rows, class and input of each group of a range of edges."""
    for table in graph.tables.values():
        ids = table.ids
        here = (ids >= edges.start) & (ids < edges.stop)
        for code, label in enumerate(graph.labels):
            if label not in CLASSES:
                continue
            of_label = here & (table.label.values == code)
            for origin in np.unique(table.source.values[of_label]).tolist():
                rows = np.flatnonzero(of_label & (table.source.values == origin))
                yield table, rows, label, graph.sources[origin]


def factors_record(factors: Mapping[Any, float]) -> list[list[Any]]:
    """Return factors by their names as plain lists, for JSON."""
    return [[*key, factor] for key, factor in factors.items()]


def read_factors(factors: Sequence[Any]) -> dict[Key, float]:
    """Undo ``factors_record``. Raises ValueError if a factor is not positive."""
    out = {(str(label), str(source), str(part)): float(factor) for label, source, part, factor in factors}
    if not all(np.isfinite(factor) and (factor > 0.0 or factor == neutral(key)) for key, factor in out.items()):
        raise ValueError(f"a factor of the noise is not above 0: {factors}")
    return out
