"""Edits by hand: what each kind does to a map, that what is made of the map keeps it, and what is refused."""

import hashlib
import json

import numpy as np
import pytest
import small_drive
from rows import each

from graph_slam_ros import cli, replay
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.maps.edit import Plan, edit_run, plan_text, source_hash
from graph_slam_ros.measurements.edits import ACTIONS, edit_of
from graph_slam_ros.runs.ledger_file import read_ledger
from graph_slam_ros.runs.restore import map_of, record_run, restored
from graph_slam_ros.runs.saved_run import load_run
from graph_slam_ros.slam import Fix, Sighting, Sightings
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.tools.report.contents import read_contents

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "seen on the spot"}
EXACT = {"sigma_m": 0.0, "sigma_rad": 0.0}
CLOSURE = {"from_keyframe": 2, "to_keyframe": "1021", "sigma_m": 0.05, "sigma_rad": 0.02}


def one(do, **arguments):
    return {"name": do, **WHO, "do": do, **arguments}


def split(**arguments):
    return one("split_landmark", landmark="0", to="dock <2>", **arguments)


def contents(folder):
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in folder.iterdir() if f.name != "run.json"}


@pytest.fixture(scope="module", params=[2, 3])
def either(request, tmp_path_factory):
    """A run in the plane, and one in space."""
    return small_drive.run(tmp_path_factory.mktemp("small") / f"run_{request.param}", request.param)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return small_drive.run(tmp_path_factory.mktemp("small") / "run")


def applied(run, folder, *edits):
    """A map before and after a plan."""
    edit_run(run, edits, folder / "new")
    return restored(run, []).view, restored(folder / "new", []).view


def test_a_closure_by_hand_is_in_and_pulls_as_its_sigmas_say(either, tmp_path):
    before = restored(either, []).view
    space = before.space
    true = space.group.between(*map(tuple, before.trajectory()[[2, 21]]))
    pose = list(map(float, space.normalized((true[0] + 0.05, *true[1:]))))
    ends = {"from_keyframe": 2, "to_keyframe": "1021", "sigma_m": 1e-3, "sigma_rad": 1e-3}
    before, after = applied(either, tmp_path, one("add_closure", **ends, pose=pose))
    now = space.group.between(*map(tuple, after.trajectory()[[2, 21]]))
    assert abs(now[0] - pose[0]) < 0.01
    (edge,) = after.edits[0].added
    made = after.graph.edge(edge)
    assert (made.label, made.source, made.weight) == ("by_hand", "by hand", 1.0)
    assert np.linalg.inv(made.sqrt_information.T @ made.sqrt_information) == pytest.approx(1e-6 * np.eye(space.dof))
    assert (after.ledger.verdict_of(edge), after.ledger.reason.values[edge]) == (Verdict.NOT_EVALUATED, Reason.BY_HAND)


def test_a_map_is_moved_rigidly_and_stays_there(either, tmp_path):
    is_flat = restored(either, []).view.space.dimensions == 2
    pose = [10.0, 20.0, 1.0] if is_flat else [10.0, 20.0, 3.0, 0.0, 0.6, 0.0, 0.8]
    before, after = applied(either, tmp_path, one("move_anchor", keyframe=5, pose=pose, **EXACT))
    group = after.space.group
    assert np.allclose(group.local(tuple(after.trajectory()[5]), tuple(pose)), 0.0, atol=1e-6)
    for a, b in ((0, 5), (5, 20)):
        then, now = (group.between(*map(tuple, of.trajectory()[[a, b]])) for of in (before, after))
        assert np.allclose(group.local(now, then), 0.0, atol=1e-5)
    covariances = after.keyframe_covariances()
    assert np.trace(covariances[5]) < 1e-5 < np.trace(covariances[0])
    assert after.solver.evaluate().chi2_final == pytest.approx(before.solver.evaluate().chi2_final, rel=1e-6)
    (tmp_path / "map").mkdir()
    _, moved = applied(either, tmp_path / "map", one("move_map", pose=pose, sigma_m=0.3, sigma_rad=0.1))
    assert np.allclose(group.local(tuple(moved.trajectory()[0]), tuple(pose)), 0.0, atol=1e-5)
    assert np.diag(moved.keyframe_covariances()[0])[:2] == pytest.approx(0.09, rel=1e-6)
    (anchor,) = moved.edits[0].added
    assert [edge for edge in moved.solver.edges.tolist() if len(moved.graph.edge(edge).vertices) == 1] == [anchor]


