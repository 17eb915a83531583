"""The search for a displacement of the robot, on its own."""

import numpy as np

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.slam.robust.displacement import WINDOW, DisplacementSearch
from graph_slam_ros.slam.robust.landmark_history import LandmarkHistory
from graph_slam_ros.slam.robust.ledger import Ledger
from graph_slam_ros.solver import Solver

STEP = (0.5, 0.0, 0.0)
NOISE = {n: Gaussian(0.1 * np.eye(n)) for n in (2, 3)}


def test_a_sighting_of_an_older_keyframe_that_comes_late_is_compared_with_the_others():
    """As of a landmark without identity that turns out to be another: its edge is new, its keyframe is not."""
    graph, ledger = Graph(), Ledger()
    solver = Solver(graph)
    history = LandmarkHistory(graph, ledger)
    landmarks = [graph.add_vertex(PLANAR.point, (3.0 * k, 2.0)) for k in range(3)]
    search = DisplacementSearch(PLANAR, graph, solver, ledger, history)
    poses = []

    def drive(steps):
        for _ in range(steps):
            poses.append(graph.add_vertex(PLANAR.pose, (0.5 * len(poses), 0.0, 0.0)))
            if len(poses) > 1:
                edge = graph.add_edge(PLANAR.relative_pose, poses[-2:], STEP, NOISE[3], "odometry")
                search.chain.add(edge, poses[-2:], STEP, len(poses) * 10**9)

    def see(keyframe, landmark):
        away = np.subtract((3.0 * landmark, 2.0), (0.5 * keyframe, 0.0))
        ends = [poses[keyframe], landmarks[landmark]]
        edge = graph.add_edge(PLANAR.sightings["position"], ends, away, NOISE[2], "landmarks")
        search.add_sighting(edge, *ends)
        history.add(edge, *ends)

    drive(WINDOW)
    for k in range(10, WINDOW):
        see(k, k % 3)
    for k in range(1, 11):  # late, and of older keyframes
        see(k, k % 3)
    drive(5)
    solver.add(range(graph.vertex_count), [])
    count = graph.edge_count
    ledger.enter(0, np.zeros(count), np.zeros(count, dtype=int), np.zeros(count), np.empty(0), np.ones(count, bool))
    assert search.hypothesis() is None


def test_sightings_whose_keyframes_have_left_the_chain_are_not_compared():
    """A robot that sees something once in a hundred keyframes has fewer sightings than the window, of thousands."""
    graph, ledger = Graph(), Ledger()
    solver, history = Solver(graph), LandmarkHistory(graph, ledger)
    search = DisplacementSearch(PLANAR, graph, solver, ledger, history)
    landmark = graph.add_vertex(PLANAR.point, (0.0, 2.0))
    poses = [graph.add_vertex(PLANAR.pose, (0.0, 0.0, 0.0))]
    for k in range(1, 2500):
        poses.append(graph.add_vertex(PLANAR.pose, (0.5 * k, 0.0, 0.0)))
        edge = graph.add_edge(PLANAR.relative_pose, poses[-2:], STEP, NOISE[3], "odometry")
        search.chain.add(edge, poses[-2:], STEP, k * 10**9)
        if k % 100 == 0:
            ends = [poses[-1], landmark]
            edge = graph.add_edge(PLANAR.sightings["position"], ends, (-0.5 * k, 2.0), NOISE[2], "landmarks")
            search.add_sighting(edge, *ends)
            history.add(edge, *ends)
    solver.add(range(graph.vertex_count), [])
    count = graph.edge_count
    ledger.enter(0, np.zeros(count), np.zeros(count, dtype=int), np.zeros(count), np.empty(0), np.ones(count, bool))
    assert search.held_back_count == 0
    assert search.hypothesis() is None
