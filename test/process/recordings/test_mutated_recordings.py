"""Recordings to which something has happened are replayed to the end, and the path is hardly worse for it."""

import itertools
from functools import cache

import numpy as np
import pytest
from mutations import KINDS
from places import HAS_MRCLAM, WITHOUT_MRCLAM, mrclam
from reliability import tell, times

from graph_slam_ros.analysis.path_error import alignment, interpolated
from graph_slam_ros.analysis.trajectories import TRUE_LANDMARKS_TOPIC, TRUTH_TOPIC, read_truth
from graph_slam_ros.lie import se3
from graph_slam_ros.recordings.bag import BagWriter, open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag

MOST, MOST_WITH_LOSS = 1.2, 2.0  # times the error of the recording as it was
LONG_S = 300.0  # of a public recording
WORLDS = {
    "tags": ("warehouse", {"aisles": 2, "laps": times(1, 2), "aisle_m": 6.0}, {}),
    "ranges": (
        "warehouse",
        {"aisles": 2, "laps": 2, "aisle_m": 6.0, "sensor": "range_bearing"},
        {"detections.type": "sensor_msgs/msg/PointCloud2"},
    ),
    "flight": ("flight", {"laps": 1}, {"world.dimensions": 3}),
}
ROBOTS = (1, 2, 3, 4, 5)


class Recorded:
    """A recording with the truth, and what its error is as it is."""

    def __init__(self, bag, folder, config=(), end_s=np.inf):
        opened = open_bag(bag)
        self._types = {name: topic.type for name, topic in opened.topics.items()}
        everything = list(opened.messages(set(opened.topics) - {TRUTH_TOPIC, TRUE_LANDMARKS_TOPIC}))
        end_ns = everything[0].log_ns + end_s * 1e9
        self.messages = [m for m in everything if m.log_ns <= end_ns]
        self._truth, self._folder = read_truth(bag).trajectory, folder
        self._config = Config.from_mapping(dict(config))
        self.error_m, self._seconds, _ = self.replayed(self.messages)

    def replayed(self, messages, to_recorded=lambda stamps: stamps):
        """RMSE of the keyframes' positions [m], the seconds in which there are any, and the segments."""
        (self._folder / "bag.mcap").unlink(missing_ok=True)
        with BagWriter(self._folder / "bag.mcap") as bag:
            for m in messages:
                bag.write(m.topic, self._types[m.topic], m.log_ns, m.cdr)
        slam = replay(self._folder / "bag.mcap", self._folder / "run", self._config, force=True).slam
        path, stamps = slam.trajectory(), to_recorded(slam.keyframes.stamps_ns.astype(np.int64))
        assert np.isfinite(path).all()
        assert np.isfinite(slam.keyframe_covariances()).all()
        true, n = interpolated(self._truth, stamps * 1e-9), slam.space.dimensions
        known = np.isfinite(true).all(axis=1)
        assert known.mean() > 0.9
        points = np.zeros((known.sum(), 3))
        points[:, :n], true = path[known, :n], true[known, :n]
        moved = np.stack(se3.act(alignment(points[:, :n], true), tuple(points.T)), axis=1)[:, :n]
        error_m = float(np.sqrt(np.square(moved - true).sum(axis=1).mean()))
        return error_m, set((stamps // 10**9).tolist()), len(slam.segments)

    def judge(self, kind, seed):
        """What becomes of it."""
        mutated = KINDS[kind](self.messages, np.random.default_rng(seed))
        error_m, seconds, segments = self.replayed(mutated.messages, mutated.to_recorded)
        ratio, most = error_m / self.error_m, MOST_WITH_LOSS if mutated.lost else MOST
        near = seconds.union(*({s - 1, s + 1} for s in seconds))  # what is seen late makes no keyframe of its own:
        # there are half as many then, and no longer without one
        kept = len(near & self._seconds) / len(self._seconds)
        is_good = ratio <= most and kept >= 0.95 - mutated.lost and segments == mutated.segments
        tell("mutated_bags", tried=1, failed=int(not is_good), worst={"lossy" if mutated.lost else "whole": ratio})
        assert is_good, f"{error_m:.4f} m, {ratio:.2f} times; {100 * kept:.0f} % of the time, {segments} segments"


QUICK = [("tags", "drop"), ("tags", "delay"), ("tags", "jump_forward")]
CASES = times(QUICK, [*itertools.product(WORLDS, KINDS)])


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A recording of a world, replayed as it is when it is first asked for."""

    @cache
    def recorded(name):
        folder = tmp_path_factory.mktemp(name)
        world, options, config = WORLDS[name]
        write_bag(simulate(world, 3, **options), folder / "clean.mcap")
        return Recorded(folder / "clean.mcap", folder, config)

    return recorded


@pytest.mark.parametrize("world, kind", CASES)
def test_what_happens_to_a_recording_leaves_the_path_nearly_as_good(simulated, world, kind):
    simulated(world).judge(kind, 0)


@pytest.mark.skipif(not times(0, 1), reason="only in make soak")
@pytest.mark.skipif(not HAS_MRCLAM, reason=WITHOUT_MRCLAM)
@pytest.mark.parametrize("robot", ROBOTS)
def test_what_happens_to_a_public_recording_leaves_the_path_nearly_as_good(robot, tmp_path):
    public = Recorded(mrclam(robot, tmp_path / "clean"), tmp_path, end_s=LONG_S)
    failed = []
    for kind, seed in itertools.product(KINDS, range(5)):
        try:
            public.judge(kind, seed)
        except AssertionError as error:
            failed.append(f"{kind} {seed}: {error}")
    assert not failed
