"""The map as it grew: what is read back is what there was, whatever ended the run; and a run goes on in it."""

import json
import shutil

import numpy as np
import pytest
from driven import drive, seldom, without_names
from places import ROOT

from graph_slam_ros.errors import FormatError
from graph_slam_ros.runs.folder import RunError, is_cut_off, keep_earlier, run_config
from graph_slam_ros.runs.journal import RecordWriter, read_records
from graph_slam_ros.runs.map_journal import MAP, MapGrowth, read_map, state_of
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import map_of
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry
from graph_slam_ros.tools.simulation import measurements, simulate

GOLDEN = ROOT / "test" / "golden"
WORLDS = {"points": ({}, {}), "unnamed": ({"landmarks.association": "joint"}, {"sensor": "position"})}


def told(state):
    """All of a map, as JSON."""
    return json.loads(json.dumps(MapGrowth().since(state)))


@pytest.fixture(scope="module", params=[*WORLDS, "flight"])
def run(request, tmp_path_factory):
    """The folder of such a run, and its pipeline."""
    folder = tmp_path_factory.mktemp("run") / "run"
    if request.param == "flight":
        return folder, drive(
            folder, Config.from_mapping({"world.dimensions": 3}), measurements(simulate("flight", 0, laps=1))
        )
    settings, options = WORLDS[request.param]
    world = measurements(simulate("warehouse", 0, aisles=2, laps=1, aisle_m=4.0, **options))
    return folder, drive(
        folder, Config.from_mapping(settings), without_names(world) if request.param == "unnamed" else world
    )


def test_what_is_read_back_is_what_there_was_and_solved_to_where_it_was(run):
    folder, slam = run
    state = read_map(folder, losses := [])
    assert len(losses) == 1, "it was not closed"
    for column in ("verdict", "reason", "numbers", "keyframe"):
        assert getattr(state.ledger, column).values.tolist() == getattr(slam.ledger, column).values.tolist(), column
    assert state.ledger.history == slam.ledger.history
    assert state.ledger.outside.tolist() == slam.ledger.outside.tolist()
    assert state.keyframes == list(slam.keyframes)
    assert state.segments == slam.segments
    assert state.drives == slam.drives == [0]
    assert state.sighting_poses == list(slam.sighting_poses)
    assert told(state)["landmarks"] == told(state_of(slam))["landmarks"]
    assert told(state).get("seen") == told(state_of(slam)).get("seen")
    assert state.graph.edge_count == slam.graph.edge_count
    for edge in range(slam.graph.edge_count):
        (a, k), (b, m) = state.graph.row(edge), slam.graph.row(edge)
        assert a.type is b.type
        for column in ("vertices", "measured", "sqrt_information"):
            assert (getattr(a, column).values[k] == getattr(b, column).values[m]).all()
        assert state.graph.label_of(edge) == slam.graph.label_of(edge)
        assert state.graph.source_of(edge) == slam.graph.source_of(edge)
    again = GraphSlam(run_config(folder), start=read_map(folder, []))
    assert again.trajectory() == pytest.approx(slam.trajectory(), abs=1e-6)
    assert again.report.cost_final == pytest.approx(slam.report.cost_final, rel=1e-9)


