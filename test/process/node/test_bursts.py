"""Calls of all services in random order, with arguments as extreme as their types allow, while the robot drives."""

import math
import random
from collections import Counter

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.srv import ChangeState, GetAvailableStates
from live_drive import Drive
from live_nodes import node, robot, until
from messages import pose, posed, quaternion
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter as RosParameter
from reliability import tell, times
from std_msgs.msg import String
from std_srvs.srv import Trigger

from graph_slam_ros.config.config import flatten, parameters
from graph_slam_ros.slam import Config

NUMBERS = [0.0, -0.0, 1.0, -1.0, 1e-308, 5e-324, 1e9, 1e12, 1.7e308, -1.7e308, math.nan, math.inf, -math.inf]
NAMES = ["", ".", "..", "../up", "/etc", "a/b", "-rf", "run", "run-1", "nobody", "site", "x" * 300, "\n\x1b[31m"]
NAMES += ["\u00e9", "*"]
FRAMES = ["map", "map", "/map", "odom", "nowhere", "", "map " * 100]
TRIGGERS = ["save", "load", "reset", "pause", "resume", "resume", "optimize", "clear_closures"]
REMOVALS = ["", "edge", "edge -1", "edge 0", "edge 999999999999999999", "edge 1e9", "landmark nobody", "landmark west",
            "edge 12", "landmark \x00", "edge 1; edge 2", "landmark " + "y" * 2000]  # fmt: skip
PARAMETERS = list(parameters(one.name for one in Config().sources))
LIVE = {p.name for p in PARAMETERS if p.live}
DEFAULTS = dict(flatten(Config().as_mapping()))


def extreme(p, rng):
    """A value for a parameter: of its type at its limits and beyond, or of another type."""
    if rng.random() < 0.1:
        return rng.choice([True, 3, 0.5, "text", [1.0, math.nan], ["a"], [True], b"\x00"])
    if p.type is bool:
        return rng.random() < 0.5
    if p.type is int:
        return int(rng.choice([p.low or 0, p.high or 10**9, -1, 0, 2**31, 2**63 - 1, -(2**63)]))
    if p.type is float:
        return float(rng.choice([x for x in (p.low, p.high) if x is not None] + NUMBERS))
    return rng.choice([*p.choices, *NAMES, "nan nan nan", "1e308 1 1", "0 0 0"])


