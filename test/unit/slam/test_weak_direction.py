"""The weakest direction of a covariance, in words."""

import numpy as np
import pytest

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.lie import so3
from graph_slam_ros.slam.weak_direction import position_covariance, weakest_position, weakest_turn


def along(*axis, sigma=0.3, others=0.1):
    """A covariance whose largest sigma is along an axis."""
    u = np.array(axis) / np.linalg.norm(axis)
    return others**2 * np.eye(len(u)) + (sigma**2 - others**2) * np.outer(u, u)


def test_the_weakest_direction_of_a_position_in_words():
    for covariance, path, words in (
        (along(1.0, 0.1), None, "along x of map"),
        (along(-0.1, 1.0), None, "along y of map"),
        (along(1.0, -1.0), None, "135 deg from x of map"),
        (along(1.0, 1.0, sigma=0.11), None, "in all directions alike"),
        (along(1.0, 1.0), (2.0, 2.0), "along the path"),
        (along(1.0, 1.0), (1.0, -1.0), "across the path"),
        (along(1.0, 0.0), (1.0, 1.0), "along x of map"),
        (along(1.0, 0.0), (0.0, 0.0), "along x of map"),
        (along(0.1, 0.0, 1.0), (1.0, 0.0, 0.0), "along z of map"),
        (along(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), "across the path"),
    ):
        found = weakest_position(covariance, None if path is None else np.array(path))
        assert found.words == words
        assert found.sigma == pytest.approx(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        assert found.axis @ covariance @ found.axis == pytest.approx(found.sigma**2)


def test_a_covariance_is_turned_from_the_pose_into_the_map():
    """A robot that faces along y, and knows its way least; and in space, whatever the robot's own axes are."""
    pose = (3.0, 4.0, 0.5 * np.pi)
    tangent = np.diag([0.5**2, 0.1**2, 0.02**2])
    assert weakest_position(position_covariance(PLANAR, pose, tangent)).words == "along y of map"
    turn = weakest_turn(PLANAR, pose, tangent)
    assert (turn.words, turn.sigma) == ("heading", pytest.approx(0.02))
    pose = (1.0, 2.0, 3.0, *so3.exp((0.4, -0.3, 1.2)))
    for axis, words in (
        ((0, 0, 1), "heading"),
        ((0, 1, 0.1), "roll and pitch"),
        ((1, 0, 1), "heading with roll and pitch"),
    ):
        in_map = np.zeros((6, 6))
        in_map[:3, :3], in_map[3:, 3:] = 0.1 * np.eye(3), along(*axis, sigma=0.2, others=0.01)
        turn = weakest_turn(SPATIAL, pose, SPATIAL.in_tangent(pose, in_map))
        assert (turn.words, turn.sigma) == (words, pytest.approx(0.2))
