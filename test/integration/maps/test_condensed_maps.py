"""Maps with condensed visits, as a person works with them: judged, shown, asked, edited, and undone."""

import json

import numpy as np
import pytest
from condensed_run import condensed_run

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.maps.edit import Plan, edit_run, plan_text, source_hash, undo_edit
from graph_slam_ros.measurements.edits import edit_of
from graph_slam_ros.report.contents import read_contents
from graph_slam_ros.runs import outcome
from graph_slam_ros.runs.journal import read_measurements
from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.restore import record_run, recover
from graph_slam_ros.runs.trajectory import read_tum
from graph_slam_ros.view.workbench import Workbench

BASE = {"who": "a test", "when": "2026-01-01T00:00:00Z", "why": "to try it"}
KEYFRAMES = 500


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return condensed_run(tmp_path_factory.mktemp("condensed") / "run", KEYFRAMES)


@pytest.fixture(scope="module")
def saved(run):
    return SavedGraph(run[0], [], condensed=True)


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
    *_, whole = condensed_run(tmp_path / "whole", KEYFRAMES, condense=False)
    assert slam.first_keyframe > 200
    assert summary["inputs"]["landmarks"] == whole["inputs"]["landmarks"]
    assert list(outcome.shortcomings(summary)) == list(outcome.doubts(summary)) == []
    again = recover(folder, tmp_path / "again")
    assert again["inputs"]["landmarks"]["believed"] == summary["inputs"]["landmarks"]["believed"]


def test_the_verdict_of_its_report_says_how_much_is_condensed(run, work):
    made = read_contents(run[0])
    in_map = sum(e.is_in for e in made.saved.entries if e.verdict)
    believed = run[2]["inputs"]["landmarks"]["believed"]
    assert made.losses == []
    assert "nothing wrong with this map: 500 keyframes and" in made.data["sentences"][0]
    assert f"{believed - in_map} more were believed, and are condensed" in made.data["sentences"][1]
    assert made.data["map"]["keyframes"] == KEYFRAMES
    assert all(run[1].first_keyframe < frame["keyframes"] <= KEYFRAMES for frame in made.data["drive"]["frames"])


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
    assert slam.first_keyframe <= edited.moved[0] < KEYFRAMES
    (fit,) = edited.by_hand
    assert fit.edge == slam.graph.edge_ids.of(slam.graph.edge_count)
    after = SavedGraph(tmp_path / "edited", [], condensed=True)
    assert not after.edge(edge).is_in
    assert after.edge(fit.edge).is_in
    assert "door" in after.landmarks
    assert len(positions(tmp_path / "edited")) == KEYFRAMES
    moved = np.linalg.norm(positions(tmp_path / "edited") - positions(folder), axis=1)
    assert 0.0 < moved.max() < 1.0
    start = read_map(tmp_path / "edited", [], start_only=True)
    record_run(tmp_path / "again", after.config, read_measurements(tmp_path / "edited", []), [], start)
    assert (tmp_path / "again" / "path.tum").read_bytes() == (tmp_path / "edited" / "path.tum").read_bytes()


def test_undone_it_is_as_it_was(run, saved, tmp_path):
    folder = run[0]
    edit_run(folder, [{"name": "out", "do": "remove_edge", "edge": newest(saved).edge, **BASE}], tmp_path / "edited")
    undo_edit(tmp_path / "edited", "out", tmp_path / "undone")
    assert positions(tmp_path / "undone") == pytest.approx(positions(folder), abs=1e-6)
    assert newest(SavedGraph(tmp_path / "undone", [], condensed=True)).edge == newest(saved).edge


@pytest.mark.parametrize(
    "edit",
    [
        {"do": "remove_edge", "edge": 5},
        {"do": "add_closure", "from_keyframe": 5, "to_keyframe": KEYFRAMES - 1, "pose": [0.0, 0.0, 0.0]}
        | {"sigma_m": 1.0, "sigma_rad": 1.0},
        {"do": "remove_landmark", "landmark": "m0"},
        {"do": "cut", "from": 5, "until": 9},
    ],
    ids=lambda edit: edit["do"],
)
def test_what_is_condensed_is_refused_with_the_command_that_makes_the_whole_map(run, tmp_path, edit):
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


def test_a_place_is_of_all_its_landmarks(saved):
    place = newest_place(saved)
    made = read_contents(saved.folder)
    texts = dict(made.data["edges"]["condensed"][str(place.edge)])
    assert all(name in texts["members"] for name in saved.landmarks_of(place))
    assert len(made.data["edges"]["places"]) == max(len(e.vertices) for e in saved.entries) > 2


def newest_place(saved):
    return [e for e in saved.entries if e.label == PLACES][-1]
