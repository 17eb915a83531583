"""The odometry of a second publisher is no part of the odometry that is checked; outliers are."""

import numpy as np
from rows import each

from graph_slam_ros.check.columns import Columns, OdometryColumns
from graph_slam_ros.check.odometry import of_one_publisher
from graph_slam_ros.slam import Config, Counters

NS = 1_000_000_000


def rows(stamp_s, x_m):
    """Odometry along x, that stands at y = 0."""
    poses = np.zeros((len(stamp_s), 7))
    poses[:, 0], poses[:, 6] = x_m, 1.0
    return np.round(stamp_s * NS).astype(np.int64), poses


def columns(other_s, other_m, count=None):
    """A robot that drives at 1 m/s for 100 s, 20 messages a second, and messages that are refused."""
    own_s = np.arange(2000) * 0.05 + 1000.0
    own_ns, own = rows(own_s, own_s - 1000.0)
    other_ns, other = rows(other_s, other_m)
    order = np.argsort(np.concatenate([own_ns, other_ns]), kind="stable")
    stamp_ns, poses = np.concatenate([own_ns, other_ns])[order], np.concatenate([own, other])[order]
    unknown = np.full((len(stamp_ns), 6), np.nan)
    counters = Counters()
    for _ in range(len(other_s) if count is None else count):
        counters.count("odom", "other_publisher")
    odometry = OdometryColumns("odom", "/odom", "odom", "base_link", stamp_ns, poses, unknown, unknown)
    return Columns(Config(), {}, odometry, own_ns, own, (), (), counters)


@each("hz", [1.0, 20.0, 50.0])
def test_a_second_publisher_is_left_out_at_any_rate(hz):
    other_s = np.arange(round(95 * hz)) / hz + 1001.013
    whole = columns(other_s, 50.0 + 0.9 * (other_s - 1000.0))
    one = of_one_publisher(whole)
    assert len(whole.odometry.stamp_ns) == 2000 + len(other_s)
    assert one.odometry.stamp_ns.tolist() == whole.path_ns.tolist()


def test_outliers_and_what_is_not_counted_stay():
    rng = np.random.default_rng(1)
    at_s = np.sort(rng.uniform(1000.0, 1100.0, 40))
    outliers = columns(at_s, at_s - 1000.0 + rng.normal(0.0, 3.0, 40))
    assert of_one_publisher(outliers) is outliers
    few = columns(np.arange(9) + 1001.013, np.full(9, 50.0))
    assert of_one_publisher(few) is few
    regular_s = np.arange(95) + 1001.013
    for jumps in (columns(regular_s, rng.normal(0.0, 200.0, 95)), columns(regular_s, np.full(95, 50.0), count=0)):
        assert of_one_publisher(jumps) is jumps
