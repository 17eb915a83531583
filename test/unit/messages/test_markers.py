"""Markers: what they draw is what there is."""

import math

import numpy as np
import pytest

from graph_slam_ros.lie import so3
from graph_slam_ros.messages import markers
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.markers import Lines

STAMP_NS = 1_700_000_000_987_654_321
MARKERS = "visualization_msgs/msg/MarkerArray"


def decode(cdr):
    return typestore().deserialize_cdr(cdr, MARKERS)


NONE = Lines(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def test_an_edge_that_fits_is_green_and_one_of_three_sigmas_is_red_at_both_ends():
    lines = Lines(np.zeros((4, 3)), np.ones((4, 3)), np.array([0.0, 4.0, 9.0, 1e6]))
    *_, edges = decode(markers.graph_markers(STAMP_NS, "map", NONE.start, NONE.start, {"a": lines}, NONE)).markers
    red, green, blue, alpha = np.array([(c.r, c.g, c.b, c.a) for c in edges.colors]).reshape(4, 2, 4).transpose(2, 0, 1)
    assert (red[:, 0] == red[:, 1]).all() and (alpha == 1.0).all() and (blue < 0.5).all()
    assert green[0, 0] > green[1, 0] > green[2, 0] == green[3, 0]
    assert red[0, 0] < red[1, 0] <= red[2, 0] == red[3, 0]


def test_markers_replace_the_former_ones_and_draw_each_landmark_as_its_two_sigma_ellipse():
    c, s = math.cos(0.3), math.sin(0.3)
    turn = np.array([[c, -s], [s, c]])
    covariances = [turn @ np.diag([0.01, 0.09]) @ turn.T, np.zeros((2, 2))]
    cdr = markers.landmark_markers(STAMP_NS, "map", ["a", "b"], np.array([[1.0, 2.0], [3.0, 4.0]]), covariances)
    clear, *drawn = decode(cdr).markers
    assert clear.action == 3
    assert [(m.ns, m.id, m.action) for m in drawn] == [(ns, k, 0) for k in (0, 1) for ns in ("landmarks", "names")]
    ellipse, name, exact, _ = drawn
    assert (ellipse.type, name.type) == (3, 9)
    assert sorted((ellipse.scale.x, ellipse.scale.y)) == pytest.approx([0.4, 1.2])
    tilt = 2 * math.atan2(ellipse.pose.orientation.z, ellipse.pose.orientation.w)
    long_axis = tilt if ellipse.scale.x > ellipse.scale.y else tilt + math.pi / 2
    assert math.sin(long_axis - (0.3 + math.pi / 2)) == pytest.approx(0.0, abs=1e-9)
    assert name.text == "a"
    assert (exact.scale.x, exact.scale.y) == (0.05, 0.05), "never too small to see"
    assert {m.header.frame_id for m in drawn} == {"map"}


def test_in_space_a_landmark_is_drawn_as_its_two_sigma_ellipsoid_or_small_where_that_is_unknown():
    turn = so3.matrix(so3.exp((0.4, -1.1, 0.7)))
    covariances = [turn @ np.diag([0.01, 0.09, 0.25]) @ turn.T, np.full((3, 3), np.nan)]
    positions = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    cdr = markers.landmark_markers(STAMP_NS, "map", ["a", "b"], positions, covariances)
    _, ellipsoid, _, unknown, _ = decode(cdr).markers
    p, q, size = ellipsoid.pose.position, ellipsoid.pose.orientation, ellipsoid.scale
    assert (ellipsoid.type, p.x, p.y, p.z) == (2, 1.0, 2.0, 3.0)
    axes = so3.matrix((q.x, q.y, q.z, q.w))
    assert axes @ np.diag(np.square([size.x, size.y, size.z]) / 16) @ axes.T == pytest.approx(covariances[0])
    assert (unknown.scale.x, unknown.scale.y, unknown.scale.z) == (0.05, 0.05, 0.05)
