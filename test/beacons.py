"""A recording of ranges to beacons, in a message type that no package but a test's own has."""

import numpy as np
from messages import STAMP_NS, odometry, pose, quaternion, recorded, transforms
from recordings import definition, write_mcap

from graph_slam_ros.lie import se2
from graph_slam_ros.messages.to_msg import header

TYPE = "my_msgs/msg/Beacons"
DEFINITION = "std_msgs/Header header\nstring[] names\nfloat64[] ranges\n"
BEACONS = {"north": (2.0, 5.0), "south": (3.0, -4.0), "east": (9.0, 1.0)}


def recording(file, *, defined=True):
    """A circle among beacons, whose messages no built-in type has."""
    _, _, encoded = recorded(TYPE, DEFINITION)
    truth, sent = se2.IDENTITY, [("/tf_static", STAMP_NS, transforms())]
    for k in range(150):
        stamp_ns = STAMP_NS + k * 10**8
        sent.append(("/odom", stamp_ns, odometry(pose(*truth[:2], 0.0, quaternion(yaw=truth[2])), stamp_ns=stamp_ns)))
        ranges = np.array([np.hypot(*se2.act(se2.inverse(truth), at)) for at in BEACONS.values()])
        cdr = encoded(header=header(stamp_ns, "base_link"), names=list(BEACONS), ranges=ranges)
        sent.append(("/radio", stamp_ns, cdr))
        truth = se2.compose(truth, (0.1, 0.0, 0.03))
    types = {"/odom": "nav_msgs/msg/Odometry", "/radio": TYPE, "/tf_static": "tf2_msgs/msg/TFMessage"}
    text = DEFINITION if defined else ""
    return write_mcap(
        file,
        [type("Sent", (), {"topic": t, "log_ns": s, "cdr": c}) for t, s, c in sent],
        types=types,
        text=lambda type_name: text if type_name == TYPE else definition(type_name),
    )
