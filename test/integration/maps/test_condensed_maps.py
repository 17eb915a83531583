"""Maps with condensed visits, as a person works with them: judged, shown, asked and edited."""

import json
import os
import re
import shutil

import numpy as np
import pytest
from condensed_run import KEYFRAMES, SEED, bounded, condensed_run
from reliability import times

from benchmarks.hall import hall, measurements
from benchmarks.judge import rms
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import FormatError, GraphSlamError
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.maps.edit import Plan, edit_run, plan_text, source_hash
from graph_slam_ros.maps.merge import merge
from graph_slam_ros.measurements.edits import edit_of
from graph_slam_ros.runs import outcome
from graph_slam_ros.runs.folder import run_config, summary_of
from graph_slam_ros.runs.journal import read_measurements
from graph_slam_ros.runs.map_file import read_map, read_start
from graph_slam_ros.runs.restore import freeze, record_run, recover
from graph_slam_ros.runs.trajectory import read_tum
from graph_slam_ros.slam import Sightings
from graph_slam_ros.tools.report.contents import read_contents
from graph_slam_ros.tools.view.workbench import Workbench

BASE = {"who": "a test", "when": "2026-01-01T00:00:00Z", "why": "to try it"}


@pytest.fixture(scope="module")
def run():
    return condensed_run()


@pytest.fixture(scope="module")
def saved(run):
    return SavedGraph(run[0], [])


@pytest.fixture(scope="module")
def work(run):
    return Workbench(read_contents(run[0]), 3.0)


def newest(saved, label="landmarks"):
    """The newest accepted edge of a class."""
    return [e for e in saved.entries if e.label == label and e.is_in][-1]


def positions(folder):
    return read_tum(folder / "path.tum").poses[:, :2]


def test_what_was_condensed_counts_as_believed(run, tmp_path):
    folder, slam, summary = run
    assert slam.view.keyframes.first > 200
    told = summary["inputs"]["landmarks"]
    seen = sum(len(m.sightings) for m in measurements(hall(SEED, KEYFRAMES)) if isinstance(m, Sightings))
    assert (told["used"], told["believed"]) == (seen, seen - 1), "one is an outlier"
    assert list(outcome.shortcomings(summary)) == list(outcome.doubts(summary)) == []
    again = recover(folder, tmp_path / "again")
    assert again["inputs"]["landmarks"]["believed"] == summary["inputs"]["landmarks"]["believed"]


def test_the_verdict_of_its_report_says_how_much_is_condensed(run, work):
    made = read_contents(run[0])
    in_map = sum(e.is_in for e in made.saved.entries if e.verdict)
    believed = run[2]["inputs"]["landmarks"]["believed"]
    assert made.losses == []
    assert made.data["sentences"][0].startswith("No measurement of this run speaks against this map")
    assert "500 keyframes and" in made.data["sentences"][1]
    assert f"{believed - in_map} more were believed, and are condensed" in made.data["sentences"][2]
    assert made.data["map"]["keyframes"] == KEYFRAMES
    assert all(0 < frame["keyframes"] <= KEYFRAMES for frame in made.data["drive"]["frames"])


