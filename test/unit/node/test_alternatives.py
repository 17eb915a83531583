"""Topics that an input could use instead of one that nobody publishes: they are named with the parameter."""

from types import SimpleNamespace

import pytest
from rows import each

pytest.importorskip("rclpy")

from graph_slam_ros.node.subscriptions import alternatives
from graph_slam_ros.slam import Config

ODOMETRY, DETECTIONS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
APRILTAGS, CLOUD = "apriltag_msgs/msg/AprilTagDetectionArray", "sensor_msgs/msg/PointCloud2"
OWN = "graph_slam"


class Graph:
    """The ROS graph, as the node sees it: topics with their types and publishers."""

    def __init__(self, **topics):
        self.topics = {f"/{name}": of for name, of in topics.items()}

    def get_topic_names_and_types(self):
        return [(name, [kind]) for name, (kind, *_) in self.topics.items()]

    def get_publishers_info_by_topic(self, topic):
        return [SimpleNamespace(node_name=name, node_namespace="/") for name in self.topics[topic][1:]]

    def get_name(self):
        return OWN

    def get_namespace(self):
        return "/"


@each(
    "name, topics, texts",
    [
        ("odom", {"wheels": (ODOMETRY, "driver")}, ("/wheels has this type: odom.topic:=/wheels",)),
        ("odom", {"wheels": (ODOMETRY,), "out": (ODOMETRY, OWN), "odom": (ODOMETRY, "a")}, ()),
        ("odom", {"tags": (DETECTIONS, "eye")}, ()),
        (
            "detections",
            {"tags": (DETECTIONS, "eye"), "points": (CLOUD, "lidar")},
            ("/tags has this type: detections.",),
        ),
        (
            "detections",
            {"a": (APRILTAGS, "eye"), "tags": (DETECTIONS, "eye")},
            ("/tags has this type:", f"/a has landmarks, too: detections.type:={APRILTAGS} detections.topic:=/a"),
        ),
        ("detections", {f"t{k}": (DETECTIONS, "eye") for k in range(9)}, ("/t0 has", "/t1 has", "/t2 has")),
    ],
)
def test_topics_of_others_that_fit_are_named_with_the_parameter(name, topics, texts):
    one = next(one for one in Config().sources if one.name == name)
    use = {"odom": "odometry", "detections": "landmarks"}[name]
    found = alternatives(Graph(**topics), one, use, subscribed={"/odom", "/landmarks"})
    assert len(found) == len(texts)
    for text, begin in zip(found, texts, strict=True):
        assert text.startswith(begin)
