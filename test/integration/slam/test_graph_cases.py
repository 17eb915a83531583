"""Graphs that are singular, contradict themselves or are hard, case by case: what is believed, what is refused."""

import math
from collections import Counter

import numpy as np
import pytest
from reliability import tell

from graph_slam_ros.errors import GaugeError, GraphSlamError, SingularError
from graph_slam_ros.graph import (
    BEARING,
    COORDINATE_PRIOR,
    HEADING_PRIOR,
    LANDMARK_POSITION,
    POSE_PRIOR,
    POSE_PRIOR_3D,
    POSITION_PRIOR,
    R2,
    RANGE,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    Gaussian,
    Graph,
)
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.measurements.types import Closure
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.restore import map_of
from graph_slam_ros.slam import Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.solver import Settings, Solver

S = 1_000_000_000
T0 = 1_700_000_000 * S
END = Control("end"), Control("optimize")
POSE, POINT = Gaussian.from_sigmas(0.05, 0.05, 0.02), Gaussian.from_sigmas(0.05, 0.05)
SURE = (1e-4, 0.0, 0.0, 1e-4)


def at(k, x, y=0.0, theta=0.0):
    return Odometry(T0 + k * S, (x, y, theta))


def seen(k, where, name="7"):
    return Sightings(T0 + k * S, "/landmarks", (Sighting(name, "position", where, (0.01, 0.0, 0.0, 0.01)),))


def closure(k, earlier, measured, sigma=0.01):
    covariance = tuple((np.eye(3) * sigma**2).ravel().tolist())
    return Closure(T0 + k * S, T0 + earlier * S, "/closures", measured, covariance)


def slam(**values):
    base = {"ordering.window_s": 0.0}
    return GraphSlam(Config.from_mapping(base | {name.replace("__", "."): value for name, value in values.items()}))


def run(p, *several):
    for m in several:
        p.process(m)
    return p


def verdicts(view, label):
    return Counter(Verdict(int(view.ledger.verdict.values[edge])).name for edge in view.graph.edges_of(label).tolist())


