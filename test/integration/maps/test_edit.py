"""``graph_slam map edit``: each edit does what the pipeline's own does, and stays in all that is made of the map."""

import functools
import hashlib
import json

import numpy as np
import pytest
from faulty import faulty_run

from graph_slam_ros import cli
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.maps.edit import source_hash
from graph_slam_ros.runs.ledger_file import read_ledger
from graph_slam_ros.runs.map_journal import read_map, state_of
from graph_slam_ros.runs.restore import map_of, restored
from graph_slam_ros.runs.saved_run import load_run
from graph_slam_ros.slam import Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.slam.robust.ledger import Reason, Verdict

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "seen on the spot"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return faulty_run(tmp_path_factory.mktemp("faulty"))[1]


@pytest.fixture(scope="module")
def entries(run):
    return read_ledger(run)


@pytest.fixture(scope="module")
def edits(entries):
    """One of each kind: a closure that is in goes out, one that is out comes in; three landmarks are changed."""
    inside = next(e.edge for e in entries if e.label == "closures" and e.is_in)
    outside = next(e.edge for e in entries if e.label == "closures" and not e.is_in)
    names = sorted({e.landmark for e in entries if e.landmark})
    values = [
        {"do": "remove_edge", "edge": inside},
        {"do": "let_in_edge", "edge": outside},
        {"do": "remove_landmark", "landmark": names[0]},
        {"do": "rename_landmark", "landmark": names[1], "to": "dock <1>"},
        {"do": "merge_landmarks", "landmark": names[2], "into": names[3]},
    ]
    return {one["do"]: {"name": one["do"], **WHO} | one for one in values}


@pytest.fixture(scope="module")
def edited(run, edits, tmp_path_factory):
    """All of them, in one plan."""
    folder = tmp_path_factory.mktemp("edited")
    assert edit(run, planned(run, folder, *edits.values()), "--out", folder / "new") == 0
    return folder / "new"


def planned(run, folder, *edits):
    file = folder / "edits.json"
    file.unlink(missing_ok=True)
    assert edit(run, None, "--new-plan", file) == 0
    plan = json.loads(file.read_text())
    plan["edits"] += edits
    file.write_text(json.dumps(plan))
    return file


def edit(run, plan, *words):
    return cli.main(["map", "edit", *map(str, [run, *(["--plan", plan] if plan else []), *words])])


def contents(folder):
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}


@pytest.fixture(scope="module")
def applied(run, edits):
    """The same by the pipeline, in memory."""
    before = restored(run, [])

    @functools.cache
    def done(do):
        slam = GraphSlam(before.config, start=state_of(before))
        slam.process(Control("edit", tuple(edits[do].items())))
        slam.process(Control("optimize"))
        return slam

    return done


@pytest.mark.parametrize("do", ["remove_edge", "let_in_edge", "remove_landmark", "rename_landmark", "merge_landmarks"])
def test_the_command_does_what_the_pipeline_does(do, run, edits, applied, tmp_path):
    before = contents(run)
    assert edit(run, planned(run, tmp_path, edits[do]), "--out", tmp_path / "new") == 0
    assert contents(run) == before
    slam, new = applied(do), load_run(tmp_path / "new")
    assert new.trajectory().poses[:, :2] == pytest.approx(slam.trajectory()[:, :2], abs=1e-9)
    assert set(new.landmarks.names) == set(slam.landmarks)
    assert [e.verdict for e in new.edges] == slam.ledger.verdict.values.tolist()
    assert [e.reason for e in new.edges] == slam.ledger.reason.values.tolist()
    state = read_map(tmp_path / "new", [])
    assert state.edits == slam.edits
    assert state.landmarks.keys() == slam.touched_landmarks(0).keys() & slam.landmarks.keys()


def test_an_edge_that_is_out_or_in_by_hand_is_as_in_a_graph_that_was_solved_so(run, edits, applied):
    saved = SavedGraph(run, [])
    for do, options in (("remove_edge", "without"), ("let_in_edge", "let_in")):
        slam, edge = applied(do), edits[do]["edge"]
        kept = [e.edge for e in saved.entries if e.is_in != slam.ledger.is_inside(e.edge) and e.verdict]
        others = [one for one in kept if one != edge]  # the second look may have changed these, too
        out = [one for one in others if saved.entries[one].is_in]
        solver = saved.solve(**{options: [edge], "without": [edge, *out] if do == "remove_edge" else out})
        assert np.abs(solver.estimate(saved.keyframes) - slam.trajectory()).max() < 0.02