class Burst:
    """A robot that drives and asks at once."""

    def __init__(self, r, seed):
        self.r, self.rng, self.drive = r, random.Random(seed), Drive()
        self.rng_np = np.random.default_rng(seed)
        self.initial = r.publisher("/initialpose", PoseWithCovarianceStamped)
        self.remove = r.publisher("/graph_slam/remove", String)
        self.asked, self.answers, self.pending = Counter(), Counter(), []

    def call(self, name, kind, request):
        self.asked[name] += 1
        self.pending.append((name, self.r.ask(name, kind, request)))

    def step(self):
        self.drive.step(self.r)
        what = self.rng.choice(
            [self.say_pose, self.trigger, self.trigger, self.take_out, self.set, self.set, self.query]
        )
        what()
        if len(self.pending) > 20:
            self.wait()

    def wait(self):
        for name, future in self.pending:
            until(future.done, self.r.spin, f"answer of {name}", 60.0)
            answer = future.result()
            assert answer is not None, name
            if isinstance(answer, Trigger.Response):
                assert answer.message or name in ("pause", "resume"), f"{name} says nothing"
                self.answers[name, answer.success] += 1
        self.pending.clear()

    def say_pose(self):
        rng, number = self.rng, lambda usual: self.rng.choice(NUMBERS) if self.rng.random() < 0.3 else usual
        q = quaternion(yaw=0.3, norm=rng.choice([1.0, 1.0, 0.0, 1e-9, 1e200, math.nan]))
        covariance = np.diag(rng.choice([[0.1] * 6, [0.0] * 6, [-1.0] * 6, [math.nan] * 6, [1e308] * 6, [1e-300] * 6]))
        if rng.random() < 0.2:
            covariance = self.rng_np.standard_normal((6, 6))
        at = pose(number(1.0), number(-2.0), number(0.0), q)
        self.initial.publish(posed("PoseWithCovarianceStamped", at, rng.choice(FRAMES), covariance))
        self.asked["initialpose"] += 1

    def trigger(self):
        name = self.rng.choice(TRIGGERS)
        if name in ("save", "load"):
            value = RosParameter("output.save_as" if name == "save" else "output.load", value=self.rng.choice(NAMES))
            request = SetParametersAtomically.Request(parameters=[value.to_parameter_msg()])
            self.call("set_parameters_atomically", SetParametersAtomically, request)
        self.call(name, Trigger, Trigger.Request())

    def take_out(self):
        self.remove.publish(String(data=self.rng.choice(REMOVALS)))
        self.asked["remove"] += 1

    def set(self):
        given = []
        for p in self.rng.sample([p for p in PARAMETERS if p.live or self.rng.random() < 0.2], 2):
            value = extreme(p, self.rng)
            try:
                given.append(RosParameter(p.name, value=value).to_parameter_msg())
            except (TypeError, ValueError):
                continue
        if self.rng.random() < 0.2:
            unset = ParameterValue(type=self.rng.choice([ParameterType.PARAMETER_NOT_SET, 77]))
            given.append(Parameter(name=self.rng.choice(["", "nobody", "solve.method", "x" * 1000]), value=unset))
        kind = self.rng.choice([SetParameters, SetParametersAtomically])
        self.call(
            "set_parameters" if kind is SetParameters else "set_parameters_atomically",
            kind,
            kind.Request(parameters=given),
        )

    def query(self):
        names = [self.rng.choice(["", "nobody", "solve.method", "a" * 5000, *LIVE]) for _ in range(3)]
        depth = self.rng.choice([0, 1, 2**64 - 1])
        change = ChangeState.Request()
        change.transition.id, change.transition.label = self.rng.choice([0, 1, 3, 77, 255]), self.rng.choice(["", "up"])
        for name, kind, request in self.rng.sample(
            [
                ("get_parameters", GetParameters, GetParameters.Request(names=names)),
                ("describe_parameters", DescribeParameters, DescribeParameters.Request(names=names)),
                ("list_parameters", ListParameters, ListParameters.Request(prefixes=names, depth=depth)),
                ("change_state", ChangeState, change),
                ("get_available_states", GetAvailableStates, GetAvailableStates.Request()),
            ],
            2,
        ):
            self.call(name, kind, request)


def test_P25_whatever_is_asked_of_a_driving_node_in_whatever_order_it_answers_and_goes_on(tmp_path):
    parameters = f"output.folder:={tmp_path / 'data' / 'run'}", "inputs.reliable:=true", "journal.resume:=false"
    with node(*parameters) as n, robot(hears=("/diagnostics", "pose", "/tf"), name="asker") as r:
        r.wait_for_node()
        burst, asked = Burst(r, 17), times(60, 2000)
        while burst.asked.total() < asked:
            burst.step()
        burst.wait()
        assert r.state() == "active"
        assert r.set({name: DEFAULTS[name] for name in LIVE}) == (True, "")
        for name in ("reset", "resume"):
            assert r.call(name, patience_s=60.0).success
        for name in ("deactivate", "activate"):  # its transforms may have been dated in the future
            assert r.change(name)
        for heard in r.heard.values():
            heard.clear()
        r.until_it_says("OK", spin=burst.drive.pace(r), patience_s=30.0)
        until(lambda: len(r.heard["pose"]) > 5 and len(r.heard["tf"]) > 5, burst.drive.pace(r), "pose and transforms")
        assert all(math.isfinite(m.pose.pose.position.x) for m in r.heard["pose"])
        assert r.call("save", patience_s=60.0).success
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said, n.said
    assert {p.name for p in tmp_path.iterdir()} == {"data"}, "nothing is written elsewhere"
    tell("service_bursts", tried=burst.asked.total(), failed=0)
