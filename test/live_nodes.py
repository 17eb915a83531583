"""The running node for tests, in processes of its own, and a robot that talks to it, on this machine's loopback."""

import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("vision_msgs")
pytest.importorskip("tf2_msgs")

from forked_nodes import Server
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from reliability import calm_s
from std_srvs.srv import Trigger
from vision_msgs.msg import Detection3DArray

from graph_slam_ros.messages import topics
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.node.player import own_domain
from graph_slam_ros.runs.replay import replay

RESULTS = ("graph.g2o", "path.tum", "sightings.tum", "landmarks.csv", "ledger.csv", "ledger_changes.csv")
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
PATIENCE_S = 10.0
PUBLICATIONS = {one.name.removeprefix("~/"): one for one in topics.PUBLICATIONS}
_HELD = contextlib.ExitStack()
ENVIRONMENT = dict(
    os.environ, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST", ROS_DOMAIN_ID=_HELD.enter_context(own_domain())
)


def often(times):
    """How many repetitions: ``make soak`` asks for more."""
    return times * int(os.environ.get("GRAPH_SLAM_SOAK", "1"))


def results(folder):
    return {name: (folder / name).read_bytes() for name in RESULTS}


def numbers(folder):
    return json.loads((folder / "run.json").read_text())


def replayed(run, tmp_path):
    replay(run, tmp_path / "replayed")
    return results(tmp_path / "replayed")


@functools.cache
def server():
    """What nodes and commands are forked from: with what was in the environment when the first of them started."""
    return Server(ENVIRONMENT)


def graph_slam(*words):
    """Run a command: what it said, and its exit code."""
    return server().run(["graph_slam", *map(str, words)], ENVIRONMENT, 600.0)


def until(condition, spin, what, patience_s=PATIENCE_S, but=lambda: ""):
    """Poll for what must come to be; ``but`` tells what there is instead."""
    deadline = calm_s() + patience_s
    while not condition():
        assert calm_s() < deadline, f"no {what} in {patience_s} s {but()}"
        spin(0.02)


