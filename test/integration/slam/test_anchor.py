"""Where the map begins gives way to what measures where it lies: fixes, and landmarks that were surveyed."""

import numpy as np
import pytest

from graph_slam_ros.graph import POINT_PRIOR, R2
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.slam import Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.simulation import measurements, simulate
from graph_slam_ros.tools.simulation.recording import space_of

END = (Control("end"), Control("optimize"))
SMALL = {"warehouse": {"aisles": 2, "laps": 1, "aisle_m": 6.0}, "flight": {"laps": 1}}
T_EARTH_WORLD = {2: (300.0, -40.0, 2.5), 3: (300.0, -40.0, 15.0, *so3.exp((0.0, 0.0, 2.5)))}
HELD = {"anchor.sigma_m": 1e-3, "anchor.sigma_rad": 1e-3}


def fix(recording, k, kind, rng, sigma=0.05):
    """Of the pose at a stamp of odometry, in a frame of its own."""
    space = space_of(recording.T_world_base[0])
    n, dof = space.dimensions, space.dof
    at = space.group.compose(T_EARTH_WORLD[n], tuple(recording.T_world_base[k]))
    at = space.group.retract(at, tuple(sigma * rng.standard_normal(dof)))
    at = tuple(map(float, at))
    size, measured = {
        "pose": (dof, at),
        "position": (n, at[:n]),
        "heading": (1, (space.heading(at),)),
        "attitude": (3, at[3:]),
    }[kind]
    stamp_ns = int(recording.stamps_ns[k])
    return Fix(stamp_ns, kind, kind, measured, tuple((sigma**2 * np.eye(size)).ravel().tolist()))


def drive_with_fixes(recording, *kinds, every=40, begin=0.0, **settings):
    """Everything that the robot measures in order of stamp, and how it ends."""
    space, rng = space_of(recording.T_world_base[0]), np.random.default_rng(3)
    count = len(recording.stamps_ns)
    fixes = {
        int(recording.stamps_ns[k]): [fix(recording, k, kind, rng) for kind in kinds]
        for k in range(round(begin * count), count, every)
    }
    slam = GraphSlam(Config.from_mapping({"world.dimensions": space.dimensions, **settings}))
    for m in measurements(recording):
        slam.process(m)
        for one in fixes.pop(m.stamp_ns, []):
            slam.process(one)
    for event in END:
        slam.process(event)
    return slam


def errors(view, recording, T_earth_world):
    """Of every keyframe [m, rad], nothing aligned."""
    space = view.space
    at = np.searchsorted(recording.stamps_ns, view.keyframes.stamps_ns)
    true = space.group.compose(T_earth_world, tuple(recording.T_world_base[at].T))
    off = np.stack(space.group.local(tuple(view.trajectory().T), true), axis=1)
    n = space.dimensions
    return np.linalg.norm(off[:, :n], axis=1), np.linalg.norm(off[:, n:], axis=1)


@pytest.mark.parametrize(
    ("world", "kind", "begin"), [("warehouse", "position", 0.6), ("flight", "pose", 0.0), ("flight", "position", 0.6)]
)
def test_the_map_lies_in_the_frame_of_the_fixes_from_whenever_they_come(world, kind, begin):
    recording = simulate(world, 4, **SMALL[world])
    slam = drive_with_fixes(recording, kind, begin=begin)
    metres, radians = errors(slam.view, recording, T_EARTH_WORLD[slam.view.space.dimensions])
    assert metres.max() < 0.2
    assert radians.max() < 0.1
    assert slam.counters.as_dict() == {kind: {"map_moved": 1}}
    assert slam.view.ledger.outside_count <= 2


