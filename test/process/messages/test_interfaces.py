"""Messages generated from our layouts, an installed ROS and rosbags mean the same bytes."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from rows import each

from graph_slam_ros.messages.interfaces import INTERFACES, typestore

MESSAGES = [(package, message) for package, messages in INTERFACES.items() for message in messages]
DETECTIONS, TF = "vision_msgs/msg/Detection3DArray", "tf2_msgs/msg/TFMessage"


def import_ros(package):
    pytest.importorskip("rclpy", reason="no rclpy here")
    return importlib.import_module(f"{package}.msg")


def ros_detections():
    ros = import_ros("vision_msgs")
    sighting = ros.ObjectHypothesisWithPose()
    sighting.hypothesis.class_id, sighting.hypothesis.score = "reflector", 0.75
    sighting.pose.pose.position.x, sighting.pose.pose.orientation.z = 1.5, -0.6
    sighting.pose.covariance = np.arange(36.0)
    array = ros.Detection3DArray()
    array.header.frame_id, array.header.stamp.sec, array.header.stamp.nanosec = "camera", 1_700_000_000, 999_999_999
    names = ("7", "", "a landmark with ümlaut")
    array.detections = [ros.Detection3D(header=array.header, results=[sighting, sighting], id=name) for name in names]
    return array


def test_the_type_hashes_are_those_of_the_complete_upstream_packages():
    hash_of = typestore().hash_rihs01
    assert hash_of("tf2_msgs/msg/TFMessage") == (
        "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    )
    assert hash_of(DETECTIONS) == "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018"


@each("package, message", MESSAGES)
def test_ros_and_rosbags_agree_on_the_type_hash(package, message):
    import_ros(package)
    prefix, name = Path(importlib.import_module(package).__file__).parents[4], f"{package}/msg/{message}"
    description = prefix / "share" / package / "msg" / f"{message}.json"
    if not description.exists():
        pytest.skip("this ROS is older than type hashes")
    hashes = {one["type_name"]: one["hash_string"] for one in json.loads(description.read_text())["type_hashes"]}
    assert hashes[name] == typestore().hash_rihs01(name)


def test_what_rclpy_serialises_rosbags_decodes_and_what_that_serialises_rclpy_does():
    sent = ros_detections()
    from rclpy.serialization import deserialize_message, serialize_message

    store = typestore()
    received = store.deserialize_cdr(serialize_message(sent), DETECTIONS)
    assert [detection.id for detection in received.detections] == ["7", "", "a landmark with ümlaut"]
    assert np.array_equal(received.detections[1].results[1].pose.covariance, np.arange(36.0))
    assert deserialize_message(bytes(store.serialize_cdr(received, DETECTIONS)), type(sent)) == sent
    transforms = import_ros("tf2_msgs").TFMessage(transforms=[import_ros("geometry_msgs").TransformStamped()])
    transforms.transforms[0].header.frame_id, transforms.transforms[0].child_frame_id = "map", "odom"
    rewritten = store.serialize_cdr(store.deserialize_cdr(serialize_message(transforms), TF), TF)
    assert deserialize_message(bytes(rewritten), type(transforms)) == transforms