class Robot:
    """A ROS node of the test's own: publishes what a robot would, and hears what the SLAM node ``of`` says."""

    def __init__(
        self,
        reliability=ReliabilityPolicy.RELIABLE,
        name="robot",
        of="/graph_slam",
        hears=("path", "pose", "landmarks", "/tf"),
        sends=("/odom", "/landmarks"),
    ):
        self.context = Context()
        self.context.init(args=[], domain_id=int(ENVIRONMENT["ROS_DOMAIN_ID"]))
        self.node = Node(name, context=self.context, namespace=of.rpartition("/")[0], start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._is_closed = False
        self._hears = threading.Thread(target=self._hear, daemon=True)
        self._of, self._clients, self._is_known = of, {}, set()
        qos = QoSProfile(depth=1000, reliability=reliability)
        kinds = {"/odom": Odometry, "/landmarks": Detection3DArray}
        self.publishers = {topic: self.node.create_publisher(kinds[topic], topic.lstrip("/"), qos) for topic in sends}
        self.heard = {}
        for topic in dict.fromkeys((*hears, "/diagnostics")):
            self.hear(topic)
        self._save = self.client("save")
        self._hears.start()

    def _hear(self):
        while not self._is_closed:
            self._executor.spin_once(timeout_sec=0.1)

    def hear(self, topic):
        """Keep what the SLAM node publishes there; returns the list it is kept in."""
        one, kept = PUBLICATIONS[topic], self.heard.setdefault(topic.lstrip("/"), [])
        qos = LATCHED if one.latched else RELIABLE
        self.node.create_subscription(message_class(one.type), one.resolved(self._of), kept.append, qos)
        return kept

    def publisher(self, topic, kind, qos=RELIABLE):
        """A publisher of what is not odometry and landmarks."""
        return self.node.create_publisher(kind, topic, qos)

    def said(self, status="health"):
        """Of each message of /diagnostics by the SLAM node this status, as (level, values); oldest first."""
        name = f"{self._of.lstrip('/')}: {status}"
        found = (s for m in self.heard["diagnostics"] for s in m.status if s.name == name)
        return [(s.level[0], {one.key: one.value for one in s.values}) for s in found]

    @property
    def is_ahead(self):
        """Whether many messages wait in the SLAM node, by the last of /diagnostics: a busy machine needs its time."""
        said = self.said()
        return bool(said) and int(said[-1][1].get("messages waiting", 0)) > 30

    @property
    def verdict(self):
        """The last state and its reasons; nothing before the first."""
        values = said[-1][1] if (said := self.said()) else {"state": ""}
        return "; ".join((values["state"], *(v for k, v in values.items() if k.startswith("reason "))))

    def until_it_says(self, state, *words, spin=None, patience_s=PATIENCE_S):
        """Wait for a state, with these words among its reasons."""
        self.heard["diagnostics"].clear()

        def is_said():
            verdict = self.verdict
            return verdict.split("; ")[0] == state and all(word in verdict for word in words)

        until(is_said, spin or self.spin, f"{state} {words}", patience_s, lambda: f"but {self.verdict}")

    def graph(self):
        """Numbers of the graph by the last of /diagnostics."""
        said = self.said("graph")
        return {key: float(value) for key, value in said[-1][1].items()} if said else {}

    def until_graph(self, spin=None, patience_s=PATIENCE_S, **values):
        """Wait for these numbers of the graph: /diagnostics comes once a second, so later than poses do."""

        def is_so():
            numbers = self.graph()
            return all(numbers.get(key) == value for key, value in values.items())

        until(is_so, spin or self.spin, f"graph with {values}", patience_s, lambda: f"but {self.graph()}")

    def set(self, values, together=True):
        """Set parameters: whether it was done and why not, of all of them or each."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        if together:
            request = SetParametersAtomically.Request(parameters=parameters)
            one = self.call("set_parameters_atomically", SetParametersAtomically, request).result
            return one.successful, one.reason
        answer = self.call("set_parameters", SetParameters, SetParameters.Request(parameters=parameters))
        return [(one.successful, one.reason) for one in answer.results]

    def get(self, names):
        """Values of parameters."""
        answer = self.call("get_parameters", GetParameters, GetParameters.Request(names=list(names)))
        return dict(zip(names, map(parameter_value_to_python, answer.values), strict=True))

    def change(self, transition, patience_s=PATIENCE_S):
        """Ask for a transition of the lifecycle by its name or number; whether it was done."""
        request = ChangeState.Request()
        if isinstance(transition, int):
            request.transition.id = transition
        else:
            request.transition.label = transition
        return self.call("change_state", ChangeState, request, patience_s).success

    def state(self):
        """Of the lifecycle."""
        return self.call("get_state", GetState).current_state.label

    def client(self, name, kind=Trigger):
        """Of a service of the SLAM node."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, f"{self._of}/{name}")
        return self._clients[name]

    def _introduce(self, name):
        """Wait until the node knows where to send the answers of a service: before that, it drops them after 0.1 s.

        Endpoints are announced in the order they are made. So the node knows this client when it answers a later one.
        """
        if name in self._is_known:
            return

        def is_answered():
            probe = self.node.create_client(GetState, f"{self._of}/get_state")
            until(probe.service_is_ready, self.spin, "service ~/get_state")
            future, again = probe.call_async(GetState.Request()), time.monotonic() + 2.0
            while not future.done() and time.monotonic() < again:
                self.spin(0.005)
            self.node.destroy_client(probe)
            return future.done()

        until(is_answered, self.spin, "answer of ~/get_state", 6 * PATIENCE_S)
        self._is_known.update(self._clients)

    def spin(self, seconds=0.02):
        """Leave a thread of its own the time to hear."""
        time.sleep(seconds)

    def settle(self, seconds=0.3):
        """Hear what is on its way: nothing for so long, but for diagnostics, which never end."""
        before, since = None, calm_s()
        while calm_s() - since < seconds:
            self.spin()
            count = sum(len(heard) for topic, heard in self.heard.items() if topic != "diagnostics")
            if count != before:
                before, since = count, calm_s()

    def wait_for_node(self):
        for topic, publisher in self.publishers.items():
            until(lambda p=publisher: p.get_subscription_count(), self.spin, f"subscriber of {topic}")
        until(self._save.service_is_ready, self.spin, "service ~/save")
        self._is_known.clear()  # the node may be another one now
        self.call("resume", patience_s=60.0)  # the worker answers, so its kernels are loaded

    def send(self, topic, cdr):
        self.publishers[topic].publish(cdr)

    def ask(self, name, kind=Trigger, request=None):
        """Call a service of the SLAM node: a future."""
        client = self.client(name, kind)
        until(client.service_is_ready, self.spin, f"service ~/{name}")
        self._introduce(name)
        return client.call_async(request or kind.Request())

    def call(self, name, kind=Trigger, request=None, patience_s=PATIENCE_S):
        """Call a service of the SLAM node: its answer."""
        future = self.ask(name, kind, request)
        until(future.done, self.spin, f"answer of ~/{name}", patience_s)
        return future.result()

    def save(self):
        return self.call("save")

    def save_in_turn(self):
        """Save after all that came before; asked again where a busy machine has lost the answer."""
        asked = []
        for patience_s in (10.0, 60.0):
            asked.append(self.ask("save"))
            with contextlib.suppress(AssertionError) if len(asked) == 1 else contextlib.nullcontext():
                until(lambda: any(one.done() for one in asked), self.spin, "answer of ~/save", patience_s)
                return

    def close(self):
        self._is_closed = True
        self._hears.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


def robot(**options):
    return contextlib.closing(Robot(**options))


MODULE = [sys.executable, "-m", "graph_slam_ros.node.node"]


class Started:
    """A SLAM node in a process of its own, with parameters ``name:=value``.

    ``by`` is the command that starts it, where its start is what is tested; by default it is forked where that can be.
    """

    def __init__(self, *parameters, by=None, cwd=None, remap=()):
        words = [word for flag, texts in (("-p", parameters), ("-r", remap)) for text in texts for word in (flag, text)]
        words = ["--ros-args", *words]
        if by is None and server().can_fork(ENVIRONMENT):
            self.process = server().start(["node", *words], ENVIRONMENT, cwd)
        else:
            self.process = subprocess.Popen(
                [*(by or MODULE), *words], env=ENVIRONMENT, cwd=cwd, stderr=subprocess.PIPE, text=True
            )
        self._lines = []
        self._reader = threading.Thread(target=self._read, daemon=True)  # a pipe that is full would hold it up
        self._reader.start()

    def _read(self):
        for line in self.process.stderr:
            self._lines.append(line)

    @property
    def said(self):
        """What it has logged so far."""
        return "".join(self._lines)

    @property
    def is_alive(self):
        return self.process.poll() is None

    def ended(self, timeout_s=PATIENCE_S):
        """Wait for its end by itself: (exit code, what it logged)."""
        until(lambda: not self.is_alive, time.sleep, "end", timeout_s, lambda: self.said)
        self._reader.join()
        self.process.stderr.close()
        return self.process.returncode, self.said

    def stop(self, number=signal.SIGINT):
        """Tell it to stop: (exit code, what it logged)."""
        self.process.send_signal(number)
        return self.ended()


@contextlib.contextmanager
def node(*parameters, **options):
    """A node; what still runs at the end is killed. A test that wants it killed leaves it running, and kills none.

    For each robot has to be closed before: Fast DDS 2.14 makes the shared memory of a killed process anew, and a
    participant that is closed meanwhile may read memory that is gone.
    """
    started = Started(*parameters, **options)
    try:
        yield started
    finally:
        if started.is_alive:
            started.process.kill()
            started.ended()


def finish(n, r):
    """Stop a node when it has processed all that has come; a busy one would leave the rest to its next start."""
    r.settle()
    r.save_in_turn()
    assert n.stop()[0] == 0
