"""A drive for tests of the running node: round a circle, with odometry that turns too far, past four tags."""

import math
import time

import numpy as np
from messages import detection, detections, odometry, pose, quaternion

from graph_slam_ros.lie import se2
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import Config, Odometry, Sighting, Sightings

TAGS = {"north": (0.0, 5.0), "east": (5.0, 1.0), "south": (1.0, -4.0), "west": (-4.0, 0.0)}
HOUR_NS = 3_600 * 10**9


class Drive:
    """Messages of a robot, step by step (0.1 m, ``step_s`` of stamp time): odometry, at every third what it sees.

    It begins an hour ago by default, so that nothing is in the future however fast it goes; ``frames`` is put before
    ``odom`` and ``base_link``, ``truth`` is where it starts in the world.
    """

    def __init__(self, start_ns=None, step_s=0.1, frames="", truth=se2.IDENTITY, turn=0.02):
        self.stamp_ns = time.time_ns() - HOUR_NS if start_ns is None else start_ns
        self._step_ns = round(step_s * 1e9)
        self._frames = frames
        self.truth, self.odom, self.turn = truth, se2.IDENTITY, turn
        self.sees = True
        self.claims = {}  # positions in its own frame of tags that are not there
        self.steps = 0
        self._trail = {}  # stamp to true pose, of each step that was sent

    def odometry(self):
        """Of now."""
        x, y, yaw = self.odom
        names = {"frame": f"{self._frames}odom", "child": f"{self._frames}base_link"}
        return odometry(pose(x, y, 0.0, quaternion(yaw=yaw)), stamp_ns=self.stamp_ns, **names)

    def seen(self, frame=None):
        """Of now."""
        found = []
        for name, at in TAGS.items():
            local = se2.act(se2.inverse(self.truth), at)
            found.append(detection(pose(*map(float, local)), np.eye(2) * 0.01, name))
        for name, at in self.claims.items():
            found.append(detection(pose(*at), np.eye(3) * 0.01, name))
        return detections(*found, frame=frame or f"{self._frames}base_link", stamp_ns=self.stamp_ns)

    def move(self):
        """Go on by a step."""
        self.stamp_ns += self._step_ns
        self.steps += 1
        self.truth = tuple(map(float, se2.compose(self.truth, (0.1, 0.0, self.turn))))
        self.odom = tuple(map(float, se2.compose(self.odom, (0.1, 0.0, 1.03 * self.turn))))

    def step(self, robot):
        """Send what there is now, and go on."""
        self._trail[self.stamp_ns] = self.truth
        robot.send("/odom", self.odometry())
        if self.sees and self.steps % 3 == 0:
            robot.send("/landmarks", self.seen())
        self.move()

    def off_by(self, robot):
        """How far the newest pose that was heard is from where the robot was at the pose's stamp.

        A busy machine publishes it some steps later, so where the robot is now says nothing.
        """
        message = robot.heard["pose"][-1]
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        sent = min(self._trail, key=lambda ns: abs(ns - stamp_ns), default=None)
        at = message.pose.pose.position
        return distance((at.x, at.y), self.truth if sent is None else self._trail[sent])

    def go(self, robot, steps, every=10):
        """So many steps, not more than a few unheard."""
        for k in range(steps):
            self.step(robot)
            if k % every == 0:
                robot.spin(0.005)

    def pace(self, robot):
        """For ``until``: a step where the node keeps up, and a moment to hear."""
        return lambda seconds: (robot.is_ahead or self.step(robot), robot.spin(seconds))


def distance(a, b):
    """Between two positions in the plane."""
    return math.hypot(a[0] - b[0], a[1] - b[1])


def earlier_run(folder, steps):
    """A run that is its ingest sequence alone, of a robot that went round and round; returns its stamps.

    What comes of it is made by who loads it.
    """
    recorder, stamps = RunRecorder(folder, Config()), range(10**15, 10**15 + steps * 200_000_000, 200_000_000)
    truth = odom = se2.IDENTITY
    for k, stamp_ns in enumerate(stamps):
        recorder.sink(Odometry(stamp_ns, odom, None, "odom"))
        if k % 20 == 0:
            seen = {name: tuple(map(float, se2.act(se2.inverse(truth), at))) for name, at in TAGS.items()}
            sightings = (Sighting(name, "position", at, (0.01, 0.0, 0.0, 0.01)) for name, at in seen.items())
            recorder.sink(Sightings(stamp_ns, "detections", tuple(sightings)))
        truth = tuple(map(float, se2.compose(truth, (0.3, 0.0, 0.06))))
        odom = tuple(map(float, se2.compose(odom, (0.3, 0.0, 0.0601))))
    recorder.close()
    return stamps