def test_an_edge_of_the_window_is_taken_out_and_the_path_stays_whole(run, saved, tmp_path):
    folder, slam, _ = run
    edge = newest(saved).edge
    last = KEYFRAMES - 1
    edits = [
        {"name": "out", "do": "remove_edge", "edge": edge},
        {"name": "door", "do": "rename_landmark", "landmark": saved.landmarks_of(newest(saved))[0], "to": "door"},
        {
            **{"name": "closed", "do": "add_closure", "from_keyframe": last - 30, "to_keyframe": last},
            **{"pose": [0.0, 0.0, 0.0], "sigma_m": 1.0, "sigma_rad": 1.0},
        },
    ]
    edited = edit_run(folder, [one | BASE for one in edits], tmp_path / "edited")
    assert edited.losses == []
    assert slam.view.keyframes.first <= edited.moved[0] < KEYFRAMES
    (fit,) = edited.by_hand
    assert fit.edge == slam.view.graph.edge_ids.of(slam.view.graph.edge_count)
    after = SavedGraph(tmp_path / "edited", [])
    assert not after.edge(edge).is_in
    assert after.edge(fit.edge).is_in
    assert "door" in after.landmarks
    assert len(positions(tmp_path / "edited")) == KEYFRAMES
    moved = np.linalg.norm(positions(tmp_path / "edited") - positions(folder), axis=1)
    assert 0.0 < moved.max() < 1.0
    start = read_start(tmp_path / "edited")
    record_run(tmp_path / "again", after.config, read_measurements(tmp_path / "edited", []), [], start)
    assert (tmp_path / "again" / "path.tum").read_bytes() == (tmp_path / "edited" / "path.tum").read_bytes()


def test_where_what_was_condensed_is_lost_an_edit_names_the_run_and_writes_nothing(run, saved, tmp_path):
    damaged = tmp_path / "damaged"
    shutil.copytree(run[0], damaged)
    os.truncate(damaged / "condensed.mcap", 3000)
    edits = [{"name": "out", "do": "remove_edge", "edge": newest(saved).edge, **BASE}]
    with pytest.raises(FormatError, match=rf"{damaged}: condensed.mcap has \d+ keyframes, and .* makes the map anew"):
        edit_run(damaged, edits, tmp_path / "edited")
    assert not (tmp_path / "edited").exists()


def test_what_is_condensed_is_refused_with_the_command_that_makes_the_whole_map(run, tmp_path):
    ends = {"from_keyframe": 5, "to_keyframe": KEYFRAMES - 1, "pose": [0.0, 0.0, 0.0], "sigma_m": 1.0, "sigma_rad": 1.0}
    for edit in ({"do": "remove_edge", "edge": 5}, {"do": "add_closure", **ends}):
        with pytest.raises(GraphSlamError, match=r"it is condensed.*map\.condense=false"):
            edit_run(run[0], [{"name": "one", **edit, **BASE}], tmp_path / "edited")
    assert not (tmp_path / "edited").exists()


def test_the_page_that_edits_has_the_whole_path_of_each_answer(run, saved, work):
    edge = newest(saved).edge
    question = {"without": [edge], "let_in": [], "loss": "", "first": False}
    found = work.solve(json.dumps(question).encode())
    assert [len(axis) for axis in found["places"]] == [KEYFRAMES] * 3
    assert np.isfinite(np.array(found["places"], dtype=float)).all()
    assert found["chi2"][1] < found["chi2"][0]
    plan = Plan(source_hash(run[0]), (edit_of({"name": "out", "do": "remove_edge", "edge": edge, **BASE}),))
    tried = work.attempt(plan_text(plan).encode())
    assert np.array(tried["places"], dtype=float) == pytest.approx(np.array(found["places"], dtype=float), abs=0.02)
    assert all(before != after for _, before, after in tried["changes"])


DUE = 200
FIRST, BOTH = times((300, 600), (600, 1000))


def drive(name):
    """The run of one of two drives in one hall, by name: A and B, condensed (in lower case) and not."""
    of = {"a": {"last": FIRST}, "b": {"first": FIRST, "last": BOTH}}[name.lower()]
    return condensed_run(of=BOTH, condense=name.islower(), **of)[0]


