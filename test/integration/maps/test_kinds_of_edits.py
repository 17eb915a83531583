"""Each kind of edit does what it says, stays in all that is made of the map, and is undone."""

import functools
import hashlib

import numpy as np
import pytest
import small_drive
from driven import without_names
from mcap.records import Message

from graph_slam_ros import cli, replay
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import FormatError, GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.maps.edit import Plan, edit, plan_text, source_hash, undo_edit
from graph_slam_ros.measurements.edit_actions import ACTIONS
from graph_slam_ros.measurements.edits import edit_of
from graph_slam_ros.recordings.mcap_records import records
from graph_slam_ros.runs.map_journal import read_map, state_of
from graph_slam_ros.runs.restore import map_of, record_run, restored
from graph_slam_ros.runs.saved_run import load_run
from graph_slam_ros.slam import Control, Fix, GraphSlam
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.solver import Solver
from graph_slam_ros.tools.report.contents import read_contents

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "seen on the spot"}
EXACT = {"sigma_m": 0.0, "sigma_rad": 0.0}
CASES = {
    "remove_edge": {"edge": "sighting"},
    "let_in_edge": {"edge": "sighting"},
    "add_closure": {"from_keyframe": 2, "to_keyframe": "1021", "pose": None, "sigma_m": 0.05, "sigma_rad": 0.02},
    "remove_landmark": {"landmark": "3"},
    "rename_landmark": {"landmark": "3", "to": "dock <1>"},
    "merge_landmarks": {"landmark": "3", "into": "4"},
    "split_landmark": {"landmark": "0", "to": "dock <2>", "from": 12, "until": "1023"},
    "move_anchor": {"keyframe": 5, "pose": [10.0, 20.0, 1.0], **EXACT},
    "move_map": {"pose": [-3.0, 1.0, 0.5], "sigma_m": 0.1, "sigma_rad": 0.05},
    "cut": {"from": 8, "until": 12},
}
ENDS = {"at the beginning": {"from": 0, "until": 4}, "at the end": {"from": 19, "until": "1023.5"}}


@functools.cache
def known(run):
    """The map of a run, to be looked at alone."""
    return restored(run, [])


def values(do, run, arguments=None, name=None):
    chosen, slam = dict(CASES[do] if arguments is None else arguments), known(run)
    if chosen.get("edge") == "sighting":
        chosen["edge"] = int(slam.graph.edges_of("landmarks")[7])
    if chosen.get("pose", 0) is None:
        a, b = slam.trajectory()[[2, 21]]
        chosen["pose"] = list(map(float, slam.space.group.between(tuple(a), tuple(b))))
    return {"name": name or do, **WHO, "do": do} | chosen


def plan(run, *edits):
    return Plan(source_hash(run), tuple(map(edit_of, edits)))


def contents(folder):
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in folder.iterdir() if f.name != "run.json"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return small_drive.run(tmp_path_factory.mktemp("small") / "run")


@pytest.fixture(scope="module")
def second(tmp_path_factory):
    """Another drive, past the same landmarks."""
    return small_drive.run(tmp_path_factory.mktemp("small") / "second", start_s=5000, seed=1, first=6)


