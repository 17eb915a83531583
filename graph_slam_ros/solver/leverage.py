"""Leverage: the number of unknowns that each class of edges determines."""

from graph_slam_ros.solver.linearization import Losses, linearize, rows_of
from graph_slam_ros.solver.solver import Solver

_MOST = 200  # edges of a class that are sampled: their joint covariances cost more than all the rest of a report


def leverage(solver: Solver) -> dict[str, float]:
    """Trace of ``J Sigma J'`` of the edges of each label, whitened and weighted as in the last stage of the losses.

    Over all classes it is the number of unknowns; a class of M residuals has M less this degrees of freedom (Hoaglin,
    Welsch, "The hat matrix in regression and ANOVA", 1978). A class of more than 200 edges of a type is estimated from
    a sample of them.

    Raises
    ------
    GaugeError, SingularError
        As for ``Solver.marginal``.
    """
    graph = solver.graph
    losses = Losses(graph, solver.settings.stages()[-1])
    out = dict.fromkeys(graph.labels, 0.0)
    for table, rows in rows_of(graph, solver.edges).items():
        for code, label in enumerate(graph.labels):
            of_class = rows[table.label.values[rows] == code]
            sampled = of_class[:: max(1, -(-len(of_class) // _MOST))].copy()  # the layout kernels are compiled for
            for block in linearize(graph, solver.values, {table: sampled}, losses):
                for jacobian, ends in zip(block.jacobian, table.vertices.values[block.rows], strict=True):
                    covariance = solver.joint_marginal(ends)
                    trace = float(((jacobian @ covariance) * jacobian).sum())
                    out[label] += trace * len(of_class) / len(sampled)
    return {label: trace for label, trace in out.items() if trace}
