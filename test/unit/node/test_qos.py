"""The QoS of the subscription of a topic, from the parameters of its inputs."""

import pytest
from rows import each

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.slam import Config

pytest.importorskip("rclpy")

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from graph_slam_ros.node.subscriptions import input_topic


def qos(**values):
    """Of /fixes, which two inputs share."""
    given = {"inputs.names": "odom a b"} | {k.replace("__", "."): v for k, v in values.items()}
    return input_topic(Config.from_mapping(given), "sensor_msgs/msg/NavSatFix", "/fixes", ["a", "b"])


def test_an_input_asks_for_what_its_parameters_say_else_for_what_those_of_all_inputs_say():
    least = qos().qos
    assert (least.reliability, least.durability) == (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
    assert (least.depth, qos(inputs__depth=7).depth) == (1000, 7)
    assert qos(inputs__reliable=True).reliability == "inputs.reliable"
    assert qos(a__reliability="reliable").reliability == "a.reliability"
    assert not qos(inputs__reliable=True, a__reliability="best_effort").reliability
    latched = qos(a__durability="transient_local", b__durability="transient_local")
    assert latched.qos.durability is DurabilityPolicy.TRANSIENT_LOCAL


@each(
    "values, complaint",
    [
        (
            {"a__reliability": "reliable", "b__reliability": "best_effort"},
            r"a.reliability \(reliable\) and b.reliability \(best_effort\) are of one subscription, to /fixes",
        ),
        ({"b__durability": "transient_local"}, r"a.durability \(volatile\) and b.durability \(transient_local\)"),
    ],
)
def test_inputs_of_one_topic_that_ask_for_different_qos_are_refused(values, complaint):
    with pytest.raises(ConfigError, match=complaint):
        qos(**values)
