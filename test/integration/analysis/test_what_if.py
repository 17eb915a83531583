"""``graph_slam explain``: whoever reads it learns why, and a graph solved otherwise is what one made otherwise is."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from faulty import faulty_run
from rows import each

from graph_slam_ros import cli
from graph_slam_ros.analysis import what_if
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.runs.folder import CHANGES, GRAPH, LEDGER
from graph_slam_ros.runs.ledger_file import read_ledger
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.slam.robust.ledger import Verdict
from graph_slam_ros.tools.report.contents import read_contents
from graph_slam_ros.tools.view.workbench import Workbench


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    return faulty_run(tmp_path_factory.mktemp("faulty"))


@pytest.fixture(scope="module")
def saved(replayed):
    return SavedGraph(replayed[1], [])


@pytest.fixture(scope="module")
def run(replayed):
    return replayed[1]


def explained(told, *words):
    code, out, err = told("explain", *words)
    return code, " ".join(out.split()), err


def test_what_is_taken_out_and_let_in_is_as_if_it_had_been_decided_so(replayed, saved):
    """The run's own solver, told the same weights, comes to the same poses."""
    slam, entries = replayed[2].slam, saved.entries
    closure = next(e.edge for e in entries if e.label == "closures" and e.is_in)
    solver = saved.solve(without=[closure])
    slam.view.solver.set_weight(closure, 0.0)
    slam.view.solver.optimize()
    assert solver.estimate(saved.keyframes) == pytest.approx(slam.view.trajectory(), abs=1e-5)
    slam.view.solver.set_weight(closure, 1.0)
    slam.view.solver.optimize()
    back = saved.moved(saved.solve(let_in=[closure]))
    assert back.after.classes["believed"].edges == 1
    assert back.most[1] < 0.01


def test_what_is_false_bends_the_map_when_it_is_let_in_and_not_under_a_loss_that_lets_go(saved):
    false = [e.edge for e in saved.entries if not e.is_in and e.label == "closures"]
    believed = saved.moved(saved.solve(let_in=false[:1]))
    assert believed.most[1] > 0.1
    assert believed.after.chi2_final > believed.before.chi2_final + 100.0
    assert not {edge for edge, *_ in believed.worse} & set(false)
    assert all(after > before for _, before, after in believed.worse)
    gain = [after - before for _, before, after in believed.worse]
    assert gain == sorted(gain, reverse=True)


def test_what_leaves_a_keyframe_without_edges_is_refused(replayed, saved, told):
    last = saved.keyframes[-1]
    for without in ([e.edge for e in saved.entries], [e.edge for e in saved.entries if last in e.vertices]):
        code, out, err = told("explain", replayed[1], "--without", *without)
        assert (code, out, "nothing fixes the gauge of vertex" in err, err.count("\n")) == (2, "", True, 1)


def test_influence_tells_which_edges_cannot_be_done_without(tmp_path, told):
    """Two bearings determine a landmark, one does not."""
    recorder = RunRecorder(tmp_path / "run", Config())
    slam = GraphSlam(Config(), sink=recorder.sink)
    for k in range(30):
        slam.process(Odometry(1_000_000_000 + k * 100_000_000, (0.1 * k, 0.0, 0.0)))
        if k in (5, 25):
            bearing = float(np.arctan2(2.0, 1.5 - 0.1 * k))
            seen = (Sighting("a", "bearing", (bearing,), (1e-4,)),)
            slam.process(Sightings(1_000_000_000 + k * 100_000_000, "seen", seen))
    slam.process(Control("end"))
    slam.process(Control("optimize"))
    run = recorder.save(slam)
    landmarks = {e.edge for e in read_ledger(run) if e.label == "landmarks"}
    assert {one.edge for one in SavedGraph(run, []).influences(5) if one.exact_m == np.inf} == landmarks
    assert len(landmarks) == 2
    code, out, err = told("explain", run, "--influence")
    assert (code, out.count("undetermined"), err) == (0, 2, "")


def test_what_does_not_converge_is_no_solution_and_is_said(replayed, saved, told, monkeypatch):
    """Closures that all else contradicts, and few steps."""
    run, out = replayed[1], [e.edge for e in saved.entries if not e.is_in and e.label == "closures"]
    asked = json.dumps({"without": [], "let_in": out, "loss": "", "first": False}).encode()
    assert told("explain", run, "--with", *out)[0] == 0
    assert Workbench(read_contents(run), 3.0).solve(asked)["is_solved"]
    monkeypatch.setattr(what_if, "MOST_STEPS", 1)  # then the run's own limit counts
    code, said, err = told("explain", run, "--with", *out)
    assert (code, "NOT converged (max_iterations) after" in said, "not a solution" in err) == (3, True, True)
    assert not Workbench(read_contents(run), 3.0).solve(asked)["is_solved"]


