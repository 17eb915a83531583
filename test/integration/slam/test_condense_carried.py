"""Closures and fixes of keyframes that were condensed are carried to the bases of places, and can be doubted still."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hall import STEP_S, config, hall, measurements, rms
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.runs.condensed_map import condensed_record, read_condensed
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.runs.tables import account
from graph_slam_ros.runs.whole_path import removed_path
from graph_slam_ros.slam import Closure, Control, Fix, GraphSlam, Odometry
from graph_slam_ros.slam.lifelong.carried import carried_closure, fused_closure, inverse
from graph_slam_ros.slam.lifelong.removed import Left
from graph_slam_ros.slam.lifelong.surroundings import CHAIN
from graph_slam_ros.slam.robust.ledger import INSIDE

KEYFRAMES, WINDOW, NEAR_M, SIGMA_FIX_M = 900, 160, 3.0, 0.2
SHORT, SHORT_WINDOW = 500, 90  # where nothing is said of what many visits leave
SPACES = {"plane": PLANAR, "space": SPATIAL}


def with_closures(world):
    """Each third keyframe, a closure to the nearest of the last 150, but for the last 40."""
    rng, group = np.random.default_rng(1), world.space.group
    sigmas = np.array(world.space.sigmas(0.03, 0.01))
    where, k = np.array([pose[:2] for pose in world.poses]), -1
    for m in measurements(world):
        yield m
        k += isinstance(m, Odometry)
        first, last = max(0, k - 150), k - 40
        if isinstance(m, Odometry) and k % 3 == 0 and last > first:
            away = np.linalg.norm(where[first:last] - where[k], axis=1)
            j = first + int(np.argmin(away))
            if away.min() < NEAR_M:
                error = group.exp(tuple(sigmas * rng.standard_normal(len(sigmas))))
                motion = group.compose(group.between(world.poses[j], world.poses[k]), error)
                at_ns = round((j + 5) * STEP_S * 1e9)
                covariance = tuple(np.diag(sigmas**2).ravel().tolist())
                yield Closure(m.stamp_ns, at_ns, "loops", tuple(map(float, motion)), covariance)


def with_fixes(world):
    """Each fifth keyframe, a position in the frame of the first."""
    rng, group, n = np.random.default_rng(1), world.space.group, world.space.dimensions
    begin, k = group.inverse(world.poses[0]), -1
    for m in measurements(world):
        yield m
        k += isinstance(m, Odometry)
        if isinstance(m, Odometry) and k % 5 == 0:
            at = np.array(group.act(begin, world.poses[k][:n])) + SIGMA_FIX_M * rng.standard_normal(n)
            covariance = tuple((SIGMA_FIX_M**2 * np.eye(n)).ravel().tolist())
            yield Fix(m.stamp_ns, "gnss", "position", tuple(at.tolist()), covariance)


def driven(world, given, changed=None, **values):
    slam, parts = GraphSlam(config(world.space, **values)), []
    for m in given(world):
        update = slam.process(m)
        parts += [update.condensed] if update.condensed is not None else []
        if changed is not None:
            changed(slam)
    return slam, parts


@functools.cache
def condensed(space, given):
    """A drive whose map is condensed; nobody changes it."""
    return driven(hall(1, KEYFRAMES, SPACES[space]), given, map_condense=True, map_window_keyframes=WINDOW)


def path_of(slam, parts):
    left = Left.joined(slam.space, [one.left for one in parts])
    return np.concatenate((removed_path(slam, left), slam.trajectory()))[:, : slam.space.dimensions]


def errors(world, slam, parts):
    true = np.array([pose[: world.space.dimensions] for pose in world.poses])
    path = path_of(slam, parts)
    vertices = [mark.vertex for mark in slam.landmarks.values()]
    points = world.points[[int(name[1:]) for name in slam.landmarks]]
    return rms(path, true[: len(path)]), rms(slam.solver.estimate(vertices), points)


def old_closures(slam):
    """Closures between keyframes that are bases of places."""
    bases = {one.base for several in slam.bounded.places.values() for one in several}
    return [e for e in slam.graph.edges_of("closures").tolist() if bases.issuperset(slam.graph.edge(e).vertices)]


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("given", [with_closures, with_fixes])
def test_what_is_carried_serves_as_well(given, space):
    world = hall(1, KEYFRAMES, SPACES[space])
    whole = driven(world, given)
    small = condensed(space, given)
    slam = small[0]
    assert slam.first_keyframe > 0.5 * KEYFRAMES
    assert len(slam.solver.vertices) < 0.5 * len(whole[0].solver.vertices)
    counted = slam.counters.as_dict()["map"]
    assert set(counted) <= {"not_condensed", "visit_condensed", "visit_lost"}
    assert counted["not_condensed"] == 1  # the first keyframe, which has the prior
    for one, other in zip(errors(world, *small), errors(world, *whole), strict=True):
        assert one < (1.15 if space == "plane" else 1.3) * other
    if given is with_fixes:
        priors = [e for e in slam.graph.edges_of(CHAIN).tolist() if len(slam.graph.edge(e).vertices) == 1]
        gone = sum(edge.label == "fixes" for part in small[1] for edge in part.edges)
        assert 0 < len(priors) < 0.3 * gone  # one of each base, however many fixes there were
        assert slam.ledger.verdict.values[priors].max() == 0  # nobody judges them


def test_a_false_closure_that_was_condensed_is_outvoted_as_a_whole():
    world, planted = hall(1, KEYFRAMES), []

    def falsify(slam):
        """The first closure between places was false, and nobody had noticed until it was condensed."""
        if not planted and slam.bounded is not None and (found := old_closures(slam)):
            table, row = slam.graph.row(found[0])
            table.measured.values[row, 0] += 2.0
            slam.solver.rebuild()
            planted.append(slam.graph.edge_ids.of(found[0]))

    clean = condensed("plane", with_closures)
    slam, parts = driven(world, with_closures, falsify, map_condense=True, map_window_keyframes=WINDOW)
    assert planted
    slam.process(Control("optimize"))
    row = slam.graph.edge_ids.find(planted[0])
    gone = {edge.edge: edge for part in parts for edge in part.edges}
    if row is None:
        assert gone[planted[0]].became == "expired"
        verdict, reason = gone[planted[0]].verdict, gone[planted[0]].reason
    else:
        verdict, reason = slam.ledger.verdict_of(row), slam.ledger.reason.values.item(row)
    assert verdict not in INSIDE
    assert int(reason)
    for one, other in zip(errors(world, slam, parts), errors(world, *clean), strict=True):
        assert one < 1.2 * other


def test_a_closure_that_was_condensed_counts_once_and_a_false_one_never():
    """Closures are carried again and again, and made into one; those that were rejected leave with their drive."""
    world, inputs = hall(1, KEYFRAMES), {"inputs_names": "odom marks loops", "loops_use": "closure"}

    def some_false(world):
        for k, m in enumerate(with_closures(world)):
            is_false = isinstance(m, Closure) and k % 5 == 0
            yield replace(m, T_from_base=(m.T_from_base[0] + 9.0, *m.T_from_base[1:])) if is_false else m

    settings = inputs | {"loops_topic": "/loops"}
    whole, _ = driven(world, some_false, **settings)
    small, _ = driven(world, some_false, map_condense=True, map_window_keyframes=WINDOW, **settings)
    counts, wanted = (account(one, one.counters)["inputs"]["loops"] for one in (small, whole))
    assert 0 < wanted["believed"] < wanted["used"] - 5
    assert counts == wanted
    assert small.bounded.made
    again = read_condensed(small.graph.copy(), condensed_record(small.graph, small.first_keyframe, small.bounded))[1]
    assert again.made == small.bounded.made


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("given", [with_closures, with_fixes])
def test_without_landmarks_a_keyframe_of_each_cell_stays_and_has_what_was_measured(given, space):
    world = hall(1, SHORT, SPACES[space])
    world.sightings[:] = [[] for _ in world.sightings]
    whole = driven(world, given)
    small = driven(world, given, map_condense=True, map_window_keyframes=SHORT_WINDOW)
    slam = small[0]
    assert slam.first_keyframe > 0.5 * SHORT
    assert len(slam.solver.vertices) < 0.6 * len(whole[0].solver.vertices)
    counted = slam.counters.as_dict()["map"]
    assert counted.get("visit_lost", 0) == 0 < counted["visit_condensed"]
    assert {e.became for part in small[1] for e in part.edges if e.label != "anchor"} == {"condensed"}
    true = np.array([pose[: world.space.dimensions] for pose in world.poses])
    one, other = (rms(path, true[: len(path)]) for path in (path_of(*small), path_of(*whole)))
    assert one < (1.1 if given is with_closures else 1.25) * other
    now, before = (of.solver.marginal([of.keyframes[-1].vertex])[0] for of in (slam, whole[0]))
    root = np.linalg.inv(np.linalg.cholesky(before))
    ratios = np.linalg.eigvalsh(root @ now @ root.T)
    assert 0.9 < ratios[0] <= ratios[-1] < 2.5


def test_a_closure_to_a_keyframe_that_has_left_is_refused_by_name_where_none_was_expected():
    world, slam = hall(1, SHORT), GraphSlam(config(PLANAR, map_condense=True, map_window_keyframes=SHORT_WINDOW))
    for m in measurements(world):
        slam.process(m)
    assert slam.first_keyframe > 100
    covariance = tuple((0.01 * np.eye(3)).ravel().tolist())
    slam.process(Closure(m.stamp_ns, round(50 * STEP_S * 1e9), "loops", (1.0, 0.0, 0.0), covariance))
    slam.process(Control("end"))
    assert slam.counters["loops", "from_condensed_keyframe"] == 1


@pytest.mark.parametrize("space", SPACES)
def test_a_closure_to_a_keyframe_that_has_left_leads_to_its_base(space):
    """What it measures of the base, and how well, is compared with where the keyframe is by the map."""
    world = hall(1, SHORT, SPACES[space])
    inputs = {"inputs_names": "odom marks loops", "loops_use": "closure", "loops_topic": "/loops"}
    slam, parts = driven(world, measurements, map_condense=True, map_window_keyframes=SHORT_WINDOW, **inputs)
    poses = removed_path(slam, Left.joined(slam.space, [one.left for one in parts]))
    space, group, old = world.space, world.space.group, 50
    between = group.between(tuple(poses[old]), tuple(slam.trajectory()[-1]))
    covariance = tuple((0.01 * np.eye(space.dof)).ravel().tolist())
    at_ns = slam.keyframes[-1].stamp_ns
    slam.process(Closure(at_ns, round((old + 5) * STEP_S * 1e9), "loops", tuple(map(float, between)), covariance))
    slam.process(Control("end"))
    assert not slam.counters.as_dict().get("loops")
    (edge,) = map(slam.graph.edge, slam.graph.edges_of("closures").tolist())
    assert edge.vertices[0] in {one.vertex for one in slam.bounded.old}
    at = slam.solver.estimate(list(edge.vertices)).tolist()
    off = group.log(group.between(tuple(edge.measured), group.between(*map(tuple, at))))
    noise = np.linalg.inv(edge.sqrt_information.T @ edge.sqrt_information)
    assert np.array(off) @ np.linalg.solve(noise, off) < 1.0  # the path follows the landmarks, not the base alone
    assert np.linalg.eigvalsh(noise - 0.01 * np.eye(space.dof))[-1] > 1e-5  # that of the way from the base is added


@pytest.mark.parametrize("space", SPACES)
def test_closures_that_agree_become_one_and_others_do_not(space):
    slam, _ = condensed(space, with_closures)
    space = SPACES[space]
    edge = slam.graph.edge(slam.graph.edges_of("closures")[0])
    nothing = {edge.vertices[0]: (space.identity, np.zeros((space.dof, space.dof)))}
    same = carried_closure(space, edge, edge.vertices[0], nothing, 1.0)
    both = fused_closure(space, same, [edge], 0.9999)
    assert both.replaces == edge.id
    assert both.measured == pytest.approx(tuple(edge.measured), abs=1e-12)
    assert both.root.T @ both.root == pytest.approx(2.0 * edge.sqrt_information.T @ edge.sqrt_information, rel=1e-9)
    off = carried_closure(
        space,
        edge,
        edge.vertices[0],
        {edge.vertices[0]: ((1.0, *space.identity[1:]), nothing[edge.vertices[0]][1])},
        1.0,
    )
    assert fused_closure(space, off, [edge], 0.9999) is None


@pytest.mark.parametrize("space", SPACES)
def test_the_way_back_has_the_covariance_of_the_way_back(space):
    """Compared with random motions."""
    space, rng = SPACES[space], np.random.default_rng(0)
    group, root = space.group, 0.01 * rng.standard_normal((space.dof, space.dof))
    pose = group.exp(tuple(rng.standard_normal(space.dof)))
    back, covariance = inverse(space, (pose, root @ root.T))
    draws = [group.compose(pose, group.exp(tuple(root @ rng.standard_normal(space.dof)))) for _ in range(4000)]
    off = np.array([group.log(group.between(back, group.inverse(one))) for one in draws])
    assert off.T @ off / len(off) == pytest.approx(covariance, abs=0.08 * np.abs(covariance).max())


def test_fixes_that_were_condensed_can_be_exported_and_let_in(tmp_path):
    """Their sum says nothing of the heading where all were of one keyframe: its information is singular."""
    world, run = hall(1, 300), tmp_path / "run"
    world.sightings[:] = [[] for _ in world.sightings]
    settings = config(PLANAR, map_condense=True, map_window_keyframes=60)
    record_run(run, settings, [*with_fixes(world), Control("end")], [])
    saved = SavedGraph(run, [])
    priors = [e for e in saved.entries if e.label == CHAIN and len(e.vertices) == 1]
    singular = [e for e in priors if np.linalg.matrix_rank(e.information_matrix) < 3]
    assert singular
    file = read_g2o(run / "graph.g2o")
    assert not file.notes
    (table,) = (table for edge, table in file.graph.tables.items() if edge is PLANAR.pose_prior)
    read = [root.T @ root for root in table.sqrt_information.values]
    for one in priors:
        assert any(np.allclose(one.information_matrix, other, rtol=1e-9, atol=1e-9) for other in read)
    moved = saved.moved(saved.solve(let_in=[singular[0].edge]))
    assert moved.final[0] < 1e-6
