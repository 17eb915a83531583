"""What a displacement would move, and which edges it would contradict."""

import numpy as np
import pytest

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.slam.robust.connections import Begin, connections_across, landmarks_begun, moved_values
from graph_slam_ros.solver import Solver

NOISE = {n: Gaussian(0.1 * np.eye(n)) for n in (2, 3)}


class Drive:
    """Ten keyframes in a row. Landmark a is seen from the first four, b from the last four."""

    def __init__(self):
        self.graph = Graph()
        self.keyframes, self.a, self.b = [self.keyframe(0)], self.landmark(1.0), self.landmark(8.0)
        self.keyframes += [self.keyframe(k) for k in range(1, 10)]
        for k in range(4):
            self.see(k, self.a)
            self.see(9 - k, self.b)

    def keyframe(self, k):
        return self.graph.add_vertex(PLANAR.pose, (float(k), 0.0, 0.0))

    def landmark(self, x):
        return self.graph.add_vertex(PLANAR.point, (x, 2.0))

    def see(self, k, landmark, weight=1.0):
        ends = [self.keyframes[k], landmark]
        edge = self.graph.add_edge(PLANAR.sightings["position"], ends, (0.0, 2.0), NOISE[2], "landmarks")
        self.graph.set_weights(np.array([edge]), weight)

    def across(self, held=()):
        keyframes = np.array(self.keyframes[1:])
        return connections_across(self.graph, np.array(held, dtype=np.int64), keyframes, keyframes[-1] + 1)


def test_a_landmark_is_begun_at_its_first_accepted_sighting():
    drive = Drive()
    drive.see(0, drive.b, weight=0.0)  # its vertex is older than that keyframe: what counts is what is accepted
    begun = landmarks_begun(drive.graph, np.empty(0, dtype=np.int64))
    assert begun[[drive.a, drive.b]].tolist() == [drive.keyframes[0], drive.keyframes[6]]
    assert begun[drive.keyframes].tolist() == drive.keyframes
    ends = [drive.keyframes[0], drive.b]
    drive.graph.add_edge(PLANAR.sightings["position"], ends, (8.0, 2.0), NOISE[2], "places")  # of a condensed visit
    assert landmarks_begun(drive.graph, np.array([drive.a]))[[drive.a, drive.b]].tolist() == [-1, -1]


def test_a_displacement_lies_where_nothing_connects_and_what_is_not_accepted_is_explained():
    drive = Drive()
    assert drive.across().counts.sum(axis=0).tolist() == [3, 2, 1, 0, 0, 0, 3, 2, 1]
    drive.see(7, drive.a, weight=0.0)
    drive.see(8, drive.a, weight=0.0)
    begin = drive.across().likeliest(np.array([drive.a]))
    assert begin == Begin(drive.keyframes[6], contradicted=0, explained=2)  # the last of three
    end = [drive.keyframes[2], drive.keyframes[8]]
    drive.graph.add_edge(PLANAR.relative_pose, end, (6.0, 0.0, 0.0), NOISE[3], "closures")
    assert drive.across().counts.sum(axis=0).tolist() == [3, 2, 2, 1, 1, 1, 4, 3, 1]


def test_landmarks_move_with_the_robot_that_saw_them_first():
    drive = Drive()
    solver = Solver(drive.graph)
    solver.add(range(drive.graph.vertex_count), range(drive.graph.edge_count))
    values = moved_values(PLANAR, solver, {drive.keyframes[5]: (10.0, 0.0, 0.0)})

    def place(vertex):
        return values[drive.graph.vertex(vertex).stored][:2].tolist()

    assert place(drive.a) == [1.0, 2.0]
    assert place(drive.b) == pytest.approx([18.0, 2.0])
    assert [place(k)[0] for k in drive.keyframes[4:6]] == pytest.approx([4.0, 15.0])
