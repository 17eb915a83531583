"""No columns, whatever is in them, make a check fail; each finding is one that JSON and a terminal can show."""

import json

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.check.checks import check_columns
from graph_slam_ros.check.columns import Columns, FixColumns, OdometryColumns, SightingColumns, TopicColumns, in_order
from graph_slam_ros.cli.check import lines
from graph_slam_ros.findings.finding import SEVERITIES
from graph_slam_ros.findings.table import COUNTED, TABLE
from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.lie import se3
from graph_slam_ros.slam import Config, Counters

START_NS = 1_700_000_000 * 10**9
ODD = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e308, -1e308, 1e-320, 1e9, -1.0)


def stamps(rng, count):
    """Regular ones, of which some are equal, zero, back or far away."""
    out = START_NS + np.cumsum(rng.integers(0, 3, count) * 50_000_000)
    for _ in range(rng.integers(0, 4)):
        if count:
            at = rng.integers(count)
            out[at:] = rng.choice([0, out[at], START_NS - 10**11, 2**62, 1, int(out[at]) + 10**13])
    return out.astype(np.int64)


def numbers(rng, *shape):
    """Usual ones, and now and then an odd one."""
    out = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 4)
    odd = rng.random(shape) < rng.choice([0.0, 0.0, 0.05, 1.0])
    out[odd] = rng.choice(ODD, odd.sum())
    return out


def poses(rng, count):
    out = numbers(rng, count, 7)
    if rng.random() < 0.7:
        turn = np.cumsum(rng.normal(size=count)) * 0.1
        out[:, 3:] = np.column_stack([0 * turn, 0 * turn, np.sin(turn), np.cos(turn)])
    return out


def columns(seed):
    rng = np.random.default_rng(seed)
    dimensions = int(rng.choice([2, 3]))
    config = Config.from_mapping({"world.dimensions": dimensions})
    n, k = (int(x) for x in rng.choice([0, 1, 2, 9, 10, 11, 60, 400], 2))
    odometry_ns, seen_ns = stamps(rng, n), stamps(rng, k)
    frames = ("", "odom", "base_link", "map", "camera", "/camera")
    pick = lambda: str(rng.choice(frames))  # noqa: E731
    has_twist = rng.random() < 0.7
    rest = [numbers(rng, n, 6) if has_twist else np.full((n, 6), np.nan) for _ in range(2)]
    o = OdometryColumns("odom", "/odom", pick(), pick(), odometry_ns, poses(rng, n), *rest)
    path = poses(rng, n)
    if dimensions == 3 or rng.random() < 0.9:  # the converters make unit quaternions of finite poses
        path = se3.in_space(np.nan_to_num(path[:, :3], posinf=1e8, neginf=-1e8).clip(-1e8, 1e8)).reshape(-1, 7)
    names = tuple(str(rng.integers(9)) if rng.random() < 0.8 else "" for _ in range(max(1, k // 4)))
    names = tuple(dict.fromkeys(names))
    seen = SightingColumns(
        "detections",
        "/landmarks",
        seen_ns,
        names,
        rng.integers(0, len(names), k),
        numbers(rng, k, 3),
        np.abs(numbers(rng, k)) if rng.random() < 0.3 else np.full(k, np.nan),
        numbers(rng, k) if rng.random() < 0.3 else np.full(k, np.nan),
        np.abs(numbers(rng, k)),
        pick(),
        tuple(rng.choice([0.0, 1.0], 3)) + tuple(se3.IDENTITY[3:]),
    )
    inputs = ("/odom", "odom", "odometry", odometry_ns), ("/landmarks", "detections", "landmarks", seen_ns)
    lag_ns = {name: rng.integers(0, 10**9, len(stamp_ns)) for name, _, _, stamp_ns in inputs}
    topics = {
        name: TopicColumns(name, (own,), use, stamp_ns + lag_ns[name], stamp_ns, {pick(): 1})
        for name, own, use, stamp_ns in inputs
    }
    counters = Counters()
    for reason in rng.choice(list(COUNTED), 3):
        counters.count(str(rng.choice(["odom", "detections", "tf"])), str(reason), int(rng.integers(1, 500)))
    links = tuple((pick(), pick()) for _ in range(rng.integers(0, 6)))
    assumed = {"detections.offset_s": -2.5, "detections.mount": "0 0 0 0 0 0", "odom.mount": "0 0 0 0 0 0"}
    x, y, yaw = 10.0 * rng.normal(size=(3, n))  # at stamps of which some are years from the others
    fixes = FixColumns("gps", "/gps", stamps(rng, n), x + 1j * y, yaw, 0.1, pick(), se3.IDENTITY)
    chosen = assumed if rng.random() < 0.3 else {}
    driven = in_order(odometry_ns, path)
    return Columns(config, topics, o, *driven, (seen,), links, counters, chosen, fixes=(fixes,))


@pytest.mark.filterwarnings("error")
def test_no_columns_make_a_check_fail():
    codes = set()
    for seed in range(times(200, 600)):
        found = check_columns(columns(seed))
        assert [SEVERITIES.index(one.severity) for one in found] == sorted(SEVERITIES.index(f.severity) for f in found)
        for one in found:
            assert one.code in TABLE
            assert json.loads(json.dumps(one.as_dict(), allow_nan=False))["code"] == one.code
            assert all(line.strip() for line in lines(one))
            for setting in one.settings:
                parse_setting(setting)
            codes.add(one.code)
    assert len(codes) > 25, sorted(codes)


def test_empty_columns_have_no_odometry():
    no_stamp, no_pose = np.empty(0, dtype=np.int64), np.empty((0, 7))
    odometry = OdometryColumns("", "", "", "", no_stamp, no_pose, *np.empty((2, 0, 6)))
    nothing = Columns(Config(), {}, odometry, no_stamp, no_pose, (), (), Counters())
    assert [one.code for one in check_columns(nothing)] == ["no_odometry"]
