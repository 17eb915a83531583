"""A drive through a hall whose old visits are condensed, beside the same drive with all keyframes."""

import numpy as np
import pytest
from condensed_robot import Robot

from benchmarks.hall import hall, rms
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.graph.place import LABEL

KEYFRAMES, WINDOW, SEEDS = 700, 40, range(8)


def driven(world, window=0, until=None):
    robot = Robot(world, window)
    for k in range(until or len(world.poses)):
        robot.drive(k)
    return robot


@pytest.fixture(scope="module", params=[PLANAR, SPATIAL], ids=["plane", "space"])
def both(request):
    world = hall(2, KEYFRAMES, request.param)
    return driven(world), driven(world, WINDOW)


def test_visits_leave_the_problem(both):
    whole, bounded = both
    assert bounded.ends["first"] > 5 and bounded.ends["again"] > 5
    assert not bounded.ends.get("kept")
    assert len(bounded.solver.vertices) < WINDOW + 60 + 2 * len(bounded.marks) < 0.5 * len(whole.solver.vertices)
    assert len(bounded.solver.edges) < 0.5 * len(whole.solver.edges)
    assert len(bounded.path()) == KEYFRAMES


@pytest.mark.parametrize("space", [PLANAR, SPATIAL], ids=["plane", "space"])
def test_new_ground_is_known_as_well_as_with_all_keyframes(space):
    """First visits are marginalised out, and nothing is lost: odometry between them stays as it was measured."""
    world = hall(1, 120, space)
    whole, bounded = driven(world), driven(world, WINDOW)
    assert bounded.ends == {"first": bounded.ends["first"]} != {}
    newest = [robot.vertices[119] for robot in (whole, bounded)]
    poses = [robot.solver.estimate([one])[0] for robot, one in zip((whole, bounded), newest, strict=True)]
    variances = [np.diag(robot.solver.marginal([one])[0]) for robot, one in zip((whole, bounded), newest, strict=True)]
    assert variances[1] == pytest.approx(variances[0], rel=0.01)
    assert np.abs(poses[1] - poses[0]).max() < 0.02 * np.sqrt(variances[0].max())


@pytest.mark.parametrize("space", [PLANAR, SPATIAL], ids=["plane", "space"])
def test_the_map_stays_as_good_and_is_hardly_surer_than_with_all_keyframes(space):
    ratios = np.array([compared(seed, space) for seed in SEEDS])
    path, landmarks, least, most = np.exp(np.log(ratios).mean(axis=0))  # docs/lifelong.md has these figures
    in_plane = space is PLANAR
    assert path < (1.15 if in_plane else 1.25)
    # in space these means are 1.16 and 0.67 of 16 seeds, which differ so much that those of eight are off by 15 %
    assert landmarks < (1.15 if in_plane else 1.4)
    assert least > (0.8 if in_plane else 0.4)
    assert most < (2.5 if in_plane else 5.0)


def compared(seed, space):
    """Errors of path and landmarks, least and largest variance of any direction, over those with all keyframes."""
    world = hall(seed, KEYFRAMES, space)
    whole, bounded = driven(world), driven(world, WINDOW)
    true = np.array([pose[: space.dimensions] for pose in world.poses])
    marks = sorted(whole.marks)
    ids = [[robot.vertices[KEYFRAMES - 1], *(robot.marks[mark] for mark in marks)] for robot in (whole, bounded)]
    all_known, condensed = (robot.solver.joint_marginal(at) for robot, at in zip((whole, bounded), ids, strict=True))
    root = np.linalg.inv(np.linalg.cholesky(all_known))
    variances = np.linalg.eigvalsh(root @ condensed @ root.T)
    path, landmarks = (
        rms(*one) / rms(*other)
        for one, other in (
            ((bounded.path(), true), (whole.path(), true)),
            (bounded.landmarks(), whole.landmarks()),
        )
    )
    return path, landmarks, variances[0], variances[-1]


def test_later_visits_agree_with_those_before(both):
    _, bounded = both
    assert bounded.degrees > 50
    assert bounded.statistics < 1.4 * bounded.degrees


def test_a_place_is_a_single_edge_that_counts(both):
    _, bounded = both
    counting = {int(edge) for edge in bounded.solver.edges} & set(bounded.graph.edges_of(LABEL).tolist())
    places = [one for in_cell in bounded.condenser.places.values() for one in in_cell]
    assert counting == {one.edge for one in places}
    assert sum(one.place.visits for one in places) == bounded.ends["first"] + bounded.ends["again"]


