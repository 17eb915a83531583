"""Landmarks that were surveyed with their orientation: one of them puts the whole run into the frame of the survey."""

import numpy as np
import pytest

from graph_slam_ros.graph import POINT_PRIOR, R2
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.simulation import measurements, simulate
from graph_slam_ros.tools.simulation.motion import space_of

END = (Control("end"), Control("optimize"))
SMALL = {"warehouse": {"aisles": 2, "laps": 1, "aisle_m": 6.0}, "flight": {"laps": 1}}
T_PLAN_WORLD = {2: (12.0, -5.0, 2.0), 3: se3.from_xyz_rpy((30.0, -4.0, 15.0, 0.1, -0.2, 2.5))}
HEADER = {2: "id,x,y,sigma,yaw,sigma_rad", 3: "id,x,y,z,sigma,qx,qy,qz,qw,sigma_rad"}
SIGMA_M, SIGMA_RAD = 0.02, 0.01


def survey(recording, names, turned=None):
    """The lines of these tags in the frame of the plan; all but ``turned`` as they are."""
    space = space_of(recording.T_world_base[0])
    n = space.dimensions
    lines = [HEADER[n]]
    for name in names:
        at = space.group.compose(T_PLAN_WORLD[n], tuple(recording.landmarks[name]))
        if name == turned:
            at = space.group.compose(at, (0, 0, 1.5) if n == 2 else (0, 0, 0, *so3.exp((0.0, 0.0, 1.5))))
        lines.append(",".join(map(str, (name, *at[:n], SIGMA_M, *at[n:], SIGMA_RAD))))
    return "\n".join(lines) + "\n"


def driven(recording, text, **settings):
    n = space_of(recording.T_world_base[0]).dimensions
    given = {"world.dimensions": n, "landmarks.surveyed": text}
    slam = GraphSlam(Config.from_mapping(given | {key.replace("__", "."): value for key, value in settings.items()}))
    for m in (*measurements(recording), *END):
        slam.process(m)
    return slam


def errors(slam, recording):
    """Of every keyframe [m, rad] in the frame of the plan; nothing is aligned."""
    space = slam.space
    at = np.searchsorted(recording.stamps_ns, slam.keyframes.stamps_ns)
    true = space.group.compose(T_PLAN_WORLD[space.dimensions], tuple(recording.T_world_base[at].T))
    off = np.stack(space.group.local(tuple(slam.trajectory().T), true), axis=1)
    n = space.dimensions
    return np.linalg.norm(off[:, :n], axis=1), np.linalg.norm(off[:, n:], axis=1)


def seen_at(recording, part):
    """A tag that is seen for the first time after this part of the drive, and all that are seen in order."""
    names = [one.id for seen in recording.seen for one in seen.sightings]
    order = list(dict.fromkeys(names))
    return order[int(part * (len(order) - 1))], order


@pytest.mark.parametrize(("world", "part"), [("warehouse", 0.5), ("flight", 0.0)])
def test_one_tag_puts_the_run_into_the_frame_of_the_survey_whenever_it_comes(world, part):
    recording = simulate(world, 4, **SMALL[world])
    name, _ = seen_at(recording, part)
    slam = driven(recording, survey(recording, [name]))
    metres, radians = errors(slam, recording)
    assert metres.max() < 0.5
    assert radians.max() < 0.1
    assert sum(counts.get("map_moved", 0) for counts in slam.counters.as_dict().values()) == 1
    assert slam.report.classes["surveyed"].edges == 1
    assert slam.ledger.outside_count <= 2