@pytest.mark.parametrize("names", times(["ab"], ["aB", "ab"]))
def test_merged_they_are_as_good_as_two_maps_of_all_keyframes(tmp_path, names):
    done = merge(drive(names[0]), drive(names[1]), tmp_path / "both")
    assert done.is_repeated is names[1].islower()
    true = np.array([pose[:2] for pose in hall(SEED, BOTH).poses[:BOTH]])
    error = rms(positions(tmp_path / "both"), true)
    assert error < 0.1  # the path of what was condensed moves rigidly with its base
    if times(False, True):
        merge(drive("A"), drive("B"), tmp_path / "whole")
        assert error < 2.0 * rms(positions(tmp_path / "whole"), true) < 0.1
    assert (done.losses, done.left_out, done.summary["keyframes"]) == ([], {}, BOTH)
    assert done.summary["inputs"]["landmarks"]["believed"] == done.summary["inputs"]["landmarks"]["used"]
    saved = SavedGraph(tmp_path / "both", [])
    assert saved.view.keyframes.first > BOTH - 200, "the merged map condenses as the first did"
    assert len(saved.view.drives) == 2
    with pytest.raises(GraphSlamError, match="are of the same drive"):
        merge(tmp_path / "both", drive(names[0]), tmp_path / "again")
    frozen = freeze(tmp_path / "both", tmp_path / "frozen")
    assert frozen["keyframes"] == BOTH
    assert positions(tmp_path / "frozen") == pytest.approx(positions(tmp_path / "both"), abs=1e-3)


def test_a_drive_that_began_in_a_condensed_map_cannot_be_the_second(tmp_path):
    freeze(drive("a"), tmp_path / "site")
    with pytest.raises(GraphSlamError, match=r"site: it began in a map with condensed visits"):
        merge(drive("b"), tmp_path / "site", tmp_path / "both")
    assert not (tmp_path / "both").exists()


def test_what_is_due_to_be_condensed_is_not_lost_when_the_map_is_frozen(tmp_path):
    """A map of all keyframes, in a folder whose configuration says that visits are condensed."""
    folder = shutil.copytree(condensed_run(DUE, condense=False)[0], tmp_path / "due")
    text = (folder / "config.yaml").read_text()
    assert "condense: true" in text
    (folder / "config.yaml").write_text(re.sub(r"window_keyframes: \d+", "window_keyframes: 60", text))
    freeze(folder, tmp_path / "frozen")
    assert len(positions(tmp_path / "frozen")) == DUE
    assert len(SavedGraph(tmp_path / "frozen", []).whole_path.stamps_ns) == DUE
    assert run_config(tmp_path / "frozen").map.condense


@pytest.mark.parametrize(("name", "localize"), times([("a", False)], [("A", True), ("a", False)]))
def test_a_drive_in_a_frozen_map_is_condensed_and_the_map_stays(tmp_path, name, localize):
    freeze(drive(name), tmp_path / "site")
    before = SavedGraph(tmp_path / "site", [])
    settings, measured = bounded(map_localize=localize), read_measurements(drive("b"), [])
    slam, _ = record_run(tmp_path / "on", settings, measured, [], read_map(tmp_path / "site"))
    assert slam.view.keyframes.first > FIRST + 50
    true = np.array([pose[:2] for pose in hall(SEED, BOTH).poses[FIRST:BOTH]])
    assert rms(positions(tmp_path / "on")[FIRST:], true) < 0.1
    after = SavedGraph(tmp_path / "on", [])
    for one in set(before.numbers) & set(after.numbers):
        if one < FIRST:
            here, there = (x.view.solver.estimate([x.vertices[one]]) for x in (before, after))
            assert here == pytest.approx(there, abs=1e-12)
    counting = {one.edge for cell in after.view.bounded.places.values() for one in cell}
    assert set(after.graph.edges_of(PLACES).tolist()) == counting, "a place that another took over is gone"
    recover(tmp_path / "on", tmp_path / "recovered")
    assert "nan" not in (tmp_path / "recovered" / "covariances.csv").read_text().splitlines()[-1]
    of_map = len(read_tum(tmp_path / "site" / "sightings.tum").stamps_s)
    for run in ("on", "recovered"):  # the begin of the drive is condensed
        assert summary_of(tmp_path / run)["drives"][1] == {"keyframe": FIRST, "sighting": of_map}
