"""Message types: field layouts of those we use that have neither a wheel nor, for vision_msgs, a place in rosbags.

The layouts are the published interfaces of tf2_msgs and vision_msgs, so what is generated from them (by the script
``tools/generate_interfaces.py``), what rosbags decodes with them (``typestore``) and an installed ROS exchange messages
with each other.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Any

from graph_slam_ros.errors import ConfigError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

INTERFACES: dict[str, dict[str, str]] = {
    "tf2_msgs": {
        "TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    },
    "vision_msgs": {
        "ObjectHypothesis": "string class_id\nfloat64 score\n",
        "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
        "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
        "Detection3D": ("std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n"),
        "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
    },
}
"""Package name to message name to the text of its .msg file."""


@cache
def typestore() -> Typestore:
    """Return the one rosbags type store, of ROS 2 Jazzy and `INTERFACES`. Nobody may change a type in it."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for package, messages in INTERFACES.items():
        for message, fields in messages.items():
            store.register(get_types_from_msg(fields, f"{package}/msg/{message}"))
    return store


def message_class(type_name: str) -> Any:
    """The Python class of a type ``package/msg/Name``.

    Raises
    ------
    ConfigError
        The package is not installed, or has no such message.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise ConfigError(f"{type_name}: {package} is not installed here, or has no such message") from None
