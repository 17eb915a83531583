"""Odometry read in runs, by the places of its bytes, is what a decoder makes of it, with the same counters."""

import itertools
import math

import numpy as np
from messages import STAMP_NS, TWIST, border, counted, odometry, pose, quaternion
from rows import each

TILTED = {"roll": 0.02, "pitch": -0.01}
NAN_TWIST = np.full((6, 6), np.nan)
ODD = {
    "a stamp of zero": {"sec": 0, "nanosec": 0},
    "a negative stamp": {"sec": -1},
    "too many nanoseconds": {"nanosec": 1_000_000_000},
    "a position that is not finite": {"at": pose(math.nan, 1.0)},
    "an infinite position": {"at": pose(1.0, -math.inf)},
    "a position too far away": {"at": pose(1e10, 1.0)},
    "a quaternion of another length": {"at": pose(1.0, 1.0, q=quaternion(yaw=1.0, norm=1.05))},
    "a quaternion of no length": {"at": pose(1.0, 1.0, q=quaternion(norm=0.0))},
    "a robot that is higher up": {"at": pose(1.0, 1.0, 0.9)},
    "a robot that has fallen over": {"at": pose(1.0, 1.0, q=quaternion(roll=1.5))},
    "a robot that leans": {"at": pose(1.0, 1.0, q=quaternion(roll=0.3))},
    "another parent": {"frame": "world"},
    "another child": {"child": "wheel"},
    "names with a slash": {"frame": "/odom", "child": "/base_link"},
    "no names": {"frame": "", "child": ""},
    "a name in another alphabet": {"frame": "\u00f6dom"},
    "a frame in itself": {"frame": "base_link"},
    "another covariance": {"twist": 4.0 * TWIST},
    "no covariance": {"twist": np.zeros((3, 3))},
    "a covariance that is none": {"twist": -TWIST},
    "a covariance that is not finite": {"twist": NAN_TWIST},
}


def drive(count, **others):
    """Messages of a robot that drives in a bend; with words of ``odometry``."""
    for k in range(count):
        at = pose(0.02 * k, 1e-3 * k, 0.01, quaternion(yaw=0.01 * k, **TILTED))
        yield odometry(**({"at": at, "stamp_ns": STAMP_NS + 20_000_000 * k} | others))


def together(out, messages):
    """What is made of each message, of as many at once as can be."""
    measured, newest_ns = [], 0
    while len(measured) < len(messages):
        run = out.convert_run("odom", messages[len(measured) :], newest_ns)
        measured += [[m] for m in run]
        measured += [out.convert("odom", cdr) for cdr in messages[len(measured) :][:1]]
        newest_ns = max([newest_ns, *(m.stamp_ns for some in measured for m in some)])
    return measured


def converted(messages, *, in_runs, **sections):
    """What is made of messages, decoded or in runs, and what is counted."""
    out = border(**sections)
    measured = together(out, messages) if in_runs else [out.convert("odom", cdr) for cdr in messages]
    return [*measured, out.finish()], counted(out)


@each("dimensions, seed", [*itertools.product([2, 3], range(4))])
def test_any_messages_are_read_as_they_are_decoded(seed, dimensions):
    """Odd ones among plain ones, in any order, with stamps that stand still, leap and go back."""
    rng = np.random.default_rng(seed)
    messages, stamp_ns = [], STAMP_NS
    for _ in range(60):
        stamp_ns += int(rng.choice([20_000_000] * 12 + [0, -20_000_000, 3_000_000_000, -400_000_000]))
        odd = list(ODD.values())[rng.integers(len(ODD))] if rng.random() < 0.25 else {}
        at = pose(0.1 * len(messages), *rng.normal(0.0, 0.02, 2), quaternion(yaw=rng.normal(), **TILTED))
        messages.append(odometry(**({"stamp_ns": stamp_ns, "at": at} | odd)))
    space = {"dimensions": dimensions}
    assert converted(messages, in_runs=True, world=space) == converted(messages, in_runs=False, world=space)


def test_nearly_all_messages_are_not_decoded():
    messages = [*drive(50)]
    out = border()
    assert not out.convert_run(
        "odom", messages, 0
    )  # the first says how high the robot is, and its covariance is judged
    assert len(out.convert("odom", messages[0])) == 1
    assert len(out.convert_run("odom", messages[1:], 0)) == 49