def test_the_same_drive_gives_the_same_bytes():
    world = hall(5, 300)
    one, other = driven(world, 30), driven(world, 30)
    assert one.solver.values.tobytes() == other.solver.values.tobytes()
    assert one.path().tobytes() == other.path().tobytes()


def test_compacted_tables_have_what_counts_and_the_drive_goes_on_as_before():
    world = hall(3, 500)
    one, other = driven(world, 30, until=400), driven(world, 30, until=400)
    rows = one.graph.edge_count
    one.compact()
    other.solver.rebuild()  # it is linearised anew where it is, too
    other.solver.update()
    assert one.graph.edge_count == len(other.solver.edges) < 0.6 * rows
    assert one.graph.vertex_count == len(other.solver.vertices)
    newest = (robot.solver.marginal([robot.vertices[399]])[0] for robot in (one, other))
    assert next(newest) == pytest.approx(next(newest), rel=1e-5, abs=1e-10)
    assert one.path() == pytest.approx(other.path(), abs=1e-4)
    for k in range(400, 500):
        one.drive(k)
        other.drive(k)
    assert one.ends == other.ends
    assert one.path() == pytest.approx(other.path(), abs=1e-3)
    assert one.landmarks()[0] == pytest.approx(other.landmarks()[0], abs=1e-3)
    labels = [one.graph.label_of(edge) for edge in one.solver.edges.tolist()]
    assert labels.count(LABEL) == sum(map(len, one.condenser.places.values()))


def wrong_id(world, keyframes, true, said):
    """Sightings of one landmark under the id of another in some keyframes."""
    for k in keyframes:
        world.sightings[k] = [
            (said if one[0] == true else one[0], *one[1:]) for one in world.sightings[k] if one[0] != said
        ]
    return world


def test_a_visit_that_contradicts_itself_keeps_its_odometry_alone():
    world = hall(2, KEYFRAMES)
    seen = [{one[0] for one in here} for here in world.sightings]
    k = next(k for k in range(400, 600) if len(seen[k]) >= 2 and seen[k] == seen[k] & seen[k + 1])
    true, said = sorted(seen[k])[:2]
    clean = driven(world, WINDOW)
    noisy = driven(wrong_id(world, [k], true, said), WINDOW)
    assert noisy.ends["composed"] > clean.ends.get("composed", 0)
    assert rms(*noisy.landmarks()) < 1.5 * rms(*clean.landmarks())


def test_a_landmark_that_moved_is_left_out_once_and_then_known_anew():
    """Each place has its own strikes: the first visit leaves the landmark out, the second one begins it anew."""
    world = hall(2, 1400)
    mark = 17
    from_here, shift = 700, np.array([0.6, 0.4])
    for k in range(from_here, 1400):
        turn = world.space.turn(world.poses[k])
        world.sightings[k] = [
            (one, seen + turn.T @ shift if one == mark else seen, covariance)
            for one, seen, covariance in world.sightings[k]
        ]
    robot, told = Robot(world, WINDOW), []
    condense = robot.condenser.condense

    def watched(*given):
        done = condense(*given)
        names = {vertex: name for name, vertex in robot.marks.items()}  # vertices have new ids after a compaction
        told.append((names.get(done.without), names.get(done.anew), done))
        return done

    robot.condenser.condense = watched
    for k in range(1400):
        robot.drive(k)
    assert {name for name, _, _ in told} == {name for _, name, _ in told} == {None, mark}
    for without, anew, done in told:
        assert without is None or anew is None
        if mark in (without, anew):
            assert done.statistic > quantile(0.9999, done.degrees)


def test_what_cannot_be_condensed_stays_and_says_why():
    world = hall(1, 200)
    robot = driven(world, 0, until=150)
    visit = [robot.vertices[k] for k in range(1, 20)]
    before = robot.solver.values
    closure = robot.graph.add_edge(
        world.space.relative_pose,
        [visit[3], robot.vertices[100]],
        world.steps[0],
        Gaussian.from_sigmas(1, 1, 1),
        "by_hand",
    )
    robot.solver.add([], [closure])
    done = robot.condenser.condense(visit, robot.vertices[20], "here", ())
    assert done.how == "kept" and done.why == f"edge {closure} leads from the visit to vertex {robot.vertices[100]}"
    prior = robot.condenser.condense([robot.vertices[k] for k in range(4)], robot.vertices[4], "here", ())
    assert prior.how == "kept" and "pose prior" in prior.why
    assert not robot.condenser.places and len(robot.solver.vertices) == 150 + len(robot.marks)
    assert robot.solver.values.tobytes() == before.tobytes()
