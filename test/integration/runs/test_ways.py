"""Ways in: a world of ``simulate``, recorded as a robot would, and the preset for it give the right map."""

import json

import numpy as np
from rows import each

from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.cli import main
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.maps.export import export
from graph_slam_ros.messages.inputs.fixes import east_north_up
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.suggestion import suggestion_for_other_types
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, with_closures, write_bag
from graph_slam_ros.tools.simulation.instruments import DATUM

WAYS = {
    "tags": ("warehouse", {"apriltag": True, "aisles": 2}, 0.10),
    "poles": ("manhattan", {"sensor": "position", "blocks": 6, "poses": 150}, 0.15),
    "gnss": ("warehouse", {"landmarks": False, "gnss": 5, "imu": 50, "rest_s": 3, "aisles": 2, "aisle_m": 30}, 0.30),
    "ranges": ("manhattan", {"sensor": "range", "blocks": 6, "poses": 150}, 0.25),
    "closures": ("warehouse", {"landmarks": False, "aisles": 2}, 0.15),
}


@each("way", WAYS)
def test_a_preset_gives_the_right_map_of_its_recording(way, tmp_path):
    world, options, most_m = WAYS[way]
    recording, bag, run = simulate(world, 1, **options), tmp_path / "drive.mcap", tmp_path / "run"
    write_bag(with_closures(recording, 40, 1) if way == "closures" else recording, bag)
    assert not replay(bag, run, Config.from_mapping(read_parameters(way))).losses
    scores = evaluate(run, str(bag))
    assert scores.estimate.position_m["rmse"] < most_m < scores.odometry.position_m["rmse"]
    assert main(["check", str(bag), "--config", way]) == 0
    assert main(["replay", str(run), "--out", f"{run}_again", "--set", "odom.offset_s=0.1"]) == 2, "stamps are kept"
    assert way in ("poles", "gnss") or way in suggestion_for_other_types(bag, Config()).names
    if way == "gnss":
        (out,) = export(run, tmp_path / "path.geojson", "geojson", [])
        (path,) = json.loads(out.read_text())["features"]
        found = [east_north_up((y, x, DATUM[2]), DATUM)[:2] for x, y in path["geometry"]["coordinates"]]
        at = np.searchsorted(recording.stamps_ns, 1e9 * np.array(path["properties"]["stamps_s"]) - 1e6)
        assert np.linalg.norm(recording.T_world_base[at, :2] - found, axis=1).max() < 1.0
