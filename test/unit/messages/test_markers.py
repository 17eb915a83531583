"""Markers: what they draw is what there is."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.lie import so3
from graph_slam_ros.messages import markers
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.markers import GraphView, Lines

STAMP_NS = 1_700_000_000_987_654_321
MARKERS = "visualization_msgs/msg/MarkerArray"


def decode(cdr):
    return typestore().deserialize_cdr(cdr, MARKERS)


def test_an_edge_that_fits_is_green_and_one_of_three_sigmas_is_red_at_both_ends():
    none = np.zeros((0, 3))
    lines = Lines(np.zeros((4, 3)), np.ones((4, 3)), np.array([0.0, 4.0, 9.0, 1e6]))
    view = GraphView(none, none, {"a": lines}, Lines(none, none, np.zeros(0)))
    *_, edges = decode(markers.graph_markers(STAMP_NS, "map", view)).markers
    red, green, blue, alpha = np.array([(c.r, c.g, c.b, c.a) for c in edges.colors]).reshape(4, 2, 4).transpose(2, 0, 1)
    assert (red[:, 0] == red[:, 1]).all() and (alpha == 1.0).all() and (blue < 0.5).all()
    assert green[0, 0] > green[1, 0] > green[2, 0] == green[3, 0]
    assert red[0, 0] < red[1, 0] <= red[2, 0] == red[3, 0]


@each(
    "n, kind, turn, variances",
    [(2, 3, (0.0, 0.0, 0.3), (0.01, 0.09, 0.0)), (3, 2, (0.4, -1.1, 0.7), (0.01, 0.09, 0.25))],
)
def test_markers_replace_the_former_ones_and_draw_each_landmark_as_its_two_sigma_ellipsoid(n, kind, turn, variances):
    axes = so3.matrix(so3.exp(turn))
    covariance, at = (axes @ np.diag(variances) @ axes.T)[:n, :n], np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])[:, :n]
    unknown = np.full((n, n), np.nan) if n == 3 else np.zeros((n, n))
    clear, *drawn = decode(markers.landmark_markers(STAMP_NS, "map", ["a", "b"], at, [covariance, unknown])).markers
    assert clear.action == 3
    assert [(m.ns, m.id, m.action) for m in drawn] == [(ns, k, 0) for k in (0, 1) for ns in ("landmarks", "names")]
    ellipsoid, name, small, _ = drawn
    p, q, size = ellipsoid.pose.position, ellipsoid.pose.orientation, ellipsoid.scale
    assert (ellipsoid.type, name.type, name.text, {m.header.frame_id for m in drawn}) == (kind, 9, "a", {"map"})
    assert [p.x, p.y, p.z][:n] == at[0].tolist()
    axes = so3.matrix((q.x, q.y, q.z, q.w))
    drawn = axes @ np.diag(np.square([size.x, size.y, size.z]) / 16) @ axes.T
    assert drawn[:n, :n] == pytest.approx(covariance)
    assert (small.scale.x, small.scale.y) == (0.05, 0.05), "never too small to see, nor where it is unknown"