@pytest.mark.parametrize(("world", "which"), [("warehouse", "first"), ("flight", "later")])
def test_a_tag_whose_surveyed_orientation_is_wrong_is_doubted_and_does_not_turn_the_map(world, which):
    recording = simulate(world, 4, **SMALL[world])
    first, order = seen_at(recording, 0.0)
    wrong = first if which == "first" else order[len(order) // 2]
    slam = driven(recording, survey(recording, order, turned=wrong))
    metres, radians = errors(slam, recording)
    assert metres.max() < 0.15
    assert radians.max() < 0.04
    vertex = slam.landmarks[wrong].vertex
    edges = [edge for edge in slam.graph.edges_of("landmarks").tolist() if slam.graph.edge(edge).vertices[1] == vertex]
    assert sum(slam.ledger.is_inside(edge) for edge in edges) <= 1 < len(edges), "one alone joins it to the rest"
    assert len(edges) - 1 <= slam.ledger.outside_count <= len(edges) + 1


def test_a_heading_that_is_set_is_not_turned_by_a_tag():
    world = "warehouse"
    recording = simulate(world, 4, **SMALL[world])
    slam = driven(recording, survey(recording, [seen_at(recording, 0.0)[0]]), anchor__sigma_rad=1e-3)
    assert slam.space.angle(tuple(slam.trajectory()[0].tolist())) < 1e-2


# -- what becomes of it in the graph ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_tag_seen_as_a_pose_has_one_prior_on_its_pose_with_the_noise_of_the_survey(dimensions):
    header = "id,x,y,z,sigma_x,sigma_y,sigma_z,roll,pitch,yaw,sigma_roll,sigma_pitch,sigma_yaw"
    text = f"{header}\na,2,1,3,0.1,0.2,0.3,0.4,0.5,1.5,0.01,0.02,0.03\n"
    slam = GraphSlam(
        Config.from_mapping({"landmarks.surveyed": text, "world.dimensions": dimensions, "ordering.window_s": 0.0})
    )
    space = slam.space
    slam.process(Odometry(0, space.identity))
    at = (2.0, 0.0, 0.3) if dimensions == 2 else (2.0, 0.0, 0.0, *so3.exp((0.0, 0.0, 0.3)))
    noise = tuple((1e-4 * np.eye(space.dof)).ravel().tolist())
    slam.process(Sightings(0, "tags", (Sighting("a", "pose", at, noise),)))
    begins = slam.trajectory()[0]
    slam.process(Sightings(0, "more tags", (Sighting("a", "pose", at, noise),)))
    slam.process(Control("optimize"))
    (edge,) = slam.graph.edges_of("surveyed").tolist()
    one = slam.graph.edge(edge)
    pose = (2, 1, 1.5) if dimensions == 2 else se3.from_xyz_rpy((2, 1, 3, 0.4, 0.5, 1.5))
    assert one.type is space.pose_prior
    assert tuple(one.measured) == pytest.approx(pose)
    covariance = space.in_parent_axes(pose, np.linalg.inv(one.sqrt_information.T @ one.sqrt_information))
    sigmas = [0.1, 0.2, 0.03] if dimensions == 2 else [0.1, 0.2, 0.3, 0.01, 0.02, 0.03]
    assert covariance == pytest.approx(np.diag(np.square(sigmas)), abs=1e-9)
    true = tuple(map(float, space.group.compose(pose, space.group.inverse(at))))
    for one in (begins, slam.trajectory()[0]):
        assert np.abs(space.group.local(tuple(one.tolist()), true)).max() < 1e-3, (
            "by one sighting, before and after the solve"
        )


@pytest.mark.parametrize("kind", ["position", "range"])
def test_of_a_tag_that_is_seen_without_its_orientation_the_surveyed_position_is_used(kind):
    slam = GraphSlam(
        Config.from_mapping({"landmarks.surveyed": f"{HEADER[2]}\na,2,1,0.1,1.5,0.01\n", "ordering.window_s": 0.0})
    )
    slam.process(Odometry(0, se2.IDENTITY))
    measured = {"position": (2.0, 1.0), "range_bearing": (5**0.5, 0.46), "bearing": (0.46,), "range": (5**0.5,)}[kind]
    noise = tuple((0.01 * np.eye(len(measured))).ravel().tolist())
    slam.process(Sightings(0, "tags", (Sighting("a", kind, measured, noise),)))
    prior = slam.graph.tables[POINT_PRIOR[R2]]
    assert prior.measured.values.tolist() == [[2.0, 1.0]]
    assert prior.sqrt_information.values[0] == pytest.approx(10.0 * np.eye(2))
    assert slam.counters.as_dict()["tags"]["surveyed_orientation_unused"] == 1, "it is not silent"
