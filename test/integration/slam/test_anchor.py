"""Where the map begins gives way to what measures where it lies: fixes and surveyed landmarks, without a setting."""

import numpy as np
import pytest

from graph_slam_ros.lie import se2, so3
from graph_slam_ros.measurements.types import from_record, to_record
from graph_slam_ros.slam import Config, Control, Fix, GraphSlam
from graph_slam_ros.tools.simulation import measurements, simulate
from graph_slam_ros.tools.simulation.motion import space_of

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
    events = []
    slam._sink = events.append
    for m in measurements(recording):
        slam.process(m)
        for one in fixes.pop(m.stamp_ns, []):
            slam.process(one)
    for event in END:
        slam.process(event)
    return slam, events


def errors(slam, recording, T_earth_world):
    """Of every keyframe [m, rad], nothing aligned."""
    space = slam.space
    at = np.searchsorted(recording.stamps_ns, slam.keyframes.stamps_ns)
    true = space.group.compose(T_earth_world, tuple(recording.T_world_base[at].T))
    off = np.stack(space.group.local(tuple(slam.trajectory().T), true), axis=1)
    n = space.dimensions
    return np.linalg.norm(off[:, :n], axis=1), np.linalg.norm(off[:, n:], axis=1)


@pytest.mark.parametrize(
    ("world", "kind", "begin"), [("warehouse", "position", 0.6), ("flight", "pose", 0.0), ("flight", "position", 0.6)]
)
def test_the_map_lies_in_the_frame_of_the_fixes_from_whenever_they_come(world, kind, begin):
    recording = simulate(world, 4, **SMALL[world])
    slam, _ = drive_with_fixes(recording, kind, begin=begin)
    metres, radians = errors(slam, recording, T_EARTH_WORLD[slam.space.dimensions])
    assert metres.max() < 0.2
    assert radians.max() < 0.1
    assert slam.counters.as_dict() == {kind: {"map_moved": 1}}
    assert slam.ledger.outside_count <= 2


def test_a_heading_turns_the_map_about_where_it_begins_and_a_position_then_shifts_it():
    recording = simulate("warehouse", 4, **SMALL["warehouse"])
    slam, _ = drive_with_fixes(recording, "heading")
    turned = se2.wrap(slam.trajectory()[:, 2] - recording.T_world_base[
        np.searchsorted(recording.stamps_ns, slam.keyframes.stamps_ns), 2] - 2.5)  # fmt: skip
    assert np.abs(turned).max() < 0.05
    assert np.abs(slam.trajectory()[0, :2]).max() < 1e-3
    assert np.sqrt(slam.keyframe_covariances()[0, 0, 0]) < 2e-3, "of its position the heading says nothing"
    slam, _ = drive_with_fixes(recording, "heading", "position")
    metres, radians = errors(slam, recording, T_EARTH_WORLD[2])
    assert metres.max() < 0.15 and radians.max() < 0.05
    assert slam.counters.as_dict() == {"heading": {"map_moved": 1}, "position": {"map_moved": 1}}


def test_an_attitude_turns_a_map_in_space():
    recording = simulate("flight", 4, laps=1)
    slam, _ = drive_with_fixes(recording, "attitude")
    _, radians = errors(slam, recording, T_EARTH_WORLD[3])
    assert radians.max() < 0.05
    assert np.abs(slam.trajectory()[0, :3]).max() < 1e-3


def test_what_is_set_holds_and_the_fixes_are_not_believed():
    recording = simulate("warehouse", 4, **SMALL["warehouse"])
    slam, _ = drive_with_fixes(recording, "position", **HELD)
    assert np.abs(slam.trajectory()[0]).max() < 0.01
    assert slam.counters.as_dict() == {}
    assert slam.ledger.outside_count == len(slam.graph.edges_of("fixes")) > 20


def test_of_a_start_that_is_given_the_map_does_not_move_and_the_fixes_correct_it():
    recording = simulate("warehouse", 4, **SMALL["warehouse"])
    start = np.add(se2.compose(T_EARTH_WORLD[2], tuple(recording.T_world_base[0])), (0.4, -0.3, 0.1))
    slam, _ = drive_with_fixes(recording, "position", **{"anchor.pose": " ".join(map(str, start))})
    metres, _ = errors(slam, recording, T_EARTH_WORLD[2])
    assert metres.max() < 0.15
    assert slam.counters.as_dict() == {}


def test_the_same_events_give_the_same_bytes():
    recording = simulate("warehouse", 4, **SMALL["warehouse"])
    slam, events = drive_with_fixes(recording, "position", begin=0.3)
    again = GraphSlam(slam.config)
    for event in events:
        again.process(from_record(to_record(event)))
    assert again.trajectory().tobytes() == slam.trajectory().tobytes()
    assert again.keyframe_covariances().tobytes() == slam.keyframe_covariances().tobytes()
