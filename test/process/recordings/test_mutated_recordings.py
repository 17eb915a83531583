"""Recordings to which something has happened are replayed to the end, and the path is hardly worse for it."""

from dataclasses import replace

import numpy as np
import pytest
from places import HAS_MRCLAM, mrclam
from reliability import tell, times

from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.recordings.bag import BagWriter, open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag

S = 1_000_000_000
MOST, MOST_WITH_LOSS = 1.2, 2.0  # times the error of the recording as it was
WORLDS = {
    "tags": ("warehouse", {"aisles": 2, "laps": times(1, 2), "aisle_m": 6.0}, {}),
    "ranges": (
        "warehouse",
        {"aisles": 2, "laps": 2, "aisle_m": 6.0, "sensor": "range_bearing"},
        {"detections.type": "sensor_msgs/msg/PointCloud2"},
    ),
    "flight": ("flight", {"laps": 1}, {"world.dimensions": 3}),
}
ROBOTS = [str(robot) for robot in range(1, 6)] if HAS_MRCLAM else []  # of UTIAS MR.CLAM set 7


def later(messages, delay_ns):
    """In another order: each so much later."""
    moved = (replace(m, log_ns=m.log_ns + int(delay_ns(m))) for m in messages)
    return sorted(moved, key=lambda m: m.log_ns)


def gap(messages, rng):
    """For a tenth of the time nothing comes."""
    length = messages[-1].log_ns - messages[0].log_ns
    start = messages[0].log_ns + rng.uniform(0.2, 0.7) * length
    return [m for m in messages if not start < m.log_ns < start + 0.1 * length or is_list(m)]


def loop(messages, rng):
    """It is played twice, without /clock, while another records."""
    length_ns = messages[-1].log_ns - messages[0].log_ns + S
    return [*messages, *(replace(m, log_ns=m.log_ns + length_ns) for m in messages)]


def is_seen(m):
    return m.topic == "/landmarks"


def is_list(m):
    return m.topic in ("/tf_static", "/tf")


KINDS = {  # what becomes of messages in the order they came, whether a part of them is lost, and segments of the path
    "lost": (lambda ms, rng: [m for m in ms if rng.random() >= 0.2 or is_list(m)], True, 1),
    "twice": (
        lambda ms, rng: [*ms, *later([m for m in ms if rng.random() < 0.2], lambda m: 2 * S * rng.random())],
        False,
        1,
    ),
    "late": (lambda ms, rng: later(ms, lambda m: is_seen(m) * rng.uniform(0.5, 1.0) * S), False, 1),
    "in disorder": (lambda ms, rng: later(ms, lambda m: rng.uniform(0.0, 0.0499) * S), False, 1),
    "one source first": (
        lambda ms, rng: sorted(ms, key=lambda m: ((m.log_ns - ms[0].log_ns) // (S // 2), not is_seen(m), m.log_ns)),
        False,
        1,
    ),
    "gap": (gap, True, 1),
    "played twice": (loop, False, 2),
}


@pytest.mark.parametrize("world", times(["tags"], [*WORLDS, *ROBOTS]))
def test_what_happens_to_a_recording_leaves_the_path_nearly_as_good(world, tmp_path):
    clean, wrong = tmp_path / "clean.mcap", []
    if world in WORLDS:
        name, options, config = WORLDS[world]
        write_bag(simulate(name, 3, **options), clean)
    else:
        clean, config = mrclam(int(world), tmp_path / "clean", seconds=300.0), {}
    opened = open_bag(clean)
    messages = [
        m
        for m in opened.messages(opened.topics)
        if not m.topic.startswith(("/ground_truth", "/landmarks_ground_truth"))
    ]

    def error_m(some, segments):
        (tmp_path / "bag.mcap").unlink(missing_ok=True)
        with BagWriter(tmp_path / "bag.mcap") as bag:
            for m in some:
                bag.write(m.topic, opened.topics[m.topic].type, m.log_ns, m.cdr)
        slam = replay(tmp_path / "bag.mcap", tmp_path / "run", Config.from_mapping(config), force=True).slam
        assert np.isfinite(slam.view.trajectory()).all() and np.isfinite(slam.view.keyframe_covariances()).all()
        assert len(slam.view.segments) == segments
        return evaluate(tmp_path / "run", str(clean)).estimate.position_m["rmse"]

    before = error_m(messages, 1)
    for kind in times(["lost", "late"], KINDS):
        mutate, is_lossy, segments = KINDS[kind]
        ratio = error_m(mutate(messages, np.random.default_rng(0)), segments) / before
        wrong += [(kind, ratio)] if ratio > (MOST_WITH_LOSS if is_lossy else MOST) else []
        tell("mutated_bags", tried=1, failed=0, worst={"lossy" if is_lossy else "whole": ratio})
    assert not wrong
