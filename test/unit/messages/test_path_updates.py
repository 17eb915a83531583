"""The path as it changes: what is sent is what is new or has moved, and all of it together is the path."""

from types import SimpleNamespace

import numpy as np
from rows import each

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.lie import se3
from graph_slam_ros.messages import results
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.path_updates import PathUpdates
from graph_slam_ros.slam import Config

STAMP_NS = 1_700_000_000_000_000_000


def standing_in(space, poses, first=0):
    """What an update reads of a MapView, with poses of our choice; ``first`` is the number of the first."""
    poses = np.array(poses, dtype=float)
    return SimpleNamespace(
        space=space,
        config=Config(),
        keyframes=SimpleNamespace(first=first, stamps_ns=STAMP_NS + first + np.arange(len(poses))),
        trajectory=lambda: poses,
    )


def sent(updates, space, poses, first=0):
    """Which poses an update tells of."""
    cdr = updates.update(standing_in(space, poses, first))
    if cdr is None:
        return None
    stamps = [stamped.header.stamp for stamped in typestore().deserialize_cdr(cdr, results.PATH).poses]
    return [stamp.sec * 10**9 + stamp.nanosec - STAMP_NS for stamp in stamps]


def test_of_a_path_whose_first_keyframes_have_left_only_what_is_new_or_has_moved_is_sent():
    updates = PathUpdates(0.1, 0.2)
    path = [[float(k), 0.0, 0.0] for k in range(4)]
    assert sent(updates, PLANAR, path) == [0, 1, 2, 3]
    assert sent(updates, PLANAR, path[2:], first=2) is None
    moved = [path[2], [3.0, 0.5, 0.0], [4.0, 0.0, 0.0]]
    assert sent(updates, PLANAR, moved, first=2) == [3, 4]
    assert sent(updates, PLANAR, moved[1:], first=3) is None


@each("side", [-1.0, 1.0])
def test_in_space_a_turn_about_any_axis_is_one_whatever_the_sign_of_the_quaternion(side):
    rng, most = np.random.default_rng(2), 0.3
    for _ in range(50):
        pose, axis = se3.exp(tuple(rng.standard_normal(6))), rng.standard_normal(3)
        for angle, too_far in ((most - 1e-6, False), (most + 1e-6, True), (np.pi, True)):
            turned = se3.compose(pose, se3.exp((0.0, 0.0, 0.0, *(angle * axis / np.linalg.norm(axis)))))
            updates = PathUpdates(0.1, most)
            sent(updates, SPATIAL, [pose])
            assert sent(updates, SPATIAL, [[*turned[:3], *(side * np.array(turned[3:]))]]) == ([0] if too_far else None)
