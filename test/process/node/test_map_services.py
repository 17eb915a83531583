"""Requests of slam_toolbox for a map by name: what they ask for, and where its types are installed, that it is done."""

import math
from types import SimpleNamespace

import pytest
from live_drive import Drive, distance
from live_nodes import node, robot, until

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.node.map_services import MatchTypeError, loaded_from, saved_as
from graph_slam_ros.slam import Config

YAW = 0.7


def request(match_type=2, filename="site", **orientation):
    quaternion = {"x": 0.0, "y": 0.0, "z": math.sin(YAW / 2), "w": math.cos(YAW / 2)} | orientation
    pose = SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0, z=3.0), orientation=SimpleNamespace(**quaternion))
    return SimpleNamespace(filename=filename, match_type=match_type, initial_pose=pose)


def test_a_request_is_a_name_and_a_pose():
    assert saved_as(request()) == {"output.save_as": "site"}
    for match_type, localizes in ((2, False), (3, True)):
        config = Config().changed(loaded_from(request(match_type), 2))
        assert (config.output.load, config.map.localize) == ("site", localizes)
        assert config.load_pose == pytest.approx((1.0, 2.0, YAW))
    space = Config.from_mapping({"world.dimensions": 3})
    said = space.changed(loaded_from(request(), 3)).load_pose
    assert said == pytest.approx((1.0, 2.0, 3.0, 0.0, 0.0, math.sin(YAW / 2), math.cos(YAW / 2)))
    flat = SimpleNamespace(filename="a", match_type=2, initial_pose=SimpleNamespace(x=1.0, y=2.0, theta=YAW))
    assert Config().changed(loaded_from(flat, 2)).load_pose == (1.0, 2.0, YAW)


def test_a_request_that_cannot_be_is_refused_with_the_reason():
    for asked, error, why in (
        (request(0), MatchTypeError, "match_type: 0 gives no pose"),
        (request(1), MatchTypeError, "match_type: 1 gives no pose"),
        (request(w=0.0, z=0.0), MatchTypeError, "no unit quaternion"),
        (request(w=math.nan), MatchTypeError, "no unit quaternion"),
        (request(filename=""), ConfigError, "filename: is empty"),
        (request(filename="/maps/site"), ConfigError, "not the name of a run"),
    ):
        with pytest.raises(error, match=why):
            Config().changed(loaded_from(asked, 2))


def test_the_node_serves_requests_of_slam_toolbox(tmp_path):
    types = pytest.importorskip("slam_toolbox.srv", reason="slam_toolbox is not installed: its services are not served")
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=("pose",)) as r:
        r.wait_for_node()
        drive = Drive()
        drive.go(r, 60, every=3)
        r.settle()
        save, load = types.SerializePoseGraph, types.DeserializePoseGraph
        assert r.call("serialize_map", save, save.Request(filename="site")).result == 0
        assert r.call("serialize_map", save, save.Request(filename="site")).result == 255
        asked = load.Request(filename="site", match_type=load.Request.LOCALIZE_AT_POSE)
        x, y, yaw = drive.truth
        asked.initial_pose.position.x, asked.initial_pose.position.y = x, y
        asked.initial_pose.orientation.z, asked.initial_pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        assert r.call("deserialize_map", load, asked).result == 0
        assert r.get(["map.localize"]) == {"map.localize": True}
        r.settle()
        r.heard["pose"].clear()
        drive.stamp_ns += 10**9
        until(lambda: r.heard["pose"], drive.pace(r), "place in the map")
        at = r.heard["pose"][0].pose.pose.position
        assert distance((at.x, at.y), (x, y)) < 0.3
        for filename, match_type, result in (("nobody", 3, 3), ("../site", 3, 1), ("site", 1, 2)):
            asked.filename, asked.match_type = filename, match_type
            assert r.call("deserialize_map", load, asked).result == result
        assert n.stop()[0] == 0
    assert "match_type: 1 gives no pose" in n.said
