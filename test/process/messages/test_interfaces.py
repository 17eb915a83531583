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
    sighting.hypothesis.class_id = "reflector"
    sighting.hypothesis.score = 0.75
    sighting.pose.pose.position.x = 1.5
    sighting.pose.pose.orientation.z = -0.6
    sighting.pose.pose.orientation.w = 0.8
    sighting.pose.covariance = np.arange(36.0)
    array = ros.Detection3DArray()
    array.header.frame_id = "camera"
    array.header.stamp.sec = 1_700_000_000
    array.header.stamp.nanosec = 999_999_999
    for landmark in ("7", "", "a landmark with ümlaut"):
        detection = ros.Detection3D(header=array.header, results=[sighting, sighting], id=landmark)
        detection.bbox.size.y = 0.25
        array.detections.append(detection)
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
    prefix = Path(importlib.import_module(package).__file__).parents[4]
    description = prefix / "share" / package / "msg" / f"{message}.json"
    if not description.exists():
        pytest.skip("this ROS is older than type hashes")
    name = f"{package}/msg/{message}"
    hashes = {entry["type_name"]: entry["hash_string"] for entry in json.loads(description.read_text())["type_hashes"]}
    assert hashes[name] == typestore().hash_rihs01(name)


def test_what_rclpy_serialises_rosbags_decodes():
    sent = ros_detections()
    from rclpy.serialization import serialize_message

    received = typestore().deserialize_cdr(serialize_message(sent), DETECTIONS)
    assert received.header.frame_id == "camera"
    assert (received.header.stamp.sec, received.header.stamp.nanosec) == (1_700_000_000, 999_999_999)
    assert [detection.id for detection in received.detections] == ["7", "", "a landmark with ümlaut"]
    for detection in received.detections:
        assert detection.bbox.size.y == 0.25
        assert len(detection.results) == 2
        for result in detection.results:
            assert (result.hypothesis.class_id, result.hypothesis.score) == ("reflector", 0.75)
            assert result.pose.pose.position.x == 1.5
            assert (result.pose.pose.orientation.z, result.pose.pose.orientation.w) == (-0.6, 0.8)
            assert np.array_equal(result.pose.covariance, np.arange(36.0))


def test_what_rosbags_serialises_rclpy_decodes():
    sent = ros_detections()
    from rclpy.serialization import deserialize_message, serialize_message

    store = typestore()
    rewritten = store.serialize_cdr(store.deserialize_cdr(serialize_message(sent), DETECTIONS), DETECTIONS)
    assert deserialize_message(bytes(rewritten), type(sent)) == sent
    transforms = import_ros("tf2_msgs").TFMessage(transforms=[import_ros("geometry_msgs").TransformStamped()])
    transforms.transforms[0].header.frame_id, transforms.transforms[0].child_frame_id = "map", "odom"
    transforms.transforms[0].transform.translation.y = -2.0
    rewritten = store.serialize_cdr(store.deserialize_cdr(serialize_message(transforms), TF), TF)
    assert deserialize_message(bytes(rewritten), type(transforms)) == transforms
