"""A recording of range differences between beacons, in a message type that no package but a test's own has."""

import re
from contextlib import contextmanager

import numpy as np
from installed import installer
from messages import STAMP_NS, odometry, pose, quaternion, recorded, transforms
from places import ROOT
from recordings import definition, write_mcap

from graph_slam_ros import edge_tags
from graph_slam_ros.lie import se2
from graph_slam_ros.messages.inputs import plugins
from graph_slam_ros.messages.to_msg import header

PAGE = (ROOT / "docs/library.md").read_text()
(EXAMPLE,) = re.findall(r'```python\n("""Reads my_msgs/msg/RangeDifference.*?)```', PAGE, re.DOTALL)
(ENTRIES,) = re.findall(r'```toml\n(\[project.entry-points."graph_slam_ros.inputs"\]\n"my_msgs.*?)```', PAGE, re.DOTALL)
(DEFINITION,) = re.findall(r'DEFINITION = """(.*?)"""', EXAMPLE, re.DOTALL)
TYPE, TAG = "my_msgs/msg/RangeDifference", "EDGE_TDOA"
BEACONS = {"north": (2.0, 9.0), "south": (3.0, -4.0), "east": (9.0, 1.0), "west": (-6.0, 2.0)}
SURVEY = "id,x,y,sigma\n" + "".join(f"{name},{x},{y},0.01\n" for name, (x, y) in BEACONS.items())
SETTINGS = {
    "inputs.names": "odom tdoa",
    "tdoa": {"type": TYPE, "topic": "/tdoa", "sigma_m": 0.03},
    "landmarks.surveyed": SURVEY,
    "anchor.pose": "0 0 0",
    "anchor.sigma_m": 0.1,
    "anchor.sigma_rad": 0.05,
}
STEPS, WRONG = 150, (60, 100)  # of odometry at 10 Hz; steps at which a difference is 3 m too large


GROUP, NAME, MODULE, AT = re.search(r'\."(.*)"\]\n"(.*)" = "(\w+):(\w+)"', ENTRIES).groups()
EDGES = (
    re.sub(r' = "(.*)"', r" = \1", ENTRIES.split("\n\n")[1]).replace('project.entry-points."', "").replace('"]', "]")
)


@contextmanager
def example_installer(folder, monkeypatch):
    """A function that installs the package of the page, or another text of it; nothing of a plugin is loaded before."""
    monkeypatch.setattr(edge_tags, "_loaded", {})
    monkeypatch.setattr(edge_tags, "_tags", {})
    monkeypatch.setattr(plugins, "_loaded", {})
    with installer(folder, monkeypatch) as install:

        def installed(text=EXAMPLE, edges=EDGES, module=MODULE, name=NAME):
            return install(text, group=GROUP, name=name, module=module, at=AT, more=edges)

        yield installed


def truths(steps=STEPS):
    """The true pose at each step, and the one that odometry says: it turns too far."""
    truth = said = se2.IDENTITY
    for _ in range(steps):
        yield truth, said
        truth, said = se2.compose(truth, (0.1, 0.0, 0.03)), se2.compose(said, (0.1, 0.0, 0.033))


def recording(file, *, steps=STEPS, wrong=WRONG):
    """A circle among beacons; 40 ms after each odometry the difference of two ranges."""
    _, _, encoded = recorded(TYPE, DEFINITION)
    sent, names, noise = [("/tf_static", STAMP_NS, transforms())], list(BEACONS), np.random.default_rng(3)
    for k, (truth, said) in enumerate(truths(steps)):
        stamp_ns = STAMP_NS + k * 10**8
        q = quaternion(yaw=said[2])
        twist = np.diag([4e-4, 4e-4, 1e-3])
        sent.append(("/odom", stamp_ns, odometry(pose(*said[:2], 0.0, q), stamp_ns=stamp_ns, twist=twist)))
        one, other = names[k % 4], names[(k + 1) % 4]
        later = se2.compose(truth, (0.04, 0.0, 0.012))
        ranges = [np.hypot(*se2.act(se2.inverse(later), BEACONS[name])) for name in (one, other)]
        difference = ranges[0] - ranges[1] + 0.03 * noise.standard_normal() + 3.0 * (k in wrong)
        head = header(stamp_ns + 40_000_000, "base_link")
        cdr = encoded(header=head, one=one, other=other, difference=difference)
        sent.append(("/tdoa", stamp_ns + 40_000_000, cdr))
    types = {"/odom": "nav_msgs/msg/Odometry", "/tdoa": TYPE, "/tf_static": "tf2_msgs/msg/TFMessage"}
    return write_mcap(
        file,
        [type("Sent", (), {"topic": t, "log_ns": s, "cdr": c}) for t, s, c in sent],
        types=types,
        text=lambda type_name: DEFINITION if type_name == TYPE else definition(type_name),
    )
