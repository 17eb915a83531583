"""The map on the disk: what is read back is what there was, whatever ended the run; and a run goes on in it."""

import json
import math
import shutil

import numpy as np
import pytest
from driven import drive, seldom, without_names
from places import ROOT

from graph_slam_ros.errors import FormatError
from graph_slam_ros.runs import map_file
from graph_slam_ros.runs import recorder as recorder_module
from graph_slam_ros.runs.folder import RunError, is_cut_off, keep_earlier, run_config
from graph_slam_ros.runs.map_file import read_map, write_map
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import map_of
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry
from graph_slam_ros.tools.simulation import measurements, simulate

GOLDEN = ROOT / "test" / "golden"
WORLDS = {"points": ({}, {}), "unnamed": ({"landmarks.association": "joint"}, {"sensor": "position"})}


def told(view):
    """All that was measured and judged."""
    columns = [column.values.tobytes() for table in view.graph.tables.values() for column in table.columns]
    return columns, view.ledger.verdict.values.tolist(), list(view.keyframes), list(view.sighting_poses), view.segments


@pytest.fixture(scope="module", params=[*WORLDS, "flight"])
def run(request, tmp_path_factory):
    """The folder of such a run, and its pipeline."""
    folder = tmp_path_factory.mktemp("run") / "run"
    if request.param == "flight":
        config = Config.from_mapping({"world.dimensions": 3})
        return folder, drive(folder, config, measurements(simulate("flight", 0, laps=1)))
    settings, options = WORLDS[request.param]
    world = measurements(simulate("warehouse", 0, aisles=2, laps=1, aisle_m=4.0, **options))
    world = without_names(world) if request.param == "unnamed" else world
    return folder, drive(folder, Config.from_mapping(settings), world)


def test_what_is_read_back_is_what_there_was_and_solved_to_where_it_was(run, tmp_path):
    folder, slam = run
    write_map(tmp_path / "map.mcap", slam.view.snapshot())
    state = read_map(tmp_path)
    write_map(tmp_path / "again.mcap", state)
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "map.mcap").read_bytes()
    again = GraphSlam(run_config(folder), start=state)
    assert told(again.view) == told(slam.view)
    assert again.view.trajectory() == pytest.approx(slam.view.trajectory(), abs=1e-6)
    assert again.view.report.cost_final == pytest.approx(slam.view.report.cost_final, rel=1e-9)


@pytest.mark.parametrize("world", ["warehouse", "flight"])
def test_whenever_it_is_killed_the_newest_map_and_the_rest_of_the_journal_end_where_the_whole_drive_does(
    world, tmp_path, monkeypatch
):
    """To the bit in all that was measured and judged, where nothing is revised: not the scale of the noise here."""
    dimensions, options = (2, {"aisles": 2, "aisle_m": 4.0}) if world == "warehouse" else (3, {})
    config = Config.from_mapping({"robust.noise_scale": "configured", "world.dimensions": dimensions})
    drive = measurements(simulate(world, 0, laps=1, **options))
    killed = []
    monkeypatch.setattr(recorder_module, "_TAIL_S", 0.0)
    monkeypatch.setattr(recorder_module, "_BYTES_PER_S", math.inf)
    recorder = RunRecorder(tmp_path / "run", config)
    slam = GraphSlam(config, recorder.sink)
    for k, m in enumerate(drive):
        recorder.record(slam, slam.process(m))
        recorder.flush()
        if k % 130 == 50:
            killed.append(shutil.copytree(tmp_path / "run", tmp_path / str(k), ignore=shutil.ignore_patterns(".*")))
    slam.process(Control("end"))
    recorder.close()
    slam.process(Control("optimize"))
    processed = {state.processed: one / "map.mcap" for one in killed if (state := read_map(one))}
    assert len(processed) > 4
    for file in processed.values():
        shutil.copy(file, tmp_path / "run")
        again = GraphSlam(config, start=map_of(tmp_path / "run", []))
        again.process(Control("optimize"))
        assert told(again.view) == told(slam.view), file
        assert np.abs(again.view.trajectory() - slam.view.trajectory())[:, :2].max() < 1e-6