def test_the_commands_say_what_moves(replayed, saved, told):
    run = replayed[1]
    false = next(e for e in read_ledger(run) if not e.is_in and e.label == "closures")
    code, out, _ = told("explain", run, "--with", false.edge)
    moved = saved.moved(saved.solve(let_in=[false.edge]))
    assert code == 0
    assert f"{moved.before.chi2_final:.4f}  ->  " in out
    assert f"last pose  moves by {moved.final[0]:.4f} m" in out
    assert f"edge {moved.worse[0][0]} (" in out
    code, out, _ = told("explain", run, "--influence", "3")
    assert code == 0
    *table, after = out.splitlines()
    assert [int(line.split()[0]) for line in table[2:]] == [one.edge for one in saved.influences(3)]
    assert after.startswith("next: graph_slam explain ")
    code, _, err = told("explain", run, "3", "--loss", "none")
    assert (code, "one of EDGE, --influence, and --without, --with and --loss together" in err) == (2, True)


def test_without_an_edge_the_step_to_first_order_is_within_a_fifth_of_solving_again_in_95_of_100(saved):
    """With the loss of all others: without the curvature of these, 80 are."""
    judged, last = [e.edge for e in saved.entries if e.is_in and e.verdict], saved.keyframes[-1:]
    found, right, near, tried = saved.influence_model.of(judged), 0, 0, 0
    for k in (judged[one] for one in np.linspace(0, len(judged) - 1, 60).astype(int)):
        if not found.is_alone[k]:
            before, after = (tuple(one.estimate(last)[0]) for one in (saved.solver, saved.solve([k])))
            step = np.array(saved.space.group.local(after, before))
            length, tried = np.linalg.norm(step[:2]), tried + 1
            right += bool(found.step[k] @ step > 0.0)
            near += bool(abs(np.linalg.norm(found.step[k, :2]) - length) <= 0.2 * length)
    assert min(right, near) >= 0.95 * tried > 40


def test_the_summary_counts_what_the_ledger_has(run, told):
    code, out, err = explained(told, run)
    entries = read_ledger(run)
    assert (code, err) == (0, "")
    assert f"{len(entries)} edges; {sum(e.verdict > 0 for e in entries)} are measurements that can be rejected" in out
    in_and_out = [sum(e.label == "closures" and e.is_in is which for e in entries) for which in (True, False)]
    assert re.search(rf"closures {in_and_out[0]} {in_and_out[1]}\b", out)
    worst = max((e for e in entries if not e.is_in), key=lambda e: e.statistic / e.threshold)
    assert f"edge {worst.edge}" in out
    assert "inert" not in out


def test_a_stranger_learns_why_a_closure_was_rejected(run, told):
    false = next(e for e in read_ledger(run) if (e.label, e.verdict) == ("closures", Verdict.PENDING))
    _, out, _ = explained(told, run, false.edge)
    assert f"edge {false.edge}: a loop closure by closures: held back: unlikely" in out
    assert f"keyframe {false.vertices[0]} and keyframe {false.vertices[1]}" in out
    assert f"chi2 {false.statistic:.4g} with 3 degrees of freedom" in out
    assert f"up to {false.threshold:.4g} would have passed (noise alone exceeds 21.11 once in 10000 times" in out
    assert re.search(r"what if it were in with its full weight: chi2 \+\d", out)
    strained = [int(edge) for edge in re.findall(r"against edge (\d+)", out)]
    assert strained
    assert all(read_ledger(run)[edge].is_in for edge in strained)


def test_a_landmark_is_explained_by_name_and_an_unknown_one_is_refused(run, told):
    wrong = next(e for e in read_ledger(run) if e.landmark and not e.is_in)
    _, out, _ = explained(told, run, wrong.landmark)
    assert f"landmark {wrong.landmark}:" in out
    assert f"edge {wrong.edge}" in out
    code, _, err = explained(told, run, "landmark:7")
    assert code == 2
    assert "7: neither the id of an edge nor a landmark; there are 0/0" in err
    code, _, err = explained(told, run, "99999")
    assert (code, "no edge 99999: their ids are below" in err) == (2, True)


@each("words", [(), ("--without", 3)])
def test_a_run_that_was_never_saved_is_explained_from_its_map(run, tmp_path, words, told):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    for name in (LEDGER, CHANGES, GRAPH):
        (copy / name).unlink()
    answers = []
    for folder in (run, copy):
        code, out, _ = told("explain", folder, *words)
        assert code == 0
        lines = out.replace(str(folder), "RUN").splitlines()
        answers.append([line for line in lines if not line.startswith("solved in")])
    assert answers[0] == answers[1] != []


def test_a_gate_that_decides_nothing_is_warned_of(tmp_path, told):
    """Nothing is false, and the noise of all sightings is told twenty times too large."""
    bag = tmp_path / "drive.mcap"
    assert cli.main(["simulate", "manhattan", "--out", str(bag), "--poses", "60", "--set", "blocks=4"]) == 0
    for sigma_m, is_inert in ((0.05, False), (3.0, True)):
        run = tmp_path / f"run of {sigma_m}"
        replay(bag, run, Config.from_mapping({"landmarks.added_sigma_m": sigma_m}))
        assert ("warning: the gate of landmarks is inert" in explained(told, run)[1]) == is_inert


def test_another_explanation_is_warned_of_with_how_to_try_it(run, tmp_path, told):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    rival = {"cost": 120.0, "best_cost": 100.0, "only_here": [5, 6], "only_there": [7]}
    (copy / "run.json").write_text(json.dumps({"rivals": [rival]}))
    _, text, _ = explained(told, copy)
    assert f"this explanation costs 100, another 120: graph_slam explain {copy} --with 5 6 --without 7" in text
