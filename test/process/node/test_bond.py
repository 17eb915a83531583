"""The bond with Nav2's lifecycle manager, whose end is in a process of its own and follows the protocol of bondcpp."""

import contextlib
import signal
import subprocess
import sys
import threading
import time

import built_packages
import pytest
from live_nodes import ENVIRONMENT, PATIENCE_S, lenient, node, robot, until
from places import ROOT

from graph_slam_ros.node.bond import MISSING, is_installed

MANAGER = ROOT.joinpath("test", "bond_manager.py")
# bond/msg/Status.msg of bond_core 4
STATUS = (
    "std_msgs/Header header\nstring id\nstring instance_id\nbool active\n"
    "float32 heartbeat_timeout\nfloat32 heartbeat_period\n"
)


@pytest.fixture
def with_bond(request, tmp_path_factory, monkeypatch):
    """The environment of processes that have the messages."""
    built_packages.use("bond", {"Status": STATUS}, request, tmp_path_factory, monkeypatch)


@contextlib.contextmanager
def manager(timeout_s):
    """The process and what it says, line by line."""
    command = [sys.executable, str(MANAGER), "graph_slam", str(timeout_s)]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    said = []
    reader = threading.Thread(target=lambda: said.extend(iter(process.stdout.readline, "")), daemon=True)
    reader.start()
    try:
        yield process, said
    finally:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(lenient(PATIENCE_S))  # it ends by itself once the bond is broken
        process.kill()
        process.wait()
        reader.join()
        process.stdin.close()
        process.stdout.close()


def managed(folder):
    return node(f"output.folder:={folder}", "node.autostart:=false")


def test_P14_a_bond_forms_when_active_and_breaks_with_whoever_goes(tmp_path, with_bond):
    with managed(tmp_path / "run") as n, robot(hears=()) as r:
        assert r.change("configure", lenient(30.0))

        def activated(timeout_s):
            """A manager with a bond, as Nav2's is once the node is active."""
            assert r.change("activate")
            return manager(timeout_s)

        with activated(60.0) as (_, said):
            until(lambda: said == ["formed\n"], r.spin, "bond")
            assert r.change("deactivate")
            until(lambda: said[1:] == ["broken: dead\n"], r.spin, "end by the node")
        with activated(60.0) as (process, said):
            until(lambda: said == ["formed\n"], r.spin, "bond of the next activation")
            process.stdin.write("end\n")
            process.stdin.flush()
            until(lambda: said[1:] == ["broken: acknowledged\n"], r.spin, "acknowledgement")
            assert r.state() == "active", "which the manager changes, not the bond"
            until(lambda: "the lifecycle manager has ended the bond" in n.said, r.spin, "warning")
            assert r.change("deactivate")
        with activated(60.0) as (_, said):
            until(lambda: said == ["formed\n"], r.spin, "bond")
            assert n.stop(signal.SIGTERM)[0] == 0
            until(lambda: said[1:] == ["broken: dead\n"], r.spin, "end by the process that was told to stop")
    assert MISSING not in n.said
    assert "Traceback" not in n.said
    with manager(lenient(1.0)) as (_, said):
        with managed(tmp_path / "another") as n, robot(hears=()) as r:
            assert r.change("configure", lenient(30.0))
            r.settle()
            assert not said, "there is no bond before it is active"
            assert r.change("activate")
            until(lambda: said == ["formed\n"], r.spin, "bond")
        assert n.process.returncode == -signal.SIGKILL
        until(lambda: said[1:] == ["broken: silent\n"], time.sleep, "silence of one that has crashed")


@pytest.mark.skipif(is_installed(), reason="bond is installed")
def test_P14_without_the_messages_it_is_said_what_to_set(tmp_path):
    with managed(tmp_path / "run") as n, robot(hears=()) as r:
        until(lambda: MISSING in n.said, r.spin, "warning", 30.0)
        assert r.change("configure", lenient(30.0))
        assert r.change("activate")
        assert n.stop()[0] == 0