def test_a_heading_turns_the_map_about_where_it_begins_and_a_position_then_shifts_it():
    recording = simulate("warehouse", 4, **SMALL["warehouse"])
    slam = drive_with_fixes(recording, "heading")
    turned = se2.wrap(slam.view.trajectory()[:, 2] - recording.T_world_base[
        np.searchsorted(recording.stamps_ns, slam.view.keyframes.stamps_ns), 2] - 2.5)  # fmt: skip
    assert np.abs(turned).max() < 0.05
    assert np.abs(slam.view.trajectory()[0, :2]).max() < 1e-3
    assert np.sqrt(slam.view.keyframe_covariances()[0, 0, 0]) < 2e-3, "of its position the heading says nothing"
    slam = drive_with_fixes(recording, "heading", "position")
    metres, radians = errors(slam.view, recording, T_EARTH_WORLD[2])
    assert metres.max() < 0.15 and radians.max() < 0.05
    assert slam.counters.as_dict() == {"heading": {"map_moved": 1}, "position": {"map_moved": 1}}


def test_what_is_set_holds_and_the_fixes_are_not_believed():
    recording = simulate("warehouse", 4, **SMALL["warehouse"])
    slam = drive_with_fixes(recording, "position", **HELD)
    assert np.abs(slam.view.trajectory()[0]).max() < 0.01
    assert slam.counters.as_dict() == {}
    assert slam.view.ledger.outside_count == len(slam.view.graph.edges_of("fixes")) > 20


def test_of_a_start_that_is_given_the_map_does_not_move_and_the_fixes_correct_it():
    recording = simulate("warehouse", 4, **SMALL["warehouse"])
    start = np.add(se2.compose(T_EARTH_WORLD[2], tuple(recording.T_world_base[0])), (0.4, -0.3, 0.1))
    slam = drive_with_fixes(recording, "position", **{"anchor.pose": " ".join(map(str, start))})
    metres, _ = errors(slam.view, recording, T_EARTH_WORLD[2])
    assert metres.max() < 0.15
    assert slam.counters.as_dict() == {}


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
    metres, radians = errors(slam.view, recording, T_PLAN_WORLD[slam.view.space.dimensions])
    assert metres.max() < 0.5
    assert radians.max() < 0.1
    assert sum(counts.get("map_moved", 0) for counts in slam.counters.as_dict().values()) == 1
    assert slam.view.report.classes["surveyed"].edges == 1
    assert slam.view.ledger.outside_count <= 2


@pytest.mark.parametrize(("world", "which"), [("warehouse", "first"), ("flight", "later")])
def test_a_tag_whose_surveyed_orientation_is_wrong_is_doubted_and_does_not_turn_the_map(world, which):
    recording = simulate(world, 4, **SMALL[world])
    first, order = seen_at(recording, 0.0)
    wrong = first if which == "first" else order[len(order) // 2]
    view = driven(recording, survey(recording, order, turned=wrong)).view
    metres, radians = errors(view, recording, T_PLAN_WORLD[view.space.dimensions])
    assert metres.max() < 0.15
    assert radians.max() < 0.04
    vertex = view.landmarks[wrong].vertex
    edges = [edge for edge in view.graph.edges_of("landmarks").tolist() if view.graph.edge(edge).vertices[1] == vertex]
    assert sum(view.ledger.is_inside(edge) for edge in edges) <= 1 < len(edges), "one alone joins it to the rest"
    assert len(edges) - 1 <= view.ledger.outside_count <= len(edges) + 1


@pytest.mark.parametrize("kind", ["position", "range"])
def test_of_a_tag_that_is_seen_without_its_orientation_the_surveyed_position_is_used(kind):
    slam = GraphSlam(
        Config.from_mapping({"landmarks.surveyed": f"{HEADER[2]}\na,2,1,0.1,1.5,0.01\n", "ordering.window_s": 0.0})
    )
    slam.process(Odometry(0, se2.IDENTITY))
    measured = {"position": (2.0, 1.0), "range_bearing": (5**0.5, 0.46), "bearing": (0.46,), "range": (5**0.5,)}[kind]
    noise = tuple((0.01 * np.eye(len(measured))).ravel().tolist())
    slam.process(Sightings(0, "tags", (Sighting("a", kind, measured, noise),)))
    prior = slam.view.graph.tables[POINT_PRIOR[R2]]
    assert prior.measured.values.tolist() == [[2.0, 1.0]]
    assert prior.sqrt_information.values[0] == pytest.approx(10.0 * np.eye(2))
    assert slam.counters.as_dict()["tags"]["surveyed_orientation_unused"] == 1, "it is not silent"