def test_G4_a_landmark_by_bearing_on_the_line_that_the_robot_drives_stays_parked():
    p = slam()
    for k in range(60):
        ahead = Sighting("a", "bearing", (0.0,), (1e-4,))
        run(p, at(k, 0.5 * k), Sightings(T0 + k * S, "/bearings", (ahead,)))
    run(p, *END)
    assert not p.view.landmarks
    assert p.view.waiting["a"]
    assert not p.view.failing
    assert p.view.trajectory()[-1] == pytest.approx([29.5, 0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize(
    ("moves_at", "to", "verdict_of_others", "stands", "within"),
    [(20, (25.0, -4.0), "PENDING", (5.0, 3.0), 1e-3), (5, (6.0, 4.0), "ACCEPTED", (6.0, 4.0), 1e-2)],
    ids=["G12", "G21"],
)
def test_G12_G21_what_is_seen_again_elsewhere_bends_nothing_and_is_where_most_sightings_say(
    moves_at, to, verdict_of_others, stands, within
):
    p = slam()
    for k in range(40):
        x, (lx, ly) = 0.5 * k, (5.0, 3.0) if k < moves_at else to
        run(p, at(k, x), seen(k, (lx - x, ly)))
    run(p, *END)
    first = {"PENDING": "ACCEPTED", "ACCEPTED": "REJECTED"}[verdict_of_others]
    assert verdicts(p.view, "landmarks") == {first: moves_at, verdict_of_others: 40 - moves_at}
    assert p.view.trajectory()[-1] == pytest.approx([19.5, 0.0, 0.0], abs=within)
    assert p.view.solver.estimate([p.view.landmarks["7"].vertex])[0] == pytest.approx(stands, abs=within)


def test_G13_a_fix_that_says_50_m_away_is_held_back_and_the_others_are_believed():
    p = slam()
    for k in range(40):
        where = (0.5 * k, 50.0 if k % 10 == 5 else 0.0)
        run(p, at(k, 0.5 * k), Fix(T0 + k * S, "/fix", "position", where, SURE))
    run(p, *END)
    assert verdicts(p.view, "fixes") == {"ACCEPTED": 36, "PENDING": 4}
    assert np.abs(p.view.trajectory()[:, 1]).max() < 1e-3


def test_G15_the_first_closure_after_a_long_drift_is_believed_and_the_error_is_gone():
    """Of a loop of 160 m whose odometry turns too far at each step: it ends more than 20 m away."""
    p, odom, true = slam(), se2.IDENTITY, se2.IDENTITY
    for k in range(161):
        run(p, at(k, *odom))
        true = se2.compose(true, (1.0, 0.0, 2.0 * math.pi / 160))
        odom = se2.compose(odom, (1.0, 0.0, 2.0 * math.pi / 160 + 0.006))
    off = math.hypot(*p.view.trajectory()[-1, :2])
    assert off > 20.0
    run(p, closure(160, 0, (0.0, 0.0, 0.0)), at(161, *odom))
    assert verdicts(p.view, "closures") == {"ACCEPTED": 1}
    assert math.hypot(*p.view.trajectory()[160, :2]) < 0.02 * off
    assert not p.view.failing


def test_G18_turns_of_any_number_cost_nothing():
    """A robot that has turned ten times on the spot, and a closure that says so by its heading within half a turn."""
    p = slam(keyframes__min_angle_rad=0.5)
    for k in range(63):
        run(p, at(k, 0.0, 0.0, (k * 1.0 + math.pi) % (2.0 * math.pi) - math.pi))
    for k, earlier in ((62, 0), (60, 3)):
        turned = (k - earlier + math.pi) % (2.0 * math.pi) - math.pi
        run(p, closure(k, earlier, (0.0, 0.0, turned)))
    run(p, *END)
    assert verdicts(p.view, "closures") == {"ACCEPTED": 2}
    assert p.view.report.chi2_final == pytest.approx(0.0, abs=1e-9)


def test_G22_a_closure_that_names_a_time_whose_odometry_is_forgotten_joins_the_keyframe_before():
    """No keyframe is ever taken away, so that there is always one."""
    p = slam(ordering__late_s=1.0)
    for k in range(60):
        run(p, at(k, 0.5 * min(k, 59 - k), 0.0, 0.0 if k < 30 else math.pi))
    measured = (-0.25, 0.0, math.pi)
    covariance = tuple((np.eye(3) * 1e-4).ravel())
    run(p, Closure(T0 + 59 * S, T0 + S // 2, "/closures", measured, covariance), *END)
    (edge,) = p.view.graph.edges_of("closures").tolist()
    table, row = p.view.graph.row(edge)
    assert table.vertices[row].tolist() == [p.view.keyframes[0].vertex, p.view.keyframes[-1].vertex]
    assert verdicts(p.view, "closures") == {"ACCEPTED": 1}
    assert not p.counters.as_dict()


def driven(p, until, each=lambda k: None):
    """Straight on past a landmark; why the solve at each keyframe failed."""
    states = []
    for k in range(len(p.view.keyframes), until):
        each(k)
        x = 0.5 * k
        run(p, *([seen(k - 1, (5.5 - x, 3.0), "good")] if k else []), at(k, x))
        states.append(p.view.failing)
    return states


def test_G6_a_landmark_that_makes_the_problem_singular_is_taken_out_and_what_else_came_stays(tmp_path):
    """Put into the graph by hand: the pipeline itself lets none in that is not determined."""
    p, noise = slam(), Gaussian.from_sigmas(0.01)

    def begin(k):
        if k == 20:
            landmark = p.view.graph.add_vertex(R2, (12.0, 3.0))
            p.view.graph.add_edge(BEARING, [p.view.keyframes[-1].vertex, landmark], [1.0], noise, "landmarks")

    failed = [state for state in driven(p, 30, begin) if state]
    assert len(failed) == 1
    assert "do not determine vertex 21" in failed[0]
    assert p.counters.as_dict() == {"landmarks": {"quarantined": 1}, "solver": {"unsolved": 2}}
    (change,) = [one for one in p.view.ledger.history if one.reason is Reason.QUARANTINED]
    assert change.edge not in p.view.solver.edges
    assert 21 not in p.view.solver.vertices
    assert verdicts(p.view, "landmarks") == {"ACCEPTED": 29, "REJECTED": 1}
    assert p.view.trajectory()[-1] == pytest.approx([14.5, 0.0, 0.0], abs=0.05)
    recorder = RunRecorder(tmp_path / "run", p.view.config)
    p.process(Control("optimize"))
    recorder.save(p)
    again = GraphSlam(p.view.config, start=map_of(tmp_path / "run", []))
    assert 21 not in again.view.solver.vertices, "nor is it in the map that is taken up"
    assert again.view.trajectory() == pytest.approx(p.view.trajectory(), abs=1e-9)


def test_G7_where_nothing_that_has_come_is_to_blame_the_last_good_estimate_is_held_until_it_heals():
    p = slam()

    def begin(k):
        if k == 20:
            graph, newest = p.view.graph, p.view.keyframes[-1].vertex
            vertex = graph.add_vertex(R2, (12.0, 3.0))  # which its only edge does not determine
            graph.add_edge(BEARING, [newest, vertex], [1.0], Gaussian.from_sigmas(0.01), "surveyed")

    assert [bool(state) for state in driven(p, 30, begin)] == [k >= 20 for k in range(30)]
    assert p.counters.as_dict() == {"solver": {"unsolved": 10}}
    assert p.view.trajectory()[-1] == pytest.approx([14.5, 0.0, 0.0], abs=0.05)
    assert np.isnan(p.view.keyframe_covariances()).all()
    p.view.graph.add_edge(LANDMARK_POSITION, [p.view.keyframes[-1].vertex, 21], (-2.5, 3.0), POINT, "landmarks")
    assert not any(driven(p, 32))
    assert np.isfinite(p.view.keyframe_covariances()).all()
    assert verdicts(p.view, "landmarks") == {"ACCEPTED": 32}, "what was taken out in vain is in again"


@pytest.mark.parametrize(
    "twist",
    [1e-300 * np.eye(3), np.diag([1e-30, 0.01, 0.01]), np.full((3, 3), 0.01)],
    ids=["tiny", "tiny_along_one_axis", "of_rank_1"],
)
def test_A12_however_certain_odometry_says_it_is_its_edges_are_not_and_what_they_are_part_of_is_solved(twist):
    p, poses = slam(), [se2.IDENTITY]
    for k in range(40):
        run(p, Odometry(T0 + k * S, poses[k], tuple(twist.ravel().tolist())))
        if k > 10:
            run(p, closure(k, k - 10, se2.between(poses[k - 10], poses[k])))
        assert not p.view.failing
        poses.append(se2.compose(poses[k], (0.5, 0.0, 0.05)))
    run(p, *END)
    roots = p.view.graph.tables[RELATIVE_POSE].sqrt_information.values
    assert (np.linalg.svd(roots, compute_uv=False)[:, 0] <= 1.01 / 1e-5).all(), "no surer than 0.01 mrad"
    assert p.view.trajectory() == pytest.approx(np.array(poses[:-1]), abs=1e-6)
    assert np.isfinite(p.view.keyframe_covariances()).all()


def test_G16_what_an_update_costs_does_not_grow_with_the_graph_while_no_loop_is_closed():
    graph = Graph()
    solver = Solver(graph)
    eliminated = []
    for k in range(1500):
        graph.add_vertex(SE2, (0.1 * k, 0.0, 0.0))
        if k:
            graph.add_edge(RELATIVE_POSE, [k - 1, k], (0.1, 0.0, 0.0), POSE, "odometry")
        else:
            graph.add_edge(POSE_PRIOR, [0], (0.0, 0.0, 0.0), POSE, "anchor")
        solver.add([k], [k])
        eliminated.append(solver.update().eliminated)
    assert np.median(eliminated[-300:]) <= np.median(eliminated[300:600])
    assert np.mean(eliminated[-300:]) < 3.0 * np.mean(eliminated[300:600])


ORIGIN = (0.0, 0.0, 0.0)
WEAK, HARD = Gaussian.from_sigmas(1e3, 1e3, 1e3), Gaussian.from_sigmas(1e-5, 1e-5, 1e-6)


def chain(count, *, anchor=ORIGIN, step=(1.0, 0.0, 0.0), noise=POSE, begin=ORIGIN):
    """A graph of poses in a row, each a step from the last; without an anchor if that is None."""
    graph, pose = Graph(), begin
    for k in range(count):
        graph.add_vertex(SE2, pose)
        if k:
            graph.add_edge(RELATIVE_POSE, [k - 1, k], step, noise, "odometry")
        pose = se2.compose(pose, step)
    if anchor is not None:
        graph.add_edge(POSE_PRIOR, [0], anchor, POSE, "anchor")
    return graph


def with_landmark(graph, *edges, where=(2.0, 3.0), noise=POINT):
    """A point, and edges to it: (type, pose, measured)."""
    landmark = graph.add_vertex(R2, where)
    for kind, pose, measured in edges:
        one = noise if kind is LANDMARK_POSITION else Gaussian.from_sigmas(0.05)
        graph.add_edge(kind, [pose, landmark], measured, one, "landmarks")
    return graph


def with_edge(graph, kind, ends, measured, noise=POSE, label="closures"):
    graph.add_edge(kind, ends, measured, noise, label)
    return graph


def two_parts(*, anchored):
    graph = chain(3)
    first = graph.vertex_count
    graph.add_vertices(SE2, [(5.0, 0.0, 0.0), (6.0, 0.0, 0.0)])
    graph.add_edge(RELATIVE_POSE, [first, first + 1], (1.0, 0.0, 0.0), POSE, "odometry")
    return with_edge(graph, POSE_PRIOR, [first], (5.0, 0.0, 0.0), POSE, "anchor") if anchored else graph


def half_turns(count, axis):
    """In space, half a turn at each step, which has two logarithms."""
    graph, turn = Graph(), so3.exp(tuple(math.pi * x for x in axis))
    noise = Gaussian.from_sigmas(*[0.05] * 6)
    for k in range(count):
        graph.add_vertex(SE3, (0.0, 0.0, 0.0, *(turn if k % 2 else (0.0, 0.0, 0.0, 1.0))))
        if k:
            graph.add_edge(RELATIVE_POSE_3D, [k - 1, k], (0.0, 0.0, 0.0, *turn), noise, "odometry")
    graph.add_edge(POSE_PRIOR_3D, [0], (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), noise, "anchor")
    return graph


def two_apart():
    (graph := chain(1)).add_vertex(SE2, (1.0, 0.0, 0.0))
    return graph


def overshooting():
    """Two turns of a hundred degrees."""
    graph = Graph()
    graph.add_vertices(SE2, [(0.0, 0.0, 0.0), (0.0, 1.0, 1.8), (1.0, 1.0, -1.8)])
    graph.add_edge(POSE_PRIOR, [0], ORIGIN, POSE, "anchor")
    for ends in ((0, 1), (1, 2), (2, 0), (1, 0)):
        graph.add_edge(RELATIVE_POSE, ends, (10.0, 0.0, 0.0), Gaussian.from_sigmas(0.01, 0.01, 1.0), "odometry")
    return graph


def contradicting(count):
    """As many closures from the last pose to the first as poses, each of which says something else."""
    graph = chain(count)
    for k in range(count):
        with_edge(graph, RELATIVE_POSE, [0, count - 1], (10.0 * math.cos(k), 10.0 * math.sin(k), float(k)))
    return graph


FAR, ONE, NO_GAUGE = (5e5, 4e6, 3.0), Gaussian.from_sigmas(0.1), (GaugeError, SingularError)
B, R, P = BEARING, RANGE, LANDMARK_POSITION
AHEAD, SEEN = (9.0, 0.0), ((P, 0, (2.0, 3.0)), (P, 1, (1.0, 3.0)))
GRAPHS = {
    "G1 two parts, one without an anchor": (two_parts(anchored=False), GaugeError),
    "G1 two parts, each with its own": (two_parts(anchored=True), 0.0),
    "G1 a pose without an edge": (chain(1, anchor=None), GaugeError),
    "G2 no anchor": (chain(4, anchor=None), GaugeError),
    "G2 a position alone": (with_edge(chain(2, anchor=None), POSITION_PRIOR, [0], [0.0] * 4, POINT), NO_GAUGE),
    "G2 a heading alone": (with_edge(chain(2, anchor=None), HEADING_PRIOR, [0], (0.0,), ONE), NO_GAUGE),
    "G2 one axis": (with_edge(chain(2, anchor=None), COORDINATE_PRIOR, [0], (1.0, 0.0, 0.0, 0.0, 0.0), ONE), NO_GAUGE),
    "G2 two anchors that contradict": (with_edge(chain(2), POSE_PRIOR, [0], (9.0, 9.0, 1.0)), "solved"),
    "G3 a landmark by one bearing": (with_landmark(chain(2), (B, 0, [1.0])), SingularError),
    "G3 a landmark by one range": (with_landmark(chain(2), (R, 0, [3.6])), SingularError),
    "G3 a landmark without an edge": (with_landmark(chain(2)), GaugeError),
    "G3 two bearings": (with_landmark(chain(5), *((B, k, [math.atan2(3, 2 - k)]) for k in (0, 4))), 0.0),
    "G4 straight ahead, twice": (with_landmark(chain(3), (B, 0, [0.0]), (B, 2, [0.0]), where=AHEAD), SingularError),
    "G4 straight ahead, by range too": (with_landmark(chain(3), (B, 0, [0.0]), (R, 2, [7.0]), where=AHEAD), 0.0),
    "G5 two ranges, on their line": (with_landmark(chain(3), (R, 0, [9.0]), (R, 2, [7.0]), where=AHEAD), SingularError),
    "G5 by three ranges, from its mirror place": (
        with_landmark(chain(3), *((R, k, [math.hypot(2.0 - k, 3.0)]) for k in range(3)), where=(2.0, -3.0)),
        0.0,
    ),
    "G6 a pose that may turn around its landmark": (with_landmark(two_apart(), *SEEN), NO_GAUGE),
    "G6 two landmarks hold a pose": (
        with_landmark(with_landmark(two_apart(), *SEEN), (P, 0, (4.0, -1.0)), (P, 1, (3.0, -1.0)), where=(4.0, -1.0)),
        0.0,
    ),
    "G6 an edge of next to no weight": (chain(3, noise=WEAK), 0.0),
    "G7 a cost that overflows": (with_edge(chain(3), RELATIVE_POSE, [0, 2], (1e200, 0.0, 0.0)), GraphSlamError),
    "G7 a start that overflows": (chain(3, begin=(1e200, 0.0, 0.0)), GraphSlamError),
    "G8 steps that overshoot": (overshooting(), "solved"),
    "G9 a start 100 km away": (chain(5, begin=(1e5, -1e5, 3.0)), "solved"),
    "G9 contradictions without end": (contradicting(8), "solved"),
    "G17 UTM coordinates": (chain(50, anchor=FAR, begin=FAR), 0.0),
    "G17 UTM anchor, start at the origin": (chain(20, anchor=FAR), "solved"),
    "G17 edges ten thousand times surer than the anchor": (chain(50, noise=HARD), 0.0),
    "G18 half a turn at each step": (chain(9, step=(0.0, 0.0, math.pi)), 0.0),
    "G18 half a turn in space about x": (half_turns(7, (1.0, 0.0, 0.0)), 0.0),
    "G18 half a turn in space about no axis of its own": (half_turns(7, (0.6, 0.0, 0.8)), 0.0),
    "G18 a start that is turned by half": (chain(5, begin=(0.0, 0.0, math.pi)), 0.0),
    "G19 one pose, held by its anchor alone": (chain(1), 0.0),
}


@pytest.mark.parametrize("method", ["gn", "lm", "dogleg"])
def test_T15_singular_and_hard_graphs_are_solved_or_refused_as_expected(method):
    assert len(GRAPHS) >= 30
    for name, (graph, expected) in GRAPHS.items():
        before = graph.initial.values.copy()
        solver = Solver(graph, Settings(method=method))
        solver.add(range(graph.vertex_count), range(graph.edge_count))
        if isinstance(expected, float | str):
            report = solver.optimize()
            assert np.isfinite(solver.values).all(), name
            assert report.cost_final <= report.cost_initial + 1e-9, name
            if isinstance(expected, float):
                assert report.chi2_final == pytest.approx(expected, abs=1e-6), name
            for covariance in solver.marginal(solver.vertices):
                assert (np.linalg.eigvalsh(covariance) > 0.0).all(), name
        else:
            for solve in (solver.optimize, solver.update, lambda s=solver: s.marginal([0])):
                with pytest.raises(expected):
                    solve()
                assert solver.values.tobytes() == before.tobytes(), name
        tell("singular_graphs", tried=1, failed=0)
