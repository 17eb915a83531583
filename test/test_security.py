"""The SROS2 policy allows exactly what the node does: by the table of topics, and by a running node."""

import importlib.util
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest

from graph_slam_ros.ros.topics import PUBLICATIONS, SERVICES, SUBSCRIPTIONS, Interface

POLICY = ElementTree.parse(Path(__file__).resolve().parents[1] / "config" / "sros2_policy.xml").getroot()
PROFILE = POLICY.find("enclaves/enclave/profiles/profile")
# of rclpy's lifecycle node
OWN_PUBLICATIONS = {"/graph_slam/transition_event", "/parameter_events", "/rosout"}
LIFECYCLE = ("change_state", "get_state", "get_available_states", "get_available_transitions", "get_transition_graph")
PARAMETERS = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)
OWN_SERVICES = {f"/graph_slam/{name}" for name in (*LIFECYCLE, *PARAMETERS, "get_type_description")}
PATIENCE_S = 10.0


def allowed(kind, how):
    """Fully qualified names of a kind (topic, service) that may be used so."""
    lists = [one for one in PROFILE.findall(f"{kind}s") if one.get(how)]
    assert [one.attrib for one in lists] == [{how: "ALLOW"}]
    names = [Interface(name.text, "", "").resolved() for name in lists[0].findall(kind)]
    assert len(set(names)) == len(names)
    return set(names)


def test_the_policy_is_of_the_version_that_sros2_reads_and_of_this_node():
    assert (POLICY.tag, POLICY.get("version")) == ("policy", "0.2.0")
    (enclave,) = POLICY.findall("enclaves/enclave")
    (profile,) = enclave.findall("profiles/profile")
    assert (enclave.get("path"), profile.attrib) == ("/graph_slam", {"ns": "/", "node": "graph_slam"})


def test_the_policy_allows_what_the_table_of_topics_says():
    assert allowed("topic", "publish") == {one.resolved() for one in PUBLICATIONS} | OWN_PUBLICATIONS
    assert allowed("topic", "subscribe") == {one.resolved() for one in SUBSCRIPTIONS}
    assert allowed("service", "reply") == {one.resolved() for one in SERVICES} | OWN_SERVICES


@pytest.fixture(scope="module")
def running():
    """A node that looks at one of ours, which runs."""
    rclpy = pytest.importorskip("rclpy")
    for package in ("vision_msgs", "tf2_msgs"):
        pytest.importorskip(package)
    from rclpy.context import Context

    domain = random.randint(1, 100)
    environment = dict(os.environ, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST", ROS_DOMAIN_ID=str(domain))
    words = ("-p", "output.folder:=''", "-p", "use_sim_time:=true")
    process = subprocess.Popen([sys.executable, "-m", "graph_slam_ros.ros.node", "--ros-args", *words], env=environment)
    context = Context()
    context.init(args=[], domain_id=domain)
    node = rclpy.create_node("auditor", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()
        process.terminate()
        process.wait(timeout=PATIENCE_S)


def until_steady(node, want):
    """(publications, subscriptions, services) of the running node, once they are as wanted or patience has ended."""
    deadline, found = time.monotonic() + PATIENCE_S, interfaces(node)
    while any(w is not None and w != f for w, f in zip(want, found, strict=True)) and time.monotonic() < deadline:
        time.sleep(0.05)
        found = interfaces(node)
    return found


def interfaces(node):
    if ("graph_slam", "/") not in node.get_node_names_and_namespaces():
        return set(), set(), set()
    ask = (
        node.get_publisher_names_and_types_by_node,
        node.get_subscriber_names_and_types_by_node,
        node.get_service_names_and_types_by_node,
    )
    return tuple({name for name, _ in names_and_types("graph_slam", "/")} for names_and_types in ask)


def test_what_a_running_node_publishes_has_type_and_durability_of_the_table(running):
    until_steady(running, (allowed("topic", "publish"), None, None))
    for one in PUBLICATIONS:
        (offered,) = running.get_publishers_info_by_topic(one.resolved())
        assert offered.topic_type == one.type
        assert (offered.qos_profile.durability.name == "TRANSIENT_LOCAL") == one.latched, one.name
        assert offered.qos_profile.reliability.name == "RELIABLE"


def test_the_policy_is_what_a_running_node_does(running):
    policy = (allowed("topic", "publish"), allowed("topic", "subscribe"), allowed("service", "reply"))
    if importlib.util.find_spec("rclpy.type_description_service") is None:  # Humble
        policy[2].discard("/graph_slam/get_type_description")
    for found, wanted in zip(until_steady(running, policy), policy, strict=True):
        assert sorted(found) == sorted(wanted)
