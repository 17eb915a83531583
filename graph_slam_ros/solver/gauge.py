"""The gauge: relative measurements alone leave the whole free to move."""

from collections.abc import Mapping

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from graph_slam_ros.errors import GaugeError, SingularError
from graph_slam_ros.graph import GROUPS, R2, R3, SE2, SE3, Graph, VertexKind
from graph_slam_ros.graph.geometry import rigid_motions
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver.linearization import Losses, linearize
from graph_slam_ros.typing import Array, Index, Mask

_AXES = {SE2: 2, R2: 2, SE3: 3, R3: 3}
_NAMED = 20  # parts of a graph
_LEAST_EIGENVALUE = 1e-9  # of correlations: less is no information


def undetermined(graph: Graph, row: int) -> SingularError:
    """Return the error for a vertex, by its row, that the edges do not determine."""
    vertex = graph.vertex_ids.of(row)
    return SingularError(f"a pivot cannot be told from rounding: the edges do not determine vertex {vertex}", vertex)


def check_gauge(graph: Graph, free: Index, held: Index, rows: Mapping[EdgeTable, Index]) -> None:
    """Raise GaugeError unless each connected part has a held vertex or an edge on one vertex alone (a prior)."""
    fixed = np.zeros(graph.vertex_count, dtype=bool)
    fixed[held] = True
    sources, targets = [free[:0]], [free[:0]]
    for table, chosen in rows.items():
        at = table.vertex_rows.values[chosen]
        if at.shape[1] == 1:
            fixed[at[:, 0]] = True
        for slot in range(1, at.shape[1]):
            sources.append(at[:, 0])
            targets.append(at[:, slot])
    i, j = np.concatenate(sources), np.concatenate(targets)
    links = coo_array((np.ones(len(i)), (i, j)), shape=(graph.vertex_count, graph.vertex_count))
    _, part = connected_components(links, directed=False)
    floating = np.sort(free[~np.isin(part[free], part[fixed])])
    if len(floating):
        more = int((part[floating] == part[floating[0]]).sum()) - 1
        of = f"{graph.vertex_ids.of(int(floating[0]))}{f' and {more} more joined to it' if more else ''}"
        each = np.sort(floating[np.unique(part[floating], return_index=True)[1]])
        ends = " ".join(map(str, graph.vertex_ids.of_all(np.append(held[:1], each[:_NAMED])).tolist()))
        raise GaugeError(
            f"nothing fixes the gauge of vertex {of}: add a prior (an anchor) or hold a vertex (in a file: FIX {ends})"
        )


def fix_the_whole(graph: Graph, x: Array, rows: Mapping[EdgeTable, Index]) -> bool:
    """Return whether edges on one vertex alone together resist every rigid motion of the whole, at stored values x.

    One position leaves the heading undetermined, and one heading the position; several may fix both. In a graph without
    poses any such edge is enough.
    """
    alone = {table: chosen for table, chosen in rows.items() if len(table.type.accepts) == 1}
    axes = max((_AXES[kind] for kind in graph.kinds if kind in (SE2, SE3)), default=0)
    if not axes:
        return any(len(chosen) for chosen in alone.values())
    motions = axes + (1 if axes == 2 else 3)
    information, centre = np.zeros((motions, motions)), None
    for block in linearize(graph, x, alone, Losses(graph, {})):
        vertices = block.table.vertex_rows.values[block.rows, 0]
        for code in np.unique(graph.kind.values[vertices]):
            kind, mine = graph.kinds[code], graph.kind.values[vertices] == code
            if _AXES.get(kind) != axes:
                continue
            values = x[graph.offset.values[vertices[mine]][:, None] + np.arange(kind.size)]
            centre = values[0, :axes] if centre is None else centre
            moves = (block.jacobian[mine] @ _motions(kind, values, centre)).reshape(-1, motions)
            information += moves.T @ moves
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return False
    return bool(np.linalg.eigvalsh(information / np.outer(scale, scale))[0] > _LEAST_EIGENVALUE)


def _motions(kind: VertexKind, values: Array, centre: Array) -> Array:
    """Return steps (n, dof, 3 or 6) of vertices as the whole moves along each axis and turns about it at the centre."""
    count, axes = len(values), len(centre)
    position = rigid_motions(values[:, :axes] - centre).reshape(count, axes, -1)
    if kind not in GROUPS:
        return position
    to_body = GROUPS[kind].to_matrix(tuple(values.T))[:, :axes, :axes].swapaxes(1, 2)
    turned = np.ones((count, 1, 1)) if axes == 2 else to_body
    rotation = np.concatenate([np.zeros((count, turned.shape[1], axes)), turned], axis=2)
    return np.concatenate([to_body @ position, rotation], axis=1)


def degrees_of_freedom(graph: Graph, free: Index, held: Mask) -> int:
    """Return the measured numbers, without edges of weight 0, less the estimated numbers.

    Held vertices that have an edge among themselves, as those of a frozen map, were estimated by it before.

    Parameters
    ----------
    free : vertices that are estimated now; held : of each vertex, whether it is held
    """
    is_estimated, measured, any_held = np.zeros(graph.vertex_count, dtype=bool), 0, held.any()
    is_estimated[free] = True
    for table in graph.tables.values():
        rows = np.flatnonzero(table.weight.values)
        measured += table.type.residual_size * len(rows)
        if any_held:
            ends = table.vertex_rows.values[rows]
            is_estimated[ends[held[ends].all(axis=1)]] = True
    sizes = np.array([kind.dof for kind in graph.kinds], dtype=np.int64)
    return measured - int(sizes[graph.kind.values[is_estimated]].sum())