def test_a_run_that_goes_on_in_a_map_knows_its_landmarks_and_is_repeated_byte_by_byte(tmp_path):
    world = list(seldom(measurements(simulate("warehouse", 0, aisles=2, laps=1, aisle_m=6.0))))
    before = drive(tmp_path / "before", Config(), world)
    start = map_of(tmp_path / "before", [])
    recorder = RunRecorder(tmp_path / "after", Config(), start=start)
    slam = GraphSlam(Config(), recorder.sink, start=start)
    assert len(slam.view.keyframes) == len(before.view.keyframes)
    for m in [*world, Control("end"), Control("optimize")]:  # the same drive once more: where it is, landmarks tell
        recorder.record(slam, slam.process(m))
    recorder.save(slam)
    recorder.close()
    assert slam.view.segments == slam.view.drives == [0, len(before.view.keyframes)]
    assert read_map(tmp_path / "after").drives == slam.view.drives
    (first, second) = json.loads((tmp_path / "after" / "run.json").read_text())["drives"]
    assert first == {"keyframe": 0, "sighting": 0}
    assert second == {"keyframe": len(before.view.keyframes), "sighting": len(before.view.sighting_poses)}
    assert set(slam.view.landmarks) == set(before.view.landmarks)
    first, second = np.split(slam.view.trajectory(), [len(before.view.keyframes)])
    assert np.hypot(*(first - second[: len(first)])[:, :2].T).max() < 0.2
    again = replay(tmp_path / "after", tmp_path / "again")
    assert again.losses == []
    for name in ("graph.g2o", "ledger.csv", "ledger_changes.csv", "path.tum", "landmarks.csv", "covariances.csv"):
        assert (tmp_path / "after" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


@pytest.mark.parametrize("run", ["unnamed"], indirect=True)
def test_a_map_that_is_damaged_anywhere_is_repeated_from_the_journal_with_a_word(run, tmp_path):
    folder, slam = run
    shutil.copytree(folder, tmp_path / "run")
    write_map(tmp_path / "run" / "map.mcap", slam.view.snapshot())
    whole = (tmp_path / "run" / "map.mcap").read_bytes()
    for k, at in enumerate(np.linspace(len(whole) // 50, len(whole) // 2, 7, dtype=int).tolist()):
        damaged = whole[:at] if k % 2 else whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :]
        (tmp_path / "run" / "map.mcap").write_bytes(damaged)
        with pytest.raises(FormatError, match=r"run/map\.mcap: "):
            read_map(tmp_path / "run")
    state = map_of(tmp_path / "run", losses := [])
    assert any("map.mcap" in loss and "is repeated from its journal" in loss for loss in losses)
    assert list(state.keyframes) == list(slam.view.keyframes)


@pytest.mark.parametrize("run", ["unnamed"], indirect=True)
def test_what_is_no_map_is_refused_by_what_is_wrong(run, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(map_file, "VERSION", 99)
        write_map(tmp_path / "map.mcap", run[1].view.snapshot())
    with pytest.raises(FormatError, match=r"map\.mcap: .*its version is 99; this program knows"):
        read_map(tmp_path)


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


def test_the_map_of_a_run_that_is_kept_loads(tmp_path):
    (folder,) = GOLDEN.iterdir()
    summary = json.loads((folder / "run.json").read_text())
    again = GraphSlam(run_config(folder), start=read_map(folder))
    assert len(again.view.keyframes) == summary["keyframes"]
    assert len(again.view.landmarks) == summary["landmarks"]
    assert again.view.report.chi2_final == pytest.approx(summary["chi2"], rel=1e-6)
    repeated = replay(folder, tmp_path / "again").summary  # keyframes are where this version makes them
    assert (repeated["landmarks"], repeated["sightings"]) == (summary["landmarks"], summary["sightings"])
