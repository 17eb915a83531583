"""Nodes of a test are alone in a DDS domain: what is left of others says nothing there."""

from importlib.util import find_spec

import pytest


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Of each test its own."""
    if find_spec("rclpy") is None:
        yield
        return
    import live_nodes

    with live_nodes.own_domain() as number:
        monkeypatch.setitem(live_nodes.ENVIRONMENT, "ROS_DOMAIN_ID", number)
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield
