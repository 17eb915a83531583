"""The graph as it is drawn: lines between what edges join, coloured by how well they fit, never too many."""

import numpy as np
import pytest

from graph_slam_ros.graph import POINT_PRIOR, R1, Gaussian
from graph_slam_ros.messages import results, to_msg
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.markers import graph_view
from graph_slam_ros.slam import Closure, Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings

STAMP_NS = 1_700_000_000_000_000_000


def flat(dimensions, variance):
    return tuple((variance * np.eye(dimensions)).ravel().tolist())


@pytest.fixture(scope="module", params=[2, 3])
def slam(request):
    """Ten keyframes along a line, seen by everything; the last closure is out, as it does not fit."""
    n = request.param
    dof = 3 if n == 2 else 6
    held = {"anchor.sigma_m": 1e-3, "anchor.sigma_rad": 1e-3}
    slam = GraphSlam(Config.from_mapping({"world.dimensions": n, "keyframes.shared_noise": 1.0, **held}))
    level = (0.0,) if n == 2 else (0.0, 0.0, 0.0, 1.0)
    for k in range(10):
        stamp = STAMP_NS + k * 10**9
        slam.process(Odometry(stamp, (float(k), *[0.0] * (n - 1), *level)))
        point = Sighting("point", "position", (4.0 - k, 1.0, 0.5)[:n], flat(n, 0.01))
        tag = Sighting("tag", "pose", (5.0 - k, *[-1.0] * (n - 1), *level), flat(dof, 0.01))
        slam.process(Sightings(stamp, "/landmarks", (point, tag)))
    newest = STAMP_NS + 9 * 10**9
    antenna = (0.5, 0.2, 0.9)[:n]
    slam.process(Fix(newest, "/gps", "position", (9.7, 0.1, 0.8)[:n], flat(n, 0.04), antenna))
    one_axis = np.diag([4e6, 0.09, 4e6][:n])
    slam.process(Fix(newest, "/gps", "position", (50.0, 0.4, 7.0)[:n], tuple(one_axis.ravel().tolist()), antenna))
    slam.process(Fix(newest, "/pose", "pose", (9.1, *[0.1] * (n - 1), *level), flat(dof, 0.04)))
    slam.process(Fix(newest, "/compass", "heading", (0.1,), (0.01,)))
    for far in (5.0, 7.0):
        slam.process(Closure(newest, newest - 5 * 10**9, "/c", (far, *[0.0] * (n - 1), *level), flat(dof, 0.01)))
    slam.process(Control("flush"))
    slam.process(Control("optimize"))
    survey = slam.view.space.point
    where = slam.view.solver.estimate([slam.view.landmarks["point"].vertex])[0] + 0.1
    noise = Gaussian.from_sigmas(*[0.1] * n)
    offset = slam.view.graph.add_vertex(R1, [2.0])  # which is nowhere
    slam.view.graph.add_edge(POINT_PRIOR[R1], [offset], [0.0], Gaussian.from_sigmas(0.01), "range_offset")
    slam.view.graph.add_edge(POINT_PRIOR[survey], [slam.view.landmarks["point"].vertex], where, noise, "surveyed")
    slam.view.solver.set_weight(int(slam.view.graph.edges_of("closures")[-1]), 0.0)
    slam.process(Control("optimize"))
    assert slam.counters.as_dict() == {}
    return slam


def in_space(points):
    out = np.zeros((len(points), 3))
    out[:, : np.shape(points)[1]] = points
    return out


def positions(view):
    return in_space(view.trajectory()[:, : view.space.dimensions])


def landmark(view, name):
    return in_space(view.solver.estimate([view.landmarks[name].vertex])[:, : view.space.dimensions])[0]


def test_vertices_are_where_they_are_estimated_odometry_joins_keyframes_and_sightings_lead_to_landmarks(slam):
    view, path = graph_view(slam.view, 100), positions(slam.view)
    assert (view.poses == path).all()
    assert sorted(view.landmarks.tolist()) == sorted(landmark(slam.view, name).tolist() for name in ("point", "tag"))
    assert (view.classes["odometry"].start == path[:-1]).all()
    assert (view.classes["odometry"].end == path[1:]).all()
    lines = view.classes["landmarks"]
    drawn = [(*start, *end) for start, end in zip(lines.start.tolist(), lines.end.tolist(), strict=True)]
    expected = [(*pose, *landmark(slam.view, name)) for pose in path.tolist() for name in ("point", "tag")]
    assert sorted(drawn) == sorted(expected)


def test_closures_join_what_they_close_and_those_that_are_out_are_drawn_apart(slam):
    view, path = graph_view(slam.view, 100), positions(slam.view)
    for lines in (view.classes["closures"], view.rejected):
        assert lines.start.tolist() == [path[4].tolist()]
        assert lines.end.tolist() == [path[9].tolist()]
    assert view.classes["closures"].misfit[0] < 9.0 < view.rejected.misfit[0]
    lines = view.classes["surveyed"]
    assert lines.end[0] == pytest.approx(landmark(slam.view, "point"))
    (table,) = [t for t in slam.view.graph.tables.values() if t.type is POINT_PRIOR[slam.view.space.point]]
    assert lines.start[0] == pytest.approx(in_space(table.measured.values)[0])
    apart_m = lines.end - lines.start
    assert lines.misfit[0] == pytest.approx((apart_m**2).sum() / (slam.view.space.dimensions * 0.01))


