"""Runs of commands are not drawn: what a picture shows is told in test/process."""

import pytest


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    monkeypatch.setattr("graph_slam_ros.cli.replay.draw", lambda *_: None)
