"""Frames, with which old keyframes move: laid on the landmarks as they are now, and on one another."""

import base64

import numpy as np
import pytest

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.runs.condensed_map import _frames
from graph_slam_ros.slam.lifelong.frames import PresentLandmarks, _chain_step, chained, frame_of

FRAMES, STRETCH = 4, 5


@pytest.fixture(params=[PLANAR, SPATIAL], ids=["plane", "space"])
def space(request):
    return request.param


class Past:
    """A path of four stretches when it left the map, and landmarks around it, the last of which is a tag."""

    def __init__(self, space, sees):
        self.space, group, rng = space, space.group, np.random.default_rng(1)
        self.points = 4.0 * rng.standard_normal((6, space.dimensions))
        self.tag = (*self.points[-1].tolist(), *group.exp(tuple(rng.standard_normal(space.dof)))[space.dimensions :])
        step = group.exp((0.4, *[0.02] * (space.dof - 2), 0.1))
        poses = [space.identity]
        for _ in range(FRAMES * STRETCH - 1):
            poses.append(group.compose(poses[-1], step))
        self.poses = np.array(poses)
        several = []
        for k in range(FRAMES):
            at = tuple(self.poses[STRETCH * k + STRETCH // 2])
            landmarks = {10 + m: (self.tag if m == 5 else tuple(self.points[m]), 400.0) for m in sees[k]}
            frame = frame_of(space, (0, space.identity), at, landmarks)
            several.append((frame, range(STRETCH * k, STRETCH * (k + 1))))
        self.frames = chained(space, several, self.poses)
        self.at = self.poses[STRETCH // 2 :: STRETCH]

    def now(self, motion, moved=None):
        """Poses of the frames after all landmarks have moved together, and the base has not; one moved by itself."""
        space, group = self.space, self.space.group
        points = np.stack(group.act(motion, tuple(self.points.T)), axis=-1)
        if moved is not None:
            points[moved] += 5.0
        axes = np.zeros((6, space.dimensions, space.dimensions))
        axes[-1] = space.turn(group.compose(motion, self.tag))
        landmarks = PresentLandmarks(np.arange(10, 16), points, axes)
        bases = np.tile(np.array(space.identity, dtype=float), (FRAMES, 1))
        return self.frames.poses(space, bases, landmarks)

    def off(self, poses, motion):
        """Errors of the frames, if they should have moved by this."""
        group = self.space.group
        expected = np.stack(group.compose(motion, tuple(self.at.T)), axis=-1)
        return np.abs(np.stack(group.log(group.between(tuple(expected.T), tuple(poses.T))), axis=-1)).max(axis=1)


def motion_of(space):
    return space.group.exp((1.0, *[-0.1] * (space.dof - 2), 0.3))


def test_frames_move_with_the_landmarks_and_one_that_saw_none_with_its_neighbours(space):
    past, motion = Past(space, [range(5), (), range(4), ()]), motion_of(space)
    assert past.off(past.now(motion), motion).max() < 0.03
    assert past.off(past.now(space.identity), space.identity).max() < 1e-9


def test_without_links_it_would_stay_with_the_base(space):
    past, motion = Past(space, [range(5), (), range(4), ()]), motion_of(space)
    past.frames.rows["information"][:] = 0.0
    off = past.off(past.now(motion), motion)
    assert off[[0, 2]].max() < 0.03 < 0.2 < off[[1, 3]].min()


def test_one_tag_is_enough(space):
    past, motion = Past(space, [(5,), (), (), (5,)]), motion_of(space)
    assert past.off(past.now(motion), motion).max() < 0.05


def test_a_landmark_that_moved_since_then_has_no_say(space):
    past, motion = Past(space, [range(6)] * FRAMES), motion_of(space)
    assert past.off(past.now(motion, moved=2), motion).max() < 0.03


def test_frames_are_linked_only_where_no_keyframe_is_between_them(space):
    past = Past(space, [range(5)] * FRAMES)
    assert past.frames.rows["information"].any(axis=1).tolist() == [False, True, True, True]
    several = [(past.frames, range(5)), (past.frames, range(6, 11))]
    assert not chained(space, several, past.poses).rows["information"][FRAMES].any()


def test_the_step_of_a_chain_is_that_of_the_dense_system(space):
    rng, n, dof = np.random.default_rng(0), 6, space.dof
    normal, right = np.zeros((n, dof, dof)), rng.standard_normal((n, dof))
    normal[:] = np.eye(dof) * rng.uniform(0.1, 2.0, (n, 1, 1))
    links = np.array([1, 2, 4, 5])
    off, information = rng.standard_normal((4, dof)), rng.uniform(1.0, 5.0, (4, dof))
    by_before = rng.standard_normal((4, dof, dof))
    whole, side = np.zeros((n * dof, n * dof)), right.ravel().copy()
    for k in range(n):
        whole[k * dof : (k + 1) * dof, k * dof : (k + 1) * dof] = normal[k]
    for k, link in enumerate(links):
        jacobian = np.zeros((dof, n * dof))
        jacobian[:, (link - 1) * dof : link * dof] = by_before[k]
        jacobian[:, link * dof : (link + 1) * dof] = np.eye(dof)
        whole += jacobian.T @ np.diag(information[k]) @ jacobian
        side -= jacobian.T @ (information[k] * off[k])
    step = _chain_step(normal, right, off, by_before, information, links)
    assert step.ravel() == pytest.approx(np.linalg.solve(whole, side))


def test_frames_of_older_maps_have_no_links_and_no_axes(space):
    past = Past(space, [range(5)] * FRAMES)

    def text(rows, names):
        kind = np.dtype([(name, rows.dtype[name]) for name in names])
        out = np.empty(len(rows), kind)
        for name in names:
            out[name] = rows[name]
        return base64.b64encode(out.tobytes()).decode()

    record = {
        "frames": text(past.frames.rows, ("base", "T_base", "count")),
        "members": text(past.frames.members, ("landmark", "point", "weight")),
    }
    past.frames = _frames(record, space)
    assert not past.frames.rows["information"].any()
    motion = motion_of(space)
    assert past.off(past.now(motion), motion).max() < 0.03
