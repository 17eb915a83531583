"""The path as it changes: what is sent is what is new or has moved, and all of it together is the path."""

from types import SimpleNamespace

import numpy as np
from rows import each

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.messages import results
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.path_updates import PathUpdates
from graph_slam_ros.slam import Closure, Config, GraphSlam, Odometry

STAMP_NS = 1_700_000_000_000_000_000


def decoded(cdr):
    """Stamp of the message, and its poses (x, y, z, qx, qy, qz, qw) by stamp."""
    message = typestore().deserialize_cdr(cdr, results.PATH)
    poses = {}
    for stamped in message.poses:
        p, q = stamped.pose.position, stamped.pose.orientation
        poses[nanoseconds(stamped.header.stamp)] = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
    assert len(poses) == len(message.poses)
    return nanoseconds(message.header.stamp), poses


def nanoseconds(stamp):
    return stamp.sec * 10**9 + stamp.nanosec


def standing_in(space, poses, first=0):
    """What an update reads of a GraphSlam, with poses of our choice; ``first`` is the number of the first."""
    poses = np.array(poses, dtype=float)
    return SimpleNamespace(
        space=space,
        config=Config(),
        first_keyframe=first,
        keyframes=SimpleNamespace(stamps_ns=STAMP_NS + first + np.arange(len(poses))),
        trajectory=lambda: poses,
    )


def sent(updates, space, poses, first=0):
    """Which poses an update tells of."""
    cdr = updates.update(standing_in(space, poses, first))
    return None if cdr is None else [stamp - STAMP_NS for stamp in decoded(cdr)[1]]


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


def driven():
    """Twice round a square with odometry that turns a little too far."""
    at = (0.0, 0.0, 0.0)
    for k in range(80):
        yield Odometry(STAMP_NS + k * 10**9, at)
        at = se2.compose(at, (1.0, 0.0, (np.pi / 2 + 0.03) if k % 5 == 4 else 0.0))


def test_updates_put_together_by_stamp_are_the_path_within_the_thresholds():
    slam, updates, received, told = GraphSlam(), PathUpdates(0.05, 0.01), {}, []
    closure = (0.0, 0.0, 0.0), tuple((1e-4 * np.eye(3)).ravel().tolist())
    for k, m in enumerate(driven()):
        slam.process(m)
        if k in (45, 65):
            slam.process(Closure(m.stamp_ns - 10**9, m.stamp_ns - 41 * 10**9, "/closures", *closure))
        if slam.keyframes and (cdr := updates.update(slam)) is not None:
            newest, poses = decoded(cdr)
            assert newest == slam.keyframes[-1].stamp_ns
            received.update(poses)
            told.append(len(poses))
    _, path = decoded(results.path(slam))
    assert received.keys() == path.keys()
    sent, now = np.array([received[stamp] for stamp in path]), np.array(list(path.values()))
    sent[:, 3:] *= np.sign((sent[:, 3:] * now[:, 3:]).sum(axis=1, keepdims=True))  # a quaternion is as good negated
    worst = np.abs(sent - now).max()
    assert 0.0 < worst <= 0.05
    assert max(told[:40]) == 1 and max(told) > 20, "closures move many, odometry none"
    assert updates.version == len(told)
    assert updates.update(slam) is None
    assert decoded(updates.restart(slam)) == (0, {}), "all is forgotten"
    assert decoded(updates.update(slam)) == decoded(results.path(slam)), "and sent"
