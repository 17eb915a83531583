"""The work behind the page: a what-if is that of ``explain``, a save that of ``map edit``, and the run stays."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from faulty import faulty_run

from graph_slam_ros import cli
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Loss
from graph_slam_ros.maps.edit import source_hash
from graph_slam_ros.runs.trajectory import read_landmarks, read_tum
from graph_slam_ros.tools.report.contents import read_contents
from graph_slam_ros.tools.view.workbench import Workbench

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "it looks wrong"}


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    run = faulty_run(folder)[1]
    work, saved = Workbench(read_contents(run), 3.0), SavedGraph(run, [])
    inside = [e.edge for e in saved.entries if e.is_in and e.label == "landmarks"]
    outside = [e.edge for e in saved.entries if not e.is_in and e.label == "closures"]
    return SimpleNamespace(folder=folder, run=run, work=work, saved=saved, inside=inside, outside=outside)


def what_if(without=(), let_in=(), loss="", *, first=False):
    return json.dumps({"without": list(without), "let_in": list(let_in), "loss": loss, "first": first}).encode()


def plan(faulty, *edits, **more):
    several = [{"name": f"edit-{k}", **WHO, **one} for k, one in enumerate(edits)]
    whole = {"format": "graph_slam_ros edits", "version": 1, "source": source_hash(faulty.run), "edits": several}
    return json.dumps(whole | more).encode()


def places(found):
    return np.array(found["places"], dtype=float).T


@pytest.mark.parametrize("loss", ["", "huber:2.5"])
def test_a_what_if_is_that_of_solve(faulty, loss, capsys):
    out, back = faulty.inside[3:8:2], faulty.outside[:1]
    found = faulty.work.solve(what_if(out, back, loss))
    name, _, scale = loss.partition(":")
    solver = faulty.saved.solve(out, back, Loss.named(name, float(scale or 1.0)) if loss else None)
    expected = solver.estimate(faulty.saved.keyframes)
    assert places(found)[:, :2] == pytest.approx(expected[:, :2], abs=1e-5)
    assert np.abs(expected - faulty.saved.solver.estimate(faulty.saved.keyframes)).max() > 0.01, "something moves"
    for name, place in found["landmarks"].items():
        assert place == pytest.approx(solver.estimate([faulty.saved.view.landmarks[name].vertex])[0], abs=1e-5)
    words = ["explain", str(faulty.run), "--without", *map(str, out), "--with", *map(str, back)]
    assert cli.main([*words, *(["--loss", loss] if loss else [])]) == 0
    before, after = found["chi2"]
    assert f"chi2       {before:14.4f}  ->  {after:14.4f}" in capsys.readouterr().out
    if not loss:  # of edges that all else contradicts the first answer is no solution, which costs less
        first, whole = (faulty.work.solve(what_if(let_in=faulty.outside, first=first)) for first in (True, False))
        assert (first["is_solved"], whole["is_solved"]) == (False, True)
        assert whole["cost"][1] < first["cost"][1]


def test_what_is_tried_is_what_is_saved_and_what_edit_writes(faulty):
    names = sorted(faulty.saved.landmarks)
    edits = [
        {"do": "remove_edge", "edge": faulty.inside[5]},
        {"do": "let_in_edge", "edge": faulty.outside[0]},
        {"do": "rename_landmark", "landmark": names[0], "to": "dock"},
        {"do": "remove_landmark", "landmark": names[1]},
        {"do": "merge_landmarks", "landmark": names[2], "into": names[3]},
    ]
    before = {file.name: file.read_bytes() for file in faulty.run.iterdir()}
    body = plan(faulty, *edits)
    attempted = faulty.work.attempt(body)
    saved = faulty.work.save(body)
    folder = faulty.run.with_name("run_edited")
    assert saved["folder"] == str(folder)
    assert saved["chi2"] == pytest.approx(attempted["chi2"], rel=1e-8), "in the digits that solving again leaves"
    assert places(attempted) == pytest.approx(read_tum(folder / "path.tum").poses[:, :3], abs=1e-5)
    marks = read_landmarks(folder / "landmarks.csv")
    assert set(attempted["landmarks"]) == set(marks.names) and "dock" in marks.names and names[1] not in marks.names
    for name, place in attempted["landmarks"].items():
        assert place == pytest.approx(marks[name][: len(place)], abs=1e-5)
    file, other = faulty.folder / "edits.json", faulty.folder / "other"
    file.write_bytes(body)
    assert cli.main(["map", "edit", str(faulty.run), "--plan", str(file), "--out", str(other)]) == 0
    for one in folder.iterdir():
        if one.name not in ("run.json", "path.png"):
            assert one.read_bytes() == (other / one.name).read_bytes(), one.name
    assert {file.name: file.read_bytes() for file in faulty.run.iterdir()} == before


def test_edits_of_the_path_are_tried_as_they_are_saved_and_decisions_that_change_with_them_are_named(faulty):
    """A closure that contradicts the others is let in: some of them go out."""
    seen = [e.edge for e in faulty.saved.entries if e.landmark == faulty.saved.entries[faulty.inside[0]].landmark]
    closed = {"from_keyframe": 5, "to_keyframe": 30, "pose": [1.0, 0.5, 0.1], "sigma_m": 1.0, "sigma_rad": 1.0}
    edits = [
        {"do": "let_in_edge", "edge": faulty.outside[0]},
        {"do": "add_closure", **closed},
        {"do": "split_landmark", "landmark": faulty.saved.entries[seen[0]].landmark, "to": "twin", "edges": seen[:2]},
        {"do": "move_map", "pose": [3.0, 4.0, 0.5], "sigma_m": 0, "sigma_rad": 0},
    ]
    attempted = faulty.work.attempt(plan(faulty, *edits))
    folder = faulty.run.with_name(faulty.work.save(plan(faulty, *edits))["folder"].rpartition("/")[2])
    path, found = read_tum(folder / "path.tum").poses[:, :3], places(attempted)
    assert found == pytest.approx(path, abs=1e-5)
    assert found[0] == pytest.approx([3.0, 4.0, 0.0], abs=0.01)
    assert any("against all else" in one for one in attempted["notes"])
    assert "twin" in attempted["landmarks"]
    saved = SavedGraph(folder, [])
    before, after = (
        {e.edge: e.verdict.name.lower().replace("_", " ") for e in one.entries} for one in (faulty.saved, saved)
    )
    changed = [[edge, was, after[edge]] for edge, was in before.items() if was != after[edge]]
    own = {edge for done in saved.view.edits for edge in done.edges}
    assert attempted["changes"] == [one for one in changed if one[0] not in own] != []


def test_what_is_no_what_if_is_refused_in_one_line(faulty):
    for body in (
        *(b"", b"\xff{}", b"[" * 100_000, b'{"without": [], "let_in": []}'),
        *(what_if([edge]) for edge in ("1", True, -1, 99999999999999999999)),
        *(what_if(loss=loss) for loss in ("huber:nan", "huber:x", "sharp:1")),
        what_if([0], [0]),
        what_if().replace(b"}", b', "out": "/tmp/x"}'),
    ):
        with pytest.raises(GraphSlamError) as error:
            faulty.work.solve(body)
        assert len(str(error.value)) < 300 and "\n" not in str(error.value)


def test_a_plan_with_a_path_or_for_another_run_is_refused_and_nothing_is_written(faulty):
    before = sorted(faulty.folder.iterdir())
    one = {"do": "remove_edge", "edge": faulty.inside[0]}
    for body in (
        plan(faulty, one, out="/tmp/x"),
        plan(faulty, one, source="sha256:0"),
        plan(faulty, {"do": "remove_edge", "edge": 10**9}),
    ):
        with pytest.raises(GraphSlamError) as error:
            faulty.work.save(body)
        assert "\n" not in str(error.value)
    assert sorted(faulty.folder.iterdir()) == before