@pytest.fixture(scope="module")
def edited(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("edited")

    @functools.cache
    def made(do):
        edit(run, plan(run, values(do, run)), folder / do)
        return folder / do

    return made


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    def words(capsys, *arguments):
        capsys.readouterr()
        code = cli.main(list(map(str, arguments)))
        return code, " ".join(capsys.readouterr().out.split())

    return words


def test_every_kind_is_tested():
    assert CASES.keys() == ACTIONS.keys()


@pytest.mark.parametrize("do", CASES)
def test_a_run_has_what_the_pipeline_makes_of_an_edit(do, run, edited):
    before = known(run)
    slam = GraphSlam(before.config, start=state_of(before))
    slam.process(Control("edit", tuple(edit_of(values(do, run)).values.items())))
    slam.process(Control("optimize"))
    new, saved = restored(edited(do), []), load_run(edited(do))
    assert new.trajectory() == pytest.approx(slam.trajectory(), abs=1e-6)
    assert len(saved.trajectory().poses) == len(slam.keyframes)
    assert new.landmarks.keys() == slam.landmarks.keys() == set(saved.landmarks.names)
    assert new.ledger.verdict.values.tolist() == slam.ledger.verdict.values.tolist()
    assert new.ledger.history == slam.ledger.history
    assert new.segments == slam.segments
    assert new.drives == slam.drives
    assert list(new.sighting_poses) == list(slam.sighting_poses)
    assert read_map(edited(do), []).edits == slam.edits
    assert [one.edit.name for one in slam.edits] == [do]


@pytest.mark.parametrize("do", CASES)
def test_a_run_with_an_edit_is_repeated_to_the_same_bytes(do, edited, tmp_path):
    replay(edited(do), tmp_path / "again")
    assert contents(edited(do)) == contents(tmp_path / "again")


@pytest.mark.parametrize("do", CASES)
def test_an_edit_is_undone_to_the_bytes_of_a_plan_without_it(do, run, tmp_path):
    other = values("rename_landmark", run, {"landmark": "6", "to": "gate"}, "other")
    edit(run, plan(run, values(do, run), other), tmp_path / "both")
    edit(run, plan(run, other), tmp_path / "without")
    undo_edit(tmp_path / "both", do, tmp_path / "undone")
    assert contents(tmp_path / "undone") == contents(tmp_path / "without")


@pytest.mark.parametrize("do", CASES)
def test_a_program_of_the_first_version_refuses_a_map_that_it_would_misread(do, edited, monkeypatch):
    new = edited(do)
    monkeypatch.setattr("graph_slam_ros.runs.map_journal.VERSION", 1)
    if do == "cut":
        with pytest.raises(FormatError, match=r"map\.mcap: record \d+: its version is 2; this program knows up to 1"):
            read_map(new, [])
    else:
        assert read_map(new, []).edits


@pytest.mark.parametrize("do", CASES)
def test_commands_on_maps_know_an_edit(do, run, edited, second, said, capsys, tmp_path):
    new, slam = edited(do), restored(edited(do), [])
    text = f"by hand: {slam.edits[0].text}"
    assert text in said(capsys, "explain", new)[1]
    for edge in (*slam.edits[0].edges[:1], *slam.edits[0].added[:1]):
        assert f"by hand {slam.edits[0].text}" in said(capsys, "explain", new, edge)[1]
    code, difference = said(capsys, "map", "diff", run, new)
    assert code == 4 and f"by hand only in B: {slam.edits[0].text}" in difference
    saved = SavedGraph(new, [])
    assert saved.solver.estimate(saved.keyframes) == pytest.approx(slam.trajectory(), abs=1e-4)
    assert said(capsys, "map", "export", new, "--out", tmp_path / "path.tum")[0] == 0
    assert len(np.loadtxt(tmp_path / "path.tum")) == len(slam.keyframes)
    assert said(capsys, "map", "export", new, "--out", tmp_path / "graph.g2o")[0] == 0
    file = read_g2o(tmp_path / "graph.g2o")
    assert file.graph.edge_count == sum(e.is_in for e in saved.entries)
    assert said(capsys, "optimize", tmp_path / "graph.g2o")[0] == 0
    poses = [file.graph.vertex(v).initial for v in range(file.graph.vertex_count) if file.graph.kind_of(v).size == 3]
    assert np.array(poses)[:, :2] == pytest.approx(slam.trajectory()[:, :2], abs=1e-4)
    assert said(capsys, "map", "export", new, "--out", tmp_path / "map.mcap")[0] == 0
    assert len([m for m in records(tmp_path / "map.mcap", []) if isinstance(m, Message)]) == len(slam.keyframes) + 3
    last = max(e.edge for e in saved.entries if e.is_in and e.verdict)
    chi2 = [solver.evaluate().chi2_final for solver in (saved.solver, saved.solve([last]))]
    assert "chi2 {:.4f} -> {:.4f}".format(*chi2) in said(capsys, "explain", new, "--without", last)[1]
    page = read_contents(new)
    assert page.losses == []
    assert page.data["tables"]["edits"] == [[do, slam.edits[0].edit.text, *WHO.values()]]
    assert page.data["edges"]["by_hand"].keys() == {str(e) for e in (*slam.edits[0].edges, *slam.edits[0].added)}
    for command in (["map", "freeze", new], ["map", "merge", new, second], ["map", "merge", second, new]):
        out = tmp_path / f"{command[0]}_{len(list(tmp_path.iterdir()))}"
        assert said(capsys, *command, "--out", out)[0] == 0
        state = map_of(out, [])
        assert [one.edit.name for one in state.edits] == [do]
        assert {state.ledger.reason.values[edge] for edge in state.edits[0].edges} <= {Reason.BY_HAND, Reason.WITHDRAWN}


@pytest.mark.parametrize("do", CASES)
def test_a_drive_goes_on_in_a_map_with_an_edit(do, edited, tmp_path):
    start = map_of(edited(do), [])
    decided = [edge for edge, reason in enumerate(start.ledger.reason.values) if reason == Reason.BY_HAND]
    verdicts, edits = start.ledger.verdict.values[decided].tolist(), list(start.edits)
    config = small_drive.config()
    slam, _ = record_run(tmp_path / "on", config, small_drive.drive(start_s=9000, seed=2, first=3), [], start)
    assert slam.edits == edits
    assert slam.ledger.verdict.values[decided].tolist() == verdicts
    assert len(slam.drives) == 2
    last = tuple(slam.trajectory()[-1])
    replay(tmp_path / "on", tmp_path / "again")
    assert contents(tmp_path / "on") == contents(tmp_path / "again")
    assert tuple(restored(tmp_path / "on", []).trajectory()[-1]) == pytest.approx(last, abs=1e-6)


# -- what each one does ------------------------------------------------------------------------------------------------


def applied(run, *edits):
    before = known(run)
    slam = GraphSlam(before.config, start=state_of(before))
    for one in edits:
        slam.process(Control("edit", tuple(edit_of(one).values.items())))
    slam.process(Control("optimize"))
    assert slam.is_solved
    return before, slam


@pytest.fixture(scope="module", params=[2, 3])
def either(request, run, tmp_path_factory):
    """The run in the plane, and one in space."""
    return run if request.param == 2 else small_drive.run(tmp_path_factory.mktemp("small") / "space", 3)


def test_a_closure_by_hand_is_in_and_pulls_as_its_sigmas_say(either):
    ends = {"from_keyframe": 2, "to_keyframe": 21, "sigma_m": 1e-3, "sigma_rad": 1e-3}
    before = known(either)
    space = before.space
    true = space.group.between(*map(tuple, before.trajectory()[[2, 21]]))
    pose = list(map(float, space.normalized((true[0] + 0.05, *true[1:]))))
    before, slam = applied(either, values("add_closure", either, {**ends, "pose": pose}))
    now = space.group.between(*map(tuple, slam.trajectory()[[2, 21]]))
    assert abs(now[0] - pose[0]) < 0.01
    (edge,) = slam.edits[0].added
    one = slam.graph.edge(edge)
    assert (one.label, one.source, one.weight) == ("by_hand", "by hand", 1.0)
    assert np.linalg.inv(one.sqrt_information.T @ one.sqrt_information) == pytest.approx(1e-6 * np.eye(space.dof))
    assert (slam.ledger.verdict_of(edge), slam.ledger.reason.values[edge]) == (Verdict.NOT_EVALUATED, Reason.BY_HAND)


def test_a_map_is_moved_rigidly_and_stays_there(either):
    is_flat = known(either).space.dimensions == 2
    pose = [10.0, 20.0, 1.0] if is_flat else [10.0, 20.0, 3.0, 0.0, 0.6, 0.0, 0.8]
    before, slam = applied(either, values("move_anchor", either, {"keyframe": 5, "pose": pose, **EXACT}))
    group = slam.space.group
    assert np.allclose(group.local(tuple(slam.trajectory()[5]), tuple(pose)), 0.0, atol=1e-6)
    for a, b in ((0, 5), (5, 20)):
        then, now = (group.between(*map(tuple, one.trajectory()[[a, b]])) for one in (before, slam))
        assert np.allclose(group.local(now, then), 0.0, atol=1e-5)
    covariances = slam.keyframe_covariances()
    assert np.trace(covariances[5]) < 1e-5 < np.trace(covariances[0])
    assert slam.solver.evaluate().chi2_final == pytest.approx(before.solver.evaluate().chi2_final, rel=1e-6)
    _, moved = applied(either, values("move_map", either, {"pose": pose, "sigma_m": 0.3, "sigma_rad": 0.1}))
    assert np.allclose(group.local(tuple(moved.trajectory()[0]), tuple(pose)), 0.0, atol=1e-5)
    assert np.diag(moved.keyframe_covariances()[0])[:2] == pytest.approx(0.09, rel=1e-6)
    (anchor,) = moved.edits[0].added
    assert [edge for edge in moved.solver.edges.tolist() if len(moved.graph.edge(edge).vertices) == 1] == [anchor]


def test_a_landmark_is_split_by_edges_or_by_keyframes(either):
    before = restored(either, [])
    vertex, sightings = before.landmarks["0"].vertex, before.graph.edges_of("landmarks").tolist()
    edges = [e for e in sightings if before.graph.edge(e).vertices[1] == vertex]
    late = [e for e in edges if before.graph.edge(e).vertices[0] >= before.keyframes.ids[12]]
    assert 0 < len(late) < len(edges)
    _, one = applied(either, values("split_landmark", either))
    _, two = applied(either, values("split_landmark", either, {"landmark": "0", "to": "dock <2>", "edges": late}))
    assert one.trajectory() == pytest.approx(two.trajectory(), abs=1e-9)
    assert sorted(one.edits[0].edges) == late
    a, b = one.landmarks["0"], one.landmarks["dock <2>"]
    assert (a.sightings, b.sightings) == (len(edges) - len(late), len(late))
    assert a.last_seen_ns < b.first_seen_ns <= b.last_seen_ns == before.landmarks["0"].last_seen_ns
    for new, old in zip(one.edits[0].added, late, strict=True):
        assert one.graph.edge(new).measured.tolist() == before.graph.edge(old).measured.tolist()
        assert one.graph.edge(new).vertices == (before.graph.edge(old).vertices[0], b.vertex)
        assert one.ledger.is_inside(new)
    again, three = applied(
        either,
        values("split_landmark", either),
        values("merge_landmarks", either, {"landmark": "dock <2>", "into": "0"}),
    )
    assert three.trajectory() == pytest.approx(again.trajectory(), abs=1e-6)


@pytest.mark.parametrize("where", ["middle", *ENDS])
def test_a_part_of_the_drive_is_cut_out(where, either):
    arguments = ENDS.get(where, CASES["cut"])
    before, slam = applied(either, values("cut", either, arguments))
    first, last = arguments["from"], 23 if where == "at the end" else arguments["until"]
    gone, kept = before.keyframes.ids[first : last + 1], np.delete(np.arange(24), np.arange(first, last + 1))
    assert slam.keyframes.stamps_ns.tolist() == before.keyframes.stamps_ns[kept].tolist()
    assert slam.keyframes.ids.tolist() == before.keyframes.ids[kept].tolist()
    assert not np.isin(gone, slam.solver.vertices).any()
    seen = {name for name in before.landmarks if sighted(before, name) - set(gone.tolist())}
    assert slam.landmarks.keys() == seen
    assert {name: slam.landmarks[name].sightings for name in seen} == {
        name: len(sighted(before, name) - set(gone.tolist())) for name in seen
    }
    assert all(0 <= one.keyframe < len(kept) for one in slam.sighting_poses)
    for one in slam.sighting_poses:
        assert abs(slam.keyframes[one.keyframe].stamp_ns - one.stamp_ns) < 10**9
    if where == "at the end":  # as of a drive that ended there
        short = GraphSlam(small_drive.config(slam.space.dimensions))
        events = list(small_drive.drive(slam.space.dimensions))
        for m in [m for m in events if getattr(m, "stamp_ns", 0) < 1019 * 10**9]:
            short.process(m)
        short.backend.use_noise(slam.noise_factors)  # an edited map keeps that of the whole drive
        short.solver.optimize()
        assert slam.trajectory() == pytest.approx(short.trajectory(), abs=1e-4)
    else:
        most = 0.2 if where == "middle" else 1.0  # without its beginning it is no loop: odometry drifts
        assert np.linalg.norm((slam.trajectory() - before.trajectory()[kept])[:, :2], axis=1).max() < most
    odometry = [slam.graph.edge(e) for e in slam.solver.edges.tolist() if slam.graph.label_of(e) == "odometry"]
    assert len(odometry) == len(kept) - 1
    if where == "middle":
        (link,) = slam.edits[0].added
        check_composed(before, slam.graph.edge(link), first - 1, last + 1)


def sighted(slam, name):
    """The keyframes that a landmark was seen from."""
    mark, graph = slam.landmarks[name], slam.graph
    return {graph.edge(e).vertices[0] for e in slam.solver.edges.tolist() if graph.edge(e).vertices[-1] == mark.vertex}


def check_composed(before, link, first, last):
    """An edge says what the odometry says that it replaces, as uncertain as that: by marginals of odometry alone."""
    group, ids = before.space.group, before.keyframes.ids
    steps = [before.graph.edge(e) for e in before.graph.edges_of("odometry").tolist()]
    steps = {one.vertices: one for one in steps}
    motion, graph = group.IDENTITY, Graph()
    vertices = [graph.add_vertex(before.space.pose, motion)]
    for a, b in zip(ids[first:last], ids[first + 1 : last + 1], strict=True):
        one = steps[int(a), int(b)]
        motion = group.compose(motion, tuple(one.measured))
        vertices.append(graph.add_vertex(before.space.pose, before.space.normalized(motion)))
        graph.add_edge(
            before.space.relative_pose, vertices[-2:], one.measured, Gaussian(one.sqrt_information), "odometry"
        )
    solver = Solver(graph)
    solver.add(vertices, range(graph.edge_count))
    solver.hold(vertices[0])
    solver.update()
    assert np.allclose(group.local(tuple(link.measured), motion), 0.0, atol=1e-9)
    (covariance,) = solver.marginal([vertices[-1]])
    assert np.linalg.inv(link.sqrt_information.T @ link.sqrt_information) == pytest.approx(
        covariance, rel=1e-6, abs=1e-12
    )


def test_keyframes_of_a_plan_have_the_numbers_of_its_run_also_after_a_cut(run):
    cut, pose = values("cut", run, {"from": 3, "until": 6}), [1.0, 2.0, 0.3]
    _, slam = applied(run, cut, values("move_anchor", run, {"keyframe": 10, "pose": pose, **EXACT}))
    at = slam.keyframes.stamps_ns.tolist().index(1010 * 10**9)
    assert at == 6
    assert slam.trajectory()[at] == pytest.approx(pose, abs=1e-6)
    with pytest.raises(GraphSlamError, match=r"edit second \(cut\): keyframe 6 was cut out"):
        applied(run, cut, values("cut", run, {"from": 6, "until": 8}, "second"))
    _, twice = applied(run, cut, values("cut", run, {"from": 7, "until": 8}, "second"))
    assert len(twice.keyframes) == 18
    assert [one.keyframe for one in twice.edits] == [17, 17]


# -- what cannot be done -----------------------------------------------------------------------------------------------

REFUSED = [
    ("add_closure", {"from_keyframe": 99}, "no keyframe 99: the map has 0 to 23"),
    ("add_closure", {"to_keyframe": "2000.5"}, "no keyframe at 2000.5 s"),
    ("add_closure", {"to_keyframe": 2}, "both are one keyframe"),
    ("add_closure", {"pose": [0.0] * 6 + [1.0]}, "pose: 7 numbers; in 2 dimensions it has 3"),
    ("split_landmark", {"landmark": "none"}, "it is not in the map"),
    ("split_landmark", {"to": "4"}, "another landmark is named 4"),
    ("split_landmark", {"from": 5, "until": 6}, "it was not seen there"),
    ("split_landmark", {"from": 7, "until": 2}, "no keyframe from 7 until 2"),
    ("split_landmark", {"from": 0, "until": 23}, "what is left of 0 does not determine where it is: 0 sightings"),
    ("move_anchor", {"keyframe": 24}, "no keyframe 24"),
    ("move_anchor", {"pose": [0.0] * 6 + [1.0]}, "pose: 7 numbers"),
    ("move_map", {"pose": [0.0] * 6 + [1.0]}, "pose: 7 numbers"),
    ("cut", {"from": 1, "until": 23}, "1 keyframes would be left, at least 2 are needed"),
    ("cut", {"from": "900", "until": "901"}, "no keyframe from 900 until 901"),
    ("cut", {"from": 20, "until": 24}, "no keyframe 24"),
]


@pytest.mark.parametrize(("do", "change", "named"), REFUSED)
def test_what_cannot_be_done_is_named_and_nothing_is_written(do, change, named, run, tmp_path):
    before = contents(run)
    arguments = CASES[do] | ({"pose": [1.0, 0.0, 0.0]} if "pose" in CASES[do] else {}) | change
    with pytest.raises(GraphSlamError) as raised:
        edit(run, plan(run, values(do, run, arguments)), tmp_path / "new")
    assert str(raised.value).startswith((f"edit {do}: ", f"edit {do} ("))
    assert named in str(raised.value)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "new").exists()
    assert contents(run) == before


