"""Lives of a run in random order: drive, see, close, jump, save, reset, load, be killed; after each step all holds."""

import math
import random
import shutil

import numpy as np
import pytest
from reliability import tell, times

from graph_slam_ros.measurements.types import Fix, InitialPose
from graph_slam_ros.node.session import Session
from graph_slam_ros.runs.map_file import read_map
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Closure, Config, Control, Counters, Odometry, Sighting, Sightings

S = 1_000_000_000
TAGS = {"a": (2.0, 1.0), "b": (-1.0, 3.0), "c": (0.0, -2.0)}
STEPS = 100
HAPPENS = {"drive": 40, "see": 25, "close": 5, "killed": 4, "fix": 3, "flush": 3, "jump": 2, "save": 2, "load": 2}
HAPPENS |= {"pose": 1, "reset": 1}
"""How often what happens."""
RESULTS = ("graph.g2o", "ledger.csv", "ledger_changes.csv", "path.tum", "landmarks.csv")
COVARIANCE = (1e-3, 0.0, 0.0, 0.0, 1e-3, 0.0, 0.0, 0.0, 1e-3)


class Life:
    """A robot, and the computer on it: what is told of an update may not be lost."""

    def __init__(self, folder, seed):
        self.rng = random.Random(seed)
        config = {
            "output.folder": str(folder),
            "output.keep_earlier": 1,
            "solve.every_keyframes": self.rng.choice((1, 3)),
        }
        self.config, self.folder = Config.from_mapping(config), folder
        self.stamp_ns, self.at = 10**18, (0.0, 0.0, 0.0)
        self.acknowledged = []
        self.begin()

    def begin(self):
        self.session = Session(self.config, Counters(), self.heard, lambda *said: None)

    def heard(self, slam, _update):
        self.acknowledged = slam.view.keyframes.stamps_ns.tolist()

    # -- what may happen ---------------------------------------------------------------------------------------------

    def drive(self):
        for _ in range(self.rng.randint(1, 4)):
            step, turn = self.rng.uniform(0.0, 0.6), self.rng.uniform(-0.5, 0.5)
            x, y, theta = self.at
            theta += turn
            self.at = x + step * math.cos(theta), y + step * math.sin(theta), theta
            self.stamp_ns += S // 5
            self.take(Odometry(self.stamp_ns, self.at))

    def see(self):
        x, y, theta = self.at
        c, s = math.cos(theta), math.sin(theta)
        seen = []
        for name in self.rng.sample(sorted(TAGS), self.rng.randint(1, 3)):
            dx, dy = TAGS[name][0] - x, TAGS[name][1] - y
            wrong = self.rng.random() < 0.05
            measured = (c * dx + s * dy + 3.0 * wrong, -s * dx + c * dy)
            seen.append(Sighting(name, "position", measured, (0.01, 0.0, 0.0, 0.01)))
        self.take(Sightings(self.stamp_ns, "landmarks", tuple(seen)))

    def close(self):
        if self.acknowledged:
            from_ns = self.rng.choice(self.acknowledged[-20:])
            measured = tuple(self.rng.uniform(-1.0, 1.0) for _ in range(3))
            self.take(Closure(self.stamp_ns, from_ns, "closures", measured, COVARIANCE))

    def fix(self):
        self.take(Fix(self.stamp_ns, "fix", "position", self.at[:2], (0.04, 0.0, 0.0, 0.04)))

    def pose(self):
        self.take(InitialPose(self.at, COVARIANCE))

    def jump(self):
        self.stamp_ns += self.rng.choice((-100, -1, 50)) * S
        self.take(Control("time_jump"))

    def flush(self):
        self.take(Control(self.rng.choice(("flush", "optimize", "clear_closures"))))

    def save(self):
        self.session.save()

    def reset(self):
        self.session.reset()
        self.acknowledged = []

    def load(self):
        known = self.session.slam.view.keyframes.stamps_ns.tolist()
        if known:
            self.session.reset()
            self.session.load("")
            self.acknowledged = self.session.slam.view.keyframes.stamps_ns.tolist()
            assert self.acknowledged[: len(known)] == known

    def killed(self):
        """What is in memory is gone."""
        told = self.acknowledged
        self.session._recorder.abandon()
        self.begin()
        if told:
            assert self.session.was_cut_off
            self.session.load("")
        kept = self.session.slam.view.keyframes.stamps_ns.tolist()
        assert kept[: len(told)] == told, "an acknowledged keyframe is lost"
        self.acknowledged = kept

    # -- and what must hold ------------------------------------------------------------------------------------------

    def take(self, m):
        self.session.ingest([m])

    def step(self):
        (what,) = self.rng.choices(list(HAPPENS), list(HAPPENS.values()))
        getattr(self, what)()
        slam = self.session.slam
        assert np.isfinite(slam.view.trajectory()).all(), what
        assert not self.session.failures, (what, slam.counters.as_dict())
        assert len(slam.view.ledger) <= slam.view.graph.edge_count
        return what

    def end(self):
        """It is saved, its map is what it was, and a replay gives its bytes."""
        self.session.finish()
        if not self.session.slam.view.keyframes:
            return
        state = read_map(self.folder)
        assert state.keyframes.stamps_ns.tolist() == self.session.slam.view.keyframes.stamps_ns.tolist()
        assert state.ledger.verdict.values.tolist() == self.session.slam.view.ledger.verdict.values.tolist()
        again = self.folder.with_name("again")
        replay(self.folder, again)
        for name in RESULTS:
            assert (again / name).read_bytes() == (self.folder / name).read_bytes(), name


@pytest.mark.parametrize("part", range(times(1, 10)))
def test_T3_whatever_happens_in_whatever_order_nothing_that_was_told_is_lost(memory, part):
    count, steps = times(1, 300), times(STEPS, 2 * STEPS)
    for seed in range(part * count, (part + 1) * count):
        live(memory / str(seed), seed, steps)
    tell("lives", tried=count, steps=count * steps, failed=0)


@pytest.mark.parametrize("seed", times([], [363, 377, 1151, 2440, 2950]))
def test_T3_where_much_of_the_path_turns_no_solve_goes_astray(memory, seed):
    live(memory / str(seed), seed, 2 * STEPS)


def live(folder, seed, steps):
    life = Life(folder / "run", seed)
    done = []
    try:
        for _ in range(steps):
            done.append(life.step())
        life.end()
    except Exception as error:
        raise AssertionError(f"seed {seed}, after {' '.join(done[-12:])}") from error
    shutil.rmtree(folder)
