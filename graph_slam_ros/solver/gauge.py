"""Whether something fixes where the whole is: relative measurements alone leave it to float."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from graph_slam_ros.errors import GaugeError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.graph import EdgeTable

Index = NDArray[np.int64]


def check_gauge(graph: Graph, free: Index, held: Index, rows: Mapping[EdgeTable, Index]) -> None:
    """Raise GaugeError unless each connected part has a held vertex or an edge on one vertex alone (a prior)."""
    fixed = np.zeros(graph.vertex_count, dtype=bool)
    fixed[held] = True
    sources, targets = [], []
    for table, chosen in rows.items():
        at = table.vertices.values[chosen]
        if at.shape[1] == 1:
            fixed[at[:, 0]] = True
        for slot in range(1, at.shape[1]):
            sources.append(at[:, 0])
            targets.append(at[:, slot])
    if sources:
        i, j = np.concatenate(sources), np.concatenate(targets)
        links = coo_array((np.ones(len(i)), (i, j)), shape=(graph.vertex_count, graph.vertex_count))
        _, part = connected_components(links, directed=False)
    else:
        part = np.arange(graph.vertex_count)
    loose = np.sort(free[~np.isin(part[free], part[fixed])])
    if len(loose):
        more = int((part[loose] == part[loose[0]]).sum()) - 1
        raise GaugeError(
            f"nothing fixes the gauge of vertex {int(loose[0])} and {more} more joined to it: add a prior"
            " (an anchor) or hold a vertex"
        )