def test_a_run_that_goes_on_in_a_map_knows_its_landmarks_and_is_repeated_byte_by_byte(tmp_path):
    world = list(seldom(measurements(simulate("warehouse", 0, aisles=2, laps=1, aisle_m=6.0))))
    before = drive(tmp_path / "before", Config(), world)
    start = map_of(tmp_path / "before", [])
    recorder = RunRecorder(tmp_path / "after", Config(), start=start)
    slam = GraphSlam(Config(), recorder.sink, start=start)
    assert len(slam.keyframes) == len(before.keyframes)
    for m in [*world, Control("end"), Control("optimize")]:  # the same drive once more: where it is, landmarks tell
        recorder.record(slam, slam.process(m))
    recorder.save(slam)
    recorder.close()
    assert slam.segments == slam.drives == [0, len(before.keyframes)]
    assert read_map(tmp_path / "after", []).drives == slam.drives
    (first, second) = json.loads((tmp_path / "after" / "run.json").read_text())["drives"]
    assert first == {"keyframe": 0, "sighting": 0}
    assert second == {"keyframe": len(before.keyframes), "sighting": len(before.sighting_poses)}
    assert set(slam.landmarks) == set(before.landmarks)
    first, second = np.split(slam.trajectory(), [len(before.keyframes)])
    assert np.hypot(*(first - second[: len(first)])[:, :2].T).max() < 0.2
    again = replay(tmp_path / "after", tmp_path / "again")
    assert again.losses == []
    for name in ("graph.g2o", "ledger.csv", "ledger_changes.csv", "path.tum", "landmarks.csv", "covariances.csv"):
        assert (tmp_path / "after" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


@pytest.mark.parametrize("run", ["unnamed"], indirect=True)
def test_cut_anywhere_it_is_read_as_far_as_it_goes(run, tmp_path):
    folder, slam = run
    whole = (folder / "map.mcap").read_bytes()
    shutil.copy(folder / "config.yaml", tmp_path)
    counts = []
    for size in np.linspace(len(whole) // 50, len(whole), 7, dtype=int).tolist():
        (tmp_path / "map.mcap").write_bytes(whole[:size])
        state = read_map(tmp_path, [])
        counts.append(0 if state is None else len(state.keyframes))
        if state is not None:
            k = counts[-1]
            assert state.keyframes == list(slam.keyframes)[:k]
            assert np.isfinite(GraphSlam(run_config(tmp_path), start=state).trajectory()).all()
    assert counts == sorted(counts)
    assert counts[-1] == len(slam.keyframes)
    assert len(set(counts)) > 4


NO_MAP = (
    ({"type": "map", "version": 99}, "its version is 99"),
    ({"type": "growth", "vertices": [["SE9", [0, 0, 0]]]}, "SE9"),
    ({"type": "growth", "vertices": [["SE2", [0, 0]]]}, "shape"),
    ({"type": "growth", "edges": [["EDGE_SE2", [0, 7], [1, 0, 0], [1] * 9, "odometry", ""]]}, "vertex 7"),
    ({"type": "growth", "keyframes": [[0]]}, "values to unpack"),
    ({"type": "growth", "changes": [[5, 0, "believed", "none", 0, 0]]}, "believed"),
    ({"type": "growth", "seen": [[0, "", {}, 0, 0, 0, [], []]]}, "edge 0 does not exist"),
)


def test_what_is_no_map_is_refused_by_record(tmp_path):
    for record, complaint in NO_MAP:
        (tmp_path / "map.mcap").unlink(missing_ok=True)
        writer = RecordWriter(tmp_path / "map.mcap")
        writer.write([{"type": "map", "version": 1}, {"type": "growth", "vertices": [["SE2", [0, 0, 0]]]}, record])
        writer.close()
        with pytest.raises(FormatError, match=rf"map\.mcap: record 2: .*({complaint})"):
            read_map(tmp_path, [])


def test_a_run_is_cut_off_until_it_is_ended_and_kept_whatever_is_asked(tmp_path):
    folder = tmp_path / "run"
    assert not is_cut_off(folder)
    RunRecorder(folder, Config()).close()
    assert not is_cut_off(folder), "it holds nothing"
    recorder = RunRecorder(folder, Config())
    slam = GraphSlam(sink=recorder.sink)
    recorder.record(slam, slam.process(Odometry(1, (0.0, 0.0, 0.0))))
    recorder.flush()
    assert is_cut_off(folder)
    recorder.save(slam, {"ended": False})
    recorder.close()
    assert is_cut_off(folder)
    keep_earlier(folder, 0)
    assert (tmp_path / "run-1").is_dir()
    RunRecorder(folder, Config()).close()
    assert is_cut_off(folder), "since the newest that holds something was"
    with pytest.raises(RunError, match="run: no keyframe, so there is no map"):
        map_of(folder, [])


def test_maps_of_every_version_load(tmp_path):
    (folder,) = GOLDEN.iterdir()
    told = json.loads((folder / "run.json").read_text())
    state = read_map(folder, losses := [])
    assert losses == []
    again = GraphSlam(run_config(folder), start=state)
    assert len(again.keyframes) == told["keyframes"]
    assert len(again.landmarks) == told["landmarks"]
    assert again.report.chi2_final == pytest.approx(told["chi2"], rel=1e-6)
    assert next(read_records(folder, MAP, []))["type"] == "map"
    repeated = replay(folder, tmp_path / "again").summary  # keyframes are where this version makes them
    assert (repeated["landmarks"], repeated["sightings"]) == (told["landmarks"], told["sightings"])