def test_a_fix_leads_from_where_it_says_to_the_point_of_the_robot_that_it_is_of_by_as_much_as_it_misses(slam):
    n, lines = slam.view.space.dimensions, graph_view(slam.view, 100).classes["fixes"]
    by_start = {tuple(start[:n]): (end, q) for start, end, q in zip(lines.start, lines.end, lines.misfit, strict=True)}
    newest = tuple(slam.view.trajectory()[-1])
    antenna = in_space(np.array([slam.view.space.group.act(newest, (0.5, 0.2, 0.9)[:n])]))[0]

    end, misfit = by_start.pop((9.7, 0.1, 0.8)[:n])
    assert end == pytest.approx(antenna)
    assert misfit == pytest.approx(((end - in_space([(9.7, 0.1, 0.8)[:n]])[0]) ** 2).sum() / (n * 0.04), rel=1e-5)

    end, _ = by_start.pop((9.1, 0.1, 0.1)[:n])
    assert end == pytest.approx(positions(slam.view)[-1])

    ((start, (end, misfit)),) = by_start.items()  # the compass says nothing of a position
    assert end == pytest.approx(antenna)
    assert start == pytest.approx((antenna[0], 0.4, antenna[2])[:n]), "where it would be, were that coordinate right"
    assert misfit == pytest.approx((antenna[1] - 0.4) ** 2 / 0.09, rel=1e-5)


def test_what_is_drawn_is_bounded_and_the_worst_is_never_left_out(slam):
    everything, view = graph_view(slam.view, 100), graph_view(slam.view, 6)
    assert len(view.poses) <= 6
    assert view.poses[[0, -1]].tolist() == positions(slam.view)[[0, -1]].tolist()
    misfits = [lines.misfit for lines in (*view.classes.values(), view.rejected)]
    assert 3 <= sum(map(len, misfits)) <= 6
    worst = np.sort(np.concatenate([lines.misfit for lines in (*everything.classes.values(), everything.rejected)]))
    assert set(worst[-3:].tolist()) <= set(np.concatenate(misfits).tolist())
    assert len(graph_view(slam.view, 2).landmarks) == 2


def test_the_graph_is_published_in_the_map_at_the_newest_keyframe_in_place_of_the_former(slam):
    clear, *drawn = typestore().deserialize_cdr(results.graph(slam.view, 100), results.LANDMARKS).markers
    classes = "anchor", "odometry", "landmarks", "fixes", "closures", "surveyed"
    assert {m.ns for m in drawn} == {"poses", "landmarks", "rejected", *(f"edges/{name}" for name in classes)}
    assert clear.action == 3 and all((m.action, m.lifetime.sec) == (0, 0) and m.points for m in drawn)
    assert {(m.header.frame_id, m.header.stamp.sec) for m in drawn} == {("map", STAMP_NS // 10**9 + 9)}
    poses = [(p.x, p.y, p.z) for m in drawn if m.ns == "poses" for p in m.points]
    assert poses == [tuple(one) for one in positions(slam.view).tolist()]
    drawn = typestore().deserialize_cdr(results.graph(GraphSlam().view, 100), results.LANDMARKS).markers
    assert [(m.ns, m.action, m.header.stamp.sec) for m in drawn] == [("", 3, 0)], "of nothing"


def test_landmarks_are_published_with_identity_and_covariance_in_the_axes_of_the_map(slam):
    n, most = slam.view.space.dimensions, to_msg.UNKNOWN
    message = typestore().deserialize_cdr(results.landmarks_estimate(slam.view), results.ESTIMATES)
    assert message.header.frame_id == "map"
    assert message.header.stamp.sec == STAMP_NS // 10**9 + 9
    by_id = {d.id: d for d in message.detections}
    known = {name: (value, covariance) for name, value, covariance in results.landmark_estimates(slam.view)}
    assert by_id.keys() == known.keys() == {"point", "tag"}
    for name, detection in by_id.items():
        (result,) = detection.results
        assert (detection.header, detection.bbox.center) == (message.header, result.pose.pose)
        p = result.pose.pose.position
        assert [p.x, p.y, p.z] == pytest.approx(landmark(slam.view, name))
    tag, point = (by_id[name].results[0].pose for name in ("tag", "point"))
    assert tag.pose == to_msg.pose(known["tag"][0])
    assert tag.covariance == pytest.approx(to_msg.covariance6(known["tag"][1], most))
    covariance = point.covariance.reshape(6, 6)
    assert covariance[:n, :n] == pytest.approx(known["point"][1])
    assert np.diag(covariance)[n:] == pytest.approx(most), "a point has no orientation, and in the plane no height"
    assert not covariance[n:, :n].any()
    unknown = [("tag", slam.view.space.identity, np.full((slam.view.space.dof,) * 2, np.nan))]
    message = typestore().deserialize_cdr(results.landmarks_estimate(slam.view, unknown), results.ESTIMATES)
    assert (message.detections[0].results[0].pose.covariance == (most * np.eye(6)).ravel()).all()
