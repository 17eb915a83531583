"""What-if and influence: the graph of a saved run solved otherwise is what a graph made otherwise is."""

import json

import numpy as np
import pytest
from faulty import faulty_run

from graph_slam_ros import cli
from graph_slam_ros.analysis import what_if
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.runs.ledger_file import read_ledger
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.report.contents import read_contents
from graph_slam_ros.tools.view.workbench import Workbench


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    return faulty_run(tmp_path_factory.mktemp("faulty"))


@pytest.fixture(scope="module")
def saved(replayed):
    return SavedGraph(replayed[1], [])


def told(capsys, *words):
    code = cli.main([*map(str, words)])
    out, err = capsys.readouterr()
    return code, out, err


def test_the_saved_graph_is_that_of_the_run_edge_by_edge(replayed, saved):
    """Those that are out as well; and it is at its optimum."""
    slam = replayed[2].slam
    assert saved.graph.edge_count == slam.graph.edge_count
    for edge in range(slam.graph.edge_count):
        (a, i), (b, k) = slam.graph.row(edge), saved.graph.row(edge)
        assert a.type is b.type
        assert a.measured.values[i] == pytest.approx(b.measured.values[k], abs=0.0)
        one, other = (root.T @ root for root in (a.sqrt_information.values[i], b.sqrt_information.values[k]))
        assert one == pytest.approx(other, rel=1e-9, abs=1e-9 * np.abs(one).max())
    moved = saved.moved(saved.solve())
    assert moved.most[1] < 1e-6
    summary = json.loads((replayed[1] / "run.json").read_text())
    assert moved.before.chi2_final == pytest.approx(summary["chi2"], rel=1e-6)


def test_what_is_taken_out_and_let_in_is_as_if_it_had_been_decided_so(replayed, saved):
    """The run's own solver, told the same weights, comes to the same poses."""
    slam, entries = replayed[2].slam, saved.entries
    closure = next(e.edge for e in entries if e.label == "closures" and e.is_in)
    solver = saved.solve(without=[closure])
    slam.solver.set_weight(closure, 0.0)
    slam.solver.optimize()
    assert solver.estimate(saved.keyframes) == pytest.approx(slam.trajectory(), abs=1e-5)
    slam.solver.set_weight(closure, 1.0)
    slam.solver.optimize()
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


def test_what_leaves_a_keyframe_without_edges_is_refused(replayed, saved, capsys):
    last = saved.keyframes[-1]
    for without in ([e.edge for e in saved.entries], [e.edge for e in saved.entries if last in e.vertices]):
        code, out, err = told(capsys, "explain", replayed[1], "--without", *without)
        assert (code, out, "nothing fixes the gauge of vertex" in err, err.count("\n")) == (2, "", True, 1)


def test_influence_tells_which_edges_cannot_be_done_without(tmp_path, capsys):
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
    code, out, err = told(capsys, "explain", run, "--influence")
    assert (code, out.count("undetermined"), err) == (0, 2, "")


def test_what_does_not_converge_is_no_solution_and_is_said(replayed, saved, capsys, monkeypatch):
    """Closures that all else contradicts, and few steps."""
    run, out = replayed[1], [e.edge for e in saved.entries if not e.is_in and e.label == "closures"]
    asked = json.dumps({"without": [], "let_in": out, "loss": "", "first": False}).encode()
    assert told(capsys, "explain", run, "--with", *out)[0] == 0
    assert Workbench(read_contents(run), 3.0).solve(asked)["is_solved"]
    monkeypatch.setattr(what_if, "MOST_STEPS", 1)  # then the run's own limit counts
    code, said, err = told(capsys, "explain", run, "--with", *out)
    assert (code, "NOT converged (max_iterations) after" in said, "not a solution" in err) == (3, True, True)
    assert not Workbench(read_contents(run), 3.0).solve(asked)["is_solved"]


def test_the_commands_say_what_moves(replayed, saved, capsys):
    run = replayed[1]
    false = next(e for e in read_ledger(run) if not e.is_in and e.label == "closures")
    code, out, _ = told(capsys, "explain", run, "--with", false.edge)
    moved = saved.moved(saved.solve(let_in=[false.edge]))
    assert code == 0
    assert f"{moved.before.chi2_final:.4f}  ->  " in out
    assert f"last pose  moves by {moved.final[0]:.4f} m" in out
    assert f"edge {moved.worse[0][0]} (" in out
    code, out, _ = told(capsys, "explain", run, "--influence", "3")
    assert code == 0
    *table, after = out.splitlines()
    assert [int(line.split()[0]) for line in table[2:]] == [one.edge for one in saved.influences(3)]
    assert after.startswith("next: graph_slam explain ")
    code, _, err = told(capsys, "explain", run, "3", "--loss", "none")
    assert (code, "one of EDGE, --influence, and --without, --with and --loss together" in err) == (2, True)