def test_a_landmark_is_split_by_edges_or_by_keyframes_and_merged_again(either, tmp_path):
    before = restored(either, []).view
    vertex, sightings = before.landmarks["0"].vertex, before.graph.edges_of("landmarks").tolist()
    edges = [e for e in sightings if before.graph.edge(e).vertices[1] == vertex]
    late = [e for e in edges if before.graph.edge(e).vertices[0] >= before.keyframes.ids[12]]
    assert 0 < len(late) < len(edges)
    _, after = applied(either, tmp_path, split(**{"from": 12, "until": "1023"}))
    assert restored(either, []).view.trajectory().tolist() == before.trajectory().tolist()
    assert edit_run(either, [split(edges=late)]).edits[0].edges == after.edits[0].edges == tuple(late)
    a, b = after.landmarks["0"], after.landmarks["dock <2>"]
    assert (a.sightings, b.sightings) == (len(edges) - len(late), len(late))
    assert a.last_seen_ns < b.first_seen_ns <= b.last_seen_ns == before.landmarks["0"].last_seen_ns
    for new, old in zip(after.edits[0].added, late, strict=True):
        assert after.graph.edge(new).measured.tolist() == before.graph.edge(old).measured.tolist()
        assert after.graph.edge(new).vertices == (before.graph.edge(old).vertices[0], b.vertex)
        assert after.ledger.is_inside(new)
    edit_run(tmp_path / "new", [one("merge_landmarks", landmark="dock <2>", into="0")], tmp_path / "merged")
    merged = restored(tmp_path / "merged", []).view
    assert merged.trajectory() == pytest.approx(before.trajectory(), abs=1e-4)
    assert merged.landmarks.keys() == before.landmarks.keys()
    assert merged.landmarks["0"].sightings == len(edges)


def all_edits(run):
    """One of each kind, in one plan."""
    view = restored(run, []).view
    edges = view.graph.edges_of("landmarks").tolist()
    pose = list(map(float, view.space.group.between(*map(tuple, view.trajectory()[[2, 21]]))))
    return [
        one("remove_edge", edge=edges[7]),
        one("let_in_edge", edge=edges[9]),
        one("add_closure", **CLOSURE, pose=pose),
        split(**{"from": 12, "until": 23}),
        one("remove_landmark", landmark="3"),
        one("merge_landmarks", landmark="4", into="5"),
        one("rename_landmark", landmark="6", to="gate"),
        one("move_anchor", keyframe=5, pose=[10.0, 20.0, 1.0], **EXACT),
        one("move_map", pose=[-3.0, 1.0, 0.5], sigma_m=0.1, sigma_rad=0.05),
    ]


@pytest.fixture(scope="module")
def edited(run, tmp_path_factory):
    """The run with one edit of each kind."""
    out = tmp_path_factory.mktemp("edited") / "new"
    edit_run(run, all_edits(run), out)
    return out


def test_an_edited_run_has_one_edit_of_each_kind_and_is_repeated_to_the_same_bytes(run, edited, tmp_path):
    before, after = restored(run, []).view, restored(edited, []).view
    assert {done.edit.do for done in after.edits} == ACTIONS.keys()
    assert after.landmarks.keys() == {*before.landmarks, "gate", "dock <2>"} - {"3", "4", "6"}
    assert load_run(edited).trajectory().poses[:, :2] == pytest.approx(after.trajectory()[:, :2], abs=1e-6)
    assert set(load_run(edited).landmarks.names) == after.landmarks.keys()
    replay(edited, tmp_path / "again")
    assert contents(edited) == contents(tmp_path / "again")