def test_a_landmark_that_was_merged_has_the_edges_of_both(run, edits, applied):
    one = edits["merge_landmarks"]
    before, slam = restored(run, []), applied("merge_landmarks")
    sightings = [before.landmarks[one[key]].sightings for key in ("landmark", "into")]
    assert one["landmark"] not in slam.landmarks
    assert slam.landmarks[one["into"]].sightings == sum(sightings)
    merged = before.landmarks[one["landmark"]].vertex
    assert merged not in slam.solver.vertices
    (record,) = slam.edits
    assert [slam.ledger.reason.values[edge] for edge in record.edges] == [Reason.BY_HAND] * len(record.edges)
    for old, new in zip(record.edges, record.added, strict=True):
        (a, b) = (slam.graph.edge(edge) for edge in (old, new))
        assert a.measured.tolist() == b.measured.tolist()
        assert b.vertices == (a.vertices[0], slam.landmarks[one["into"]].vertex)


def test_a_robot_that_goes_on_in_the_map_keeps_every_edit(run, edits, edited):
    state = map_of(edited, [])
    slam = GraphSlam(restored(run, []).config, start=state)
    merged, into = edits["merge_landmarks"]["landmark"], edits["merge_landmarks"]["into"]
    at, n = slam.keyframes.stamps_ns[-1], slam.landmarks[into].sightings
    kind = slam.graph.edge(int(slam.graph.edges_of("landmarks")[0]))
    measured = tuple(kind.measured[:2].tolist())
    decided = {edge: slam.ledger.reason.values[edge] for edge in range(slam.graph.edge_count)}
    decided = [edge for edge, reason in decided.items() if reason == Reason.BY_HAND]
    verdicts = slam.ledger.verdict.values[decided].tolist()
    for k in range(60):
        stamp_ns = int(at + (k + 1) * 5 * 10**8)
        slam.process(Odometry(stamp_ns, (0.5 * k, 0.0, 0.0)))
        sighting = Sighting(merged, "position", measured, (0.01, 0.0, 0.0, 0.01))
        slam.process(Sightings(stamp_ns, "detections", (sighting,)))
    slam.process(Control("end"))
    slam.process(Control("optimize"))
    assert len(decided) > 10
    assert slam.ledger.verdict.values[decided].tolist() == verdicts
    assert {slam.ledger.reason.values[edge] for edge in decided} == {Reason.BY_HAND}
    assert {Verdict(verdict) for verdict in verdicts} == {Verdict.REJECTED, Verdict.NOT_EVALUATED}
    assert merged not in slam.landmarks
    assert slam.landmarks[into].sightings > n
    assert "dock <1>" in slam.landmarks
    assert [one.edit.name for one in slam.edits] == list(edits)


def test_an_edited_run_is_repeated_to_the_same_bytes(edited, tmp_path):
    assert cli.main(["replay", str(edited), "--out", str(tmp_path / "again")]) == 0
    one, two = contents(edited), contents(tmp_path / "again")
    assert {name for name in one if one[name] != two[name]} == {"run.json"}


def test_explain_ledger_diff_solve_and_freeze_know_the_edits(run, edits, edited, tmp_path, capsys):
    entries = read_ledger(edited)
    gone, let_in = edits["remove_edge"]["edge"], edits["let_in_edge"]["edge"]
    assert (entries[gone].verdict, entries[gone].reason) == (Verdict.REJECTED, Reason.BY_HAND)
    (added,) = (e for e in entries if e.label == "by_hand")
    assert (added.measured, added.reason, added.weight) == (entries[let_in].measured, Reason.BY_HAND, 1.0)

    def told(*words):
        capsys.readouterr()
        code = cli.main([*map(str, words)])
        return code, " ".join(capsys.readouterr().out.split())

    text = f"edge {gone} taken out, by Anna, 2026-05-04T10:30:00Z: seen on the spot (edit remove_edge)"
    assert f"by hand {text}" in told("explain", edited, gone)[1]
    assert f"edge {let_in} let in, as edge {added.edge}, by Anna" in told("explain", edited, added.edge)[1]
    assert f"by hand: {text}" in told("explain", edited)[1]
    code, difference = told("map", "diff", run, edited)
    assert code == 4
    assert f"by hand only in B: {text}" in difference
    assert told("map", "diff", edited, edited)[1].endswith("nothing: they are the same")
    assert told("explain", edited, "--without", added.edge)[0] == 0
    assert told("map", "freeze", edited, "--out", tmp_path / "site")[0] == 0
    assert f"by hand: {text}" in told("explain", tmp_path / "site")[1]
    state = map_of(tmp_path / "site", [])
    assert [one.edit.name for one in state.edits] == list(edits)
    assert state.ledger.reason.values[gone] == Reason.BY_HAND


