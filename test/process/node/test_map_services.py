"""Requests of slam_toolbox for a map by name: what they ask for,."""

import math
from types import SimpleNamespace

import pytest

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.node.services import MatchTypeError, loaded_from, saved_as
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
