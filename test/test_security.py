"""The SROS2 policy allows exactly what the node does: by the table of topics, and by a running node."""

from pathlib import Path
from xml.etree import ElementTree

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