def test_an_edit_is_undone_with_the_plan_that_an_edited_run_keeps(run, edited, tmp_path):
    plan = json.loads((edited / "run.json").read_text())["plan"]
    plan["edits"] = [values for values in plan["edits"] if values["do"] == "remove_landmark"]
    (tmp_path / "edits.json").write_text(json.dumps(plan))
    assert command(run, "--plan", tmp_path / "edits.json", "--out", tmp_path / "new") == 0
    assert restored(tmp_path / "new", []).view.landmarks.keys() == restored(run, []).view.landmarks.keys() - {"3"}


def test_commands_on_maps_know_the_edits(run, edited, capsys, tmp_path):
    def said(*arguments):
        capsys.readouterr()
        code = cli.main(list(map(str, arguments)))
        return code, " ".join(capsys.readouterr().out.split())

    view, saved = restored(edited, []).view, SavedGraph(edited, [])
    code, difference = said("map", "diff", run, edited)
    explained = said("explain", edited)[1]
    assert code == 4
    for done in view.edits:
        assert f"by hand: {done.text}" in explained
        assert f"by hand only in B: {done.text}" in difference
        for edge in (*done.edges[:1], *done.added[:1]):
            assert f"by hand {done.text}" in said("explain", edited, edge)[1]
    assert said("map", "diff", edited, edited)[1].endswith("nothing: they are the same")
    assert said("map", "export", edited, "--out", tmp_path / "graph.g2o")[0] == 0
    file = read_g2o(tmp_path / "graph.g2o").graph
    assert file.edge_count == sum(e.is_in for e in saved.entries)
    poses = [file.vertex(v).initial for v in range(file.vertex_count) if file.kind_of(v).size == 3]
    assert np.array(poses)[:, :2] == pytest.approx(view.trajectory()[:, :2], abs=1e-4)
    last = max(e.edge for e in saved.entries if e.is_in and e.verdict)
    chi2 = [solver.evaluate().chi2_final for solver in (saved.solver, saved.solve([last]))]
    assert "chi2 {:.4f} -> {:.4f}".format(*chi2) in said("explain", edited, "--without", last)[1]
    page = read_contents(edited)
    assert page.losses == []
    assert page.data["tables"]["edits"] == [[e.edit.name, e.edit.text, *WHO.values()] for e in view.edits]
    assert page.data["edges"]["by_hand"].keys() == {str(k) for e in view.edits for k in (*e.edges, *e.added)}
    other = small_drive.run(tmp_path / "other", start_s=5000, seed=1, first=6)
    for command in (["map", "freeze", edited], ["map", "merge", edited, other], ["map", "merge", other, edited]):
        out = tmp_path / f"{command[1]}_{len(list(tmp_path.iterdir()))}"
        assert said(*command, "--out", out)[0] == 0
        state = map_of(out, [])
        assert [done.edit.name for done in state.edits] == [done.edit.name for done in view.edits]
        reasons = {state.ledger.reason.values[edge] for done in state.edits for edge in done.edges}
        assert reasons <= {Reason.BY_HAND, Reason.WITHDRAWN}


def test_a_robot_that_goes_on_in_the_map_keeps_every_edit(edited, tmp_path):
    start = map_of(edited, [])
    decided = [edge for edge, reason in enumerate(start.ledger.reason.values) if reason == Reason.BY_HAND]
    verdicts, edits = start.ledger.verdict.values[decided].tolist(), list(start.edits)
    seen = start.landmarks["5"].sightings
    assert {Verdict(verdict) for verdict in verdicts} == {Verdict.REJECTED, Verdict.NOT_EVALUATED}
    drive = small_drive.drive(start_s=9000, seed=2, first=3)
    view = record_run(tmp_path / "on", small_drive.config(), drive, [], start)[0].view
    assert view.edits == edits
    assert view.ledger.verdict.values[decided].tolist() == verdicts
    assert {view.ledger.reason.values[edge] for edge in decided} == {Reason.BY_HAND}
    assert len(view.drives) == 2
    assert "4" not in view.landmarks and view.landmarks["5"].sightings > seen, "its identity is that of another"
    assert {"3", "6", "gate"} <= view.landmarks.keys(), "what was removed or renamed begins anew"
    last = tuple(view.trajectory()[-1])
    replay(tmp_path / "on", tmp_path / "again")
    assert contents(tmp_path / "on") == contents(tmp_path / "again")
    assert tuple(restored(tmp_path / "on", []).view.trajectory()[-1]) == pytest.approx(last, abs=1e-6)