def test_what_a_later_edit_depends_on_is_not_undone(run, tmp_path):
    renamed = values("rename_landmark", run, {"landmark": "3", "to": "gate"}, "first")
    edit(run, plan(run, renamed, values("remove_landmark", run, {"landmark": "gate"}, "second")), tmp_path / "new")
    with pytest.raises(
        GraphSlamError,
        match=r"edit first cannot be undone alone: without it edit second \(remove_landmark, landmark gate\): it is",
    ):
        undo_edit(tmp_path / "new", "first", tmp_path / "undone")
    assert not (tmp_path / "undone").exists()


def test_a_frozen_map_and_one_that_measurements_locate_are_not_moved(run, tmp_path):
    assert cli.main(["map", "freeze", str(run), "--out", str(tmp_path / "site")]) == 0
    for do in ("move_anchor", "move_map", "cut", "split_landmark", "add_closure"):
        one = values(do, tmp_path / "site", name=do)
        with pytest.raises(GraphSlamError, match="it is part of a frozen map, which never changes"):
            edit(tmp_path / "site", plan(tmp_path / "site", one), None)
    fix = Fix(1005 * 10**9, "gnss", "position", (50.0, 60.0), (0.01, 0.0, 0.0, 0.01))
    measured = list(small_drive.drive())
    record_run(tmp_path / "fixed", small_drive.config(), [*measured[:12], fix, *measured[12:]], [])
    with pytest.raises(GraphSlamError, match=r"1 measurements say where the map lies, the first is edge \d+ \(fixes\)"):
        edit(tmp_path / "fixed", plan(tmp_path / "fixed", values("move_map", run)), None)