def test_what_cannot_be_applied_is_refused_in_one_line_and_nothing_is_written(run, edits, entries, tmp_path, capsys):
    odometry = next(e.edge for e in entries if e.label == "odometry")
    cases = [
        ({"do": "remove_edge", "edge": 999999}, "(remove_edge, edge 999999): it is not in the graph"),
        ({"do": "let_in_edge", "edge": 999999}, "(let_in_edge, edge 999999): it is not in the graph"),
        ({"do": "remove_edge", "edge": odometry}, "it is odometry or a prior"),
        ({"do": "let_in_edge", "edge": odometry}, "it is odometry or a prior"),
        ({"do": "remove_landmark", "landmark": "none"}, "(remove_landmark, landmark none): it is not in the map"),
        ({"do": "rename_landmark", "landmark": "none", "to": "x"}, "it is not in the map"),
        ({"do": "merge_landmarks", "landmark": entries[-1].landmark or "1", "into": "none"}, "none is not in the map"),
        (edits["rename_landmark"] | {"to": edits["remove_landmark"]["landmark"]}, "another landmark is named"),
    ]
    for number, (values, named) in enumerate(cases):
        plan = planned(run, tmp_path, {"name": f"case-{number}", **WHO} | values | {"name": f"case-{number}"})
        capsys.readouterr()
        assert edit(run, plan, "--out", tmp_path / "new") == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"edit case-{number} (" in line
        assert named in line
        assert not (tmp_path / "new").exists()


def test_a_plan_for_another_run_and_a_folder_that_is_there_are_refused(run, edits, edited, tmp_path, capsys):
    plan = planned(edited, tmp_path, edits["remove_edge"])
    assert source_hash(run) != source_hash(edited)
    assert edit(run, plan, "--dry-run") == 2
    assert "the plan is for another run" in capsys.readouterr().err
    assert edit(edited, plan, "--dry-run") == 2
    assert "the map has an edit of that name already" in capsys.readouterr().err
    plan = planned(run, tmp_path, edits["remove_edge"])
    for there in (run, edited):
        before = contents(there)
        assert edit(run, plan, "--out", there) == 2
        assert contents(there) == before
    (tmp_path / "empty").mkdir()
    assert edit(run, plan, "--out", tmp_path / "empty") == 2
    assert edit(run, planned(run, tmp_path), "--dry-run") == 2
    assert "the plan has no edits" in capsys.readouterr().err


def test_a_dry_run_prints_the_effect_and_writes_nothing(run, edits, edited, tmp_path, capsys):
    plan = planned(run, tmp_path, *edits.values())
    before = contents(tmp_path) | contents(run)
    capsys.readouterr()
    assert edit(run, plan, "--dry-run") == 0
    out = capsys.readouterr().out
    assert "nothing was written" in out
    assert contents(tmp_path) | contents(run) == before
    chi2 = float(next(line for line in out.splitlines() if line.startswith("chi2")).split()[-1])
    assert chi2 == pytest.approx(json.loads((edited / "run.json").read_text())["chi2"], rel=1e-6)


def test_undo_writes_the_run_as_without_that_edit_to_the_same_bytes(run, edits, edited, tmp_path, capsys):
    for name in ("let_in_edge", "rename_landmark"):
        before, rest = contents(edited), [one for do, one in edits.items() if do != name]
        without, undone = tmp_path / f"without_{name}", tmp_path / f"undone_{name}"
        assert edit(run, planned(run, tmp_path, *rest), "--out", without) == 0
        assert edit(edited, None, "--undo", name, "--out", undone) == 0
        assert contents(edited) == before
        one, two = contents(without), contents(undone)
        assert {file for file in one if one[file] != two[file]} == {"run.json"}
    for folder, name, named in ((run, "x", "edit 'x' is not in it"), (edited, "x", "it has remove_edge, let_in_edge")):
        capsys.readouterr()
        assert edit(folder, None, "--undo", name, "--out", tmp_path / "none") == 2
        assert named in capsys.readouterr().err
        assert not (tmp_path / "none").exists()