MOVE = {"pose": [0.0] * 6 + [1.0], **EXACT}
REFUSED = [
    (one("remove_edge", edge=999999), "edit remove_edge (edge 999999): it is not in the graph"),
    (one("remove_edge", edge=0), "it is odometry or a prior"),
    (one("let_in_edge", edge=999999), "it is not in the graph"),
    (one("let_in_edge", edge=0), "it is odometry or a prior"),
    (one("remove_landmark", landmark="none"), "edit remove_landmark (landmark none): it is not in the map"),
    (one("rename_landmark", landmark="none", to="x"), "it is not in the map"),
    (one("rename_landmark", landmark="3", to="4"), "another landmark is named 4"),
    (one("merge_landmarks", landmark="3", into="none"), "landmark none is not in the map"),
    (one("add_closure", **CLOSURE | {"from_keyframe": 99}, pose=[0, 0, 0]), "no keyframe 99: the map has 0 to 23"),
    (one("add_closure", **CLOSURE | {"to_keyframe": "2000.5"}, pose=[0, 0, 0]), "no keyframe at 2000.5 s"),
    (one("add_closure", **CLOSURE | {"to_keyframe": 2}, pose=[0, 0, 0]), "both are one keyframe"),
    (one("add_closure", **CLOSURE, pose=[0.0] * 6 + [1.0]), "pose: 7 numbers; in 2 dimensions it has 3"),
    (split(edges=[0]) | {"landmark": "none"}, "it is not in the map"),
    (split(edges=[0]), "edge 0 is no sighting of landmark 0"),
    (split(edges=[0]) | {"to": "4"}, "another landmark is named 4"),
    (split(**{"from": 5, "until": 6}), "it was not seen there"),
    (split(**{"from": 7, "until": 2}), "no keyframe from 7 until 2"),
    (split(**{"from": 0, "until": 23}), "what is left of 0 does not determine where it is: 0 sightings"),
    (one("move_anchor", keyframe=24, **MOVE), "no keyframe 24"),
    (one("move_anchor", keyframe=5, **MOVE), "pose: 7 numbers"),
    (one("move_map", **MOVE), "pose: 7 numbers"),
]


@each("values, named", REFUSED)
def test_what_cannot_be_done_is_named_and_nothing_is_written(values, named, run, tmp_path):
    before = contents(run)
    with pytest.raises(GraphSlamError) as raised:
        edit_run(run, [values], tmp_path / "new")
    assert str(raised.value).startswith(f"edit {values['name']}")
    assert named in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "new").exists()
    assert contents(run) == before


def test_a_frozen_map_and_one_that_measurements_locate_are_not_moved(run, tmp_path):
    assert cli.main(["map", "freeze", str(run), "--out", str(tmp_path / "site")]) == 0
    turn = one("move_map", pose=[-3.0, 1.0, 0.5], **EXACT)
    anchored = one("move_anchor", keyframe=5, pose=[-3.0, 1.0, 0.5], **EXACT)
    closed = one("add_closure", **CLOSURE, pose=[1.0, 0.0, 0.0])
    for values in (anchored, turn, split(**{"from": 12, "until": 23}), closed):
        with pytest.raises(GraphSlamError, match="it is part of a frozen map, which never changes"):
            edit_run(tmp_path / "site", [values])
    fix = Fix(1005 * 10**9, "gnss", "position", (50.0, 60.0), (0.01, 0.0, 0.0, 0.01))
    measured = list(small_drive.drive())
    record_run(tmp_path / "fixed", small_drive.config(), [*measured[:12], fix, *measured[12:]], [])
    with pytest.raises(GraphSlamError, match=r"1 measurements say where the map lies, the first is edge \d+ \(fixes\)"):
        edit_run(tmp_path / "fixed", [turn])