def test_a_closure_that_all_else_contradicts_is_warned_of(run, capsys, tmp_path):
    wrong = values("add_closure", run, CASES["add_closure"] | {"pose": [3.0, 3.0, 0.0]})
    done = edit(run, plan(run, wrong), None)
    (fit,) = done.by_hand
    assert fit.innovation > 10 * fit.limit
    (tmp_path / "plan.json").write_text(plan_text(plan(run, wrong)))
    assert cli.main(["map", "edit", str(run), "--plan", str(tmp_path / "plan.json"), "--dry-run"]) == 0
    said = capsys.readouterr()
    against = f"edge {fit.edge}: chi2 {fit.innovation:.4g} against all else, chi2 {fit.chi2:.4g} after the solve"
    assert against in said.out
    assert f"beware: edge {fit.edge} is in by hand, and all else contradicts it" in said.err
    good = edit(run, plan(run, values("add_closure", run)), None)
    assert good.warnings == []
    assert good.by_hand[0].innovation < 1.0


def test_a_cut_keeps_the_sightings_of_landmarks_without_identity_with_their_keyframes(tmp_path):
    config = small_drive.config().changed({"landmarks.association": "joint"})
    record_run(tmp_path / "run", config, without_names(small_drive.drive()), [])
    before = restored(tmp_path / "run", [])
    assert all(mark.is_unnamed for mark in before.landmarks.values())
    edit(tmp_path / "run", plan(tmp_path / "run", values("cut", tmp_path / "run")), tmp_path / "new")
    slam = restored(tmp_path / "new", [])
    assert len(slam.keyframes) == 19
    seen = [(mark, one) for mark in slam.landmarks.values() for one in mark.seen]
    assert len(seen) > 20
    for mark, one in seen:
        assert slam.keyframes[one.where.keyframe].vertex == one.where.vertex
        assert slam.graph.edge(one.edge).vertices == (one.where.vertex, mark.vertex)
    assert [len(mark.seen) for mark in slam.landmarks.values()] == [m.sightings for m in slam.landmarks.values()]
    replay(tmp_path / "new", tmp_path / "again")
    assert contents(tmp_path / "new") == contents(tmp_path / "again")
