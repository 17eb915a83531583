"""How many unknowns each class of edges determines."""

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.solver.linearization import Losses, linearize

_MOST = 200  # edges of a class that are looked at: their joint covariances cost more than all the rest of a report


def leverage(slam: GraphSlam) -> dict[str, float]:
    """Trace of ``J Sigma J'`` of each class of edges, whitened and weighted as in the last stage of the losses.

    Over all classes it is the number of unknowns; a class of M residuals has M less this degrees of freedom (Hoaglin,
    Welsch, "The hat matrix in regression and ANOVA", 1978). A class of more than 200 edges of a type is told from
    every so manieth of them. Empty where the last solve failed.
    """
    graph, solver = slam.graph, slam.solver
    x = np.empty(len(graph.initial))
    for code, kind in enumerate(graph.kinds):
        ids = np.flatnonzero(graph.kind.values == code)
        x[graph.offset.values[ids][:, None] + np.arange(kind.size)] = solver.estimate(ids)
    losses = Losses(graph, slam.config.solver_settings().stages()[-1])
    out = dict.fromkeys(graph.labels, 0.0)
    for table in graph.tables.values():
        for code, label in enumerate(graph.labels):
            rows = np.flatnonzero((table.label.values == code) & (table.weight.values != 0.0))
            looked_at = rows[:: max(1, -(-len(rows) // _MOST))]
            for block in linearize(graph, x, {table: looked_at}, losses):
                for jacobian, ends in zip(block.jacobian, table.vertices.values[block.rows], strict=True):
                    try:
                        covariance = solver.joint_marginal(ends)
                    except GraphSlamError:
                        return {}
                    out[label] += float(((jacobian @ covariance) * jacobian).sum()) * len(rows) / len(looked_at)
    return {label: trace for label, trace in out.items() if trace}