def test_an_edge_in_by_hand_that_all_else_contradicts_is_warned_of(run, tmp_path):
    """Also one without which a landmark would be undetermined."""
    (fit,) = (done := edit_run(run, [one("add_closure", **CLOSURE, pose=[3.0, 3.0, 0.0])])).by_hand
    assert fit.innovation > 10 * fit.limit
    assert f"edge {fit.edge} is in by hand, and all else contradicts it" in done.warnings[0]
    view = restored(run, []).view
    true = list(map(float, view.space.group.between(*map(tuple, view.trajectory()[[2, 21]]))))
    good = edit_run(run, [one("add_closure", **CLOSURE, pose=true)])
    assert good.warnings == []
    assert good.by_hand[0].innovation < 1.0
    drive = list(small_drive.drive())
    seen_once = Sightings(1003 * 10**9, "detections", (Sighting("lamp", "position", (1.0, 1.0), (0.01, 0, 0, 0.01)),))
    record_run(tmp_path / "lamp", small_drive.config(), [*drive[:8], seen_once, *drive[8:]], [])
    lamp = next(e.edge for e in read_ledger(tmp_path / "lamp") if e.landmark == "lamp")
    (alone,) = edit_run(tmp_path / "lamp", [one("let_in_edge", edge=lamp)]).by_hand
    assert "nothing else determines what it is between" in alone.text


def planned(run, folder, *edits):
    file = folder / "edits.json"
    file.write_text(plan_text(Plan(source_hash(run), tuple(map(edit_of, edits)))))
    return file


def command(run, *words):
    return cli.main(["map", "edit", str(run), *map(str, words)])


def test_a_new_plan_is_for_its_run_alone_and_a_folder_that_is_there_stays(run, edited, tmp_path, capsys):
    file = tmp_path / "new.json"
    assert command(run, "--new-plan", file) == 0
    assert command(run, "--plan", file, "--dry-run") == 2
    assert "the plan has no edits" in capsys.readouterr().err
    values = one("rename_landmark", landmark="0", to="x")
    file.write_text(json.dumps(json.loads(file.read_text()) | {"edits": [values]}))
    assert command(edited, "--plan", file, "--dry-run") == 2
    assert "the plan is for another run" in capsys.readouterr().err
    assert command(edited, "--plan", planned(edited, tmp_path, values), "--dry-run") == 2
    assert "the map has an edit of that name already" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    for there in (run, edited, tmp_path / "empty"):
        before = contents(there)
        assert command(run, "--plan", file, "--out", there) == 2
        assert contents(there) == before


def test_a_dry_run_prints_the_effect_and_writes_nothing(run, edited, tmp_path, capsys):
    plan = planned(run, tmp_path, *all_edits(run), one("add_closure", **CLOSURE, pose=[3, 3, 0]) | {"name": "wrong"})
    before = contents(tmp_path) | contents(run)
    assert command(run, "--plan", plan, "--dry-run") == 0
    said = capsys.readouterr()
    assert "nothing was written" in said.out
    assert "beware: edge" in said.err
    assert contents(tmp_path) | contents(run) == before
    assert command(run, "--plan", planned(run, tmp_path, *all_edits(run)), "--dry-run") == 0
    chi2 = float(next(line for line in capsys.readouterr().out.splitlines() if line.startswith("chi2")).split()[-1])
    assert chi2 == pytest.approx(json.loads((edited / "run.json").read_text())["chi2"], abs=1e-4)
