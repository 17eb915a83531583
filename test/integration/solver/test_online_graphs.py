"""After every step of public and simulated graphs the online estimate is what batch reaches from it."""

import numpy as np
import pytest
from normal_equations import Reference, all_values
from online import EXACT, check_tree
from places import DATASETS
from reliability import times

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import R2
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.tools.simulation import city_graph

GRAPHS = DATASETS / "pose_graphs"


def steps(graph):
    """Vertices and edges in time order: each pose with its edges to what came before, a landmark when first seen."""
    is_point = np.array([kind is R2 for kind in graph.kinds])[graph.kind.values]
    come = np.where(is_point, graph.vertex_count, np.arange(graph.vertex_count))  # with which pose each vertex comes
    for table in graph.tables.values():
        ends = table.vertices
        newest = np.where(is_point[ends], -1, ends).max(axis=1)
        for slot in range(ends.shape[1]):
            points = is_point[ends[:, slot]]
            np.minimum.at(come, ends[points, slot], newest[points])
    due = np.empty(graph.edge_count, dtype=np.int64)
    for table in graph.tables.values():
        due[table.ids] = come[table.vertices].max(axis=1)
    for pose in np.flatnonzero(~is_point):
        yield np.flatnonzero(come == pose), np.flatnonzero(due == pose)


def replayed(graph, every, *, within=1e-6, **chosen):
    """Add pose after pose, compare after every so many; returns the solver at the end."""
    solver = Solver(graph, Settings(**chosen))
    vertices, edges = [], []
    for k, (new, new_edges) in enumerate(steps(graph)):
        solver.add(new, new_edges)
        vertices += new.tolist()
        edges += new_edges.tolist()
        if k == 0:
            solver.hold(int(new[0]))
        solver.update()
        if k % every == 0:
            reference, found = Reference(graph, vertices, edges, vertices[:1]), all_values(solver)
            apart = reference.apart(found, reference.optimum(found))
            assert apart <= within, f"{apart:.1e} from the optimum after pose {k}"
    assert len(vertices) == graph.vertex_count
    assert len(edges) == graph.edge_count
    check_tree(solver, regions_separate=True)
    return solver


@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
@pytest.mark.parametrize(
    ("name", "every"), [("ring", 3), ("tinyGrid3D", 1), *times([], [("intel_943", 3), ("smallGrid3D", 1)])]
)
def test_after_every_step_of_a_public_graph_the_estimate_is_the_optimum(name, every):
    replayed(read_g2o(GRAPHS / f"{name}.g2o", raw=True).graph, every, **EXACT)


def test_after_every_step_of_a_simulated_city_the_estimate_is_the_optimum():
    graph, _ = city_graph(seed=3, poses=times(200, 600), blocks=10, odometry_noise_factor=2.0)
    replayed(graph, times(4, 1), **EXACT)
