"""The command ``graph_slam optimize``: answers, files, exit codes, and one line where it refuses."""

import json
import shlex

import pytest
from places import ROOT
from rows import each

from graph_slam_ros.cli import main

DATA = ROOT / "data"
CITY = DATA / "city.g2o"
SMALL = """\
VERTEX_SE2 3 0.5 0 0
VERTEX_SE2 4 1.2 0.3 0.1
VERTEX_SE2 5 2.5 0 0
VERTEX_XY 9 2 2
EDGE_SE2 3 4 1 0 0 4 0 0 4 0 4
EDGE_SE2 4 5 1 0 0 4 0 0 4 0 4
EDGE_SE2 3 5 2.1 0 0 4 0 0 4 0 4
EDGE_SE2_XY 3 9 1.5 2 9 0 9
EDGE_SE2_XY 5 9 -.5 2 9 0 9
"""
KEYS = {"chi2_initial", "chi2_final", "cost_initial", "cost_final", "iterations", "converged", "stop", "method", "loss"}
KEYS |= {"start", "starts", "suspicion", "error_map", "classes", "degrees_of_freedom", "doubt", "let_go", "losses"}
KEYS |= {"notes", "worst"}


@pytest.fixture
def graph(tmp_path):
    path = tmp_path / "small.g2o"
    path.write_text(SMALL)
    return path


@pytest.fixture
def run(capsys):
    def run(*words):
        code = main(["optimize", *map(str, words)])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def answer_of(run, *words, due=0):
    code, out, err = run(*words, "--json")
    assert (code, bool(err)) == (due, bool(due))
    assert len(out.splitlines()) == 1
    return json.loads(out)


def test_the_answer_has_the_promised_keys_and_adds_up(run, graph):
    answer = answer_of(run, graph)
    assert set(answer) == KEYS
    assert {name: set(part) for name, part in answer["classes"].items()} == {
        "odometry": {"edges", "chi2"},
        "closures": {"edges", "chi2"},
        "landmarks": {"edges", "chi2"},
    }
    assert [answer["classes"][k]["edges"] for k in ("odometry", "closures", "landmarks")] == [2, 1, 2]
    assert sum(part["chi2"] for part in answer["classes"].values()) == pytest.approx(answer["chi2_final"], rel=1e-12)
    assert (answer["converged"], answer["error_map"], type(answer["iterations"])) == (True, "relative", int)
    assert 0 < answer["chi2_final"] < answer["chi2_initial"]


@each("method", ["gn", "lm"])
@each("error_map", ["relative", "seed"])
def test_the_city_comes_to_the_value_that_its_readme_states(run, method, error_map):
    answer = answer_of(run, CITY, "--method", method, "--error-map", error_map)
    assert answer["chi2_final"] == pytest.approx(465.969818, rel=1e-6)  # the tolerance of convergence
    assert (answer["method"], answer["error_map"]) == (method, error_map)


def test_what_is_written_is_the_optimum_again(run, tmp_path, graph):
    for source in (graph, CITY):
        out = tmp_path / "out.g2o"
        first = answer_of(run, source, "--out", out, "--force")
        again = answer_of(run, out)
        assert again["chi2_initial"] == pytest.approx(first["chi2_final"], rel=1e-9)
        assert again["classes"].keys() == first["classes"].keys()
        assert answer_of(run, source)["chi2_initial"] == first["chi2_initial"]  # the source is as it was


def test_a_trajectory_has_the_poses_in_order_of_id_with_the_id_as_stamp(run, tmp_path, graph):
    out = tmp_path / "poses.tum"
    graph.write_text("VERTEX_SE2 30 5 6 -1\n" + SMALL + "EDGE_SE2 5 30 0 0 0 1 0 0 1 0 1\nFIX 3\n")
    code, text, err = run(graph, "--out", out)
    assert (code, err) == (0, "")
    assert text.splitlines()[-1].startswith(f"next: evo_traj tum {out}")
    rows = [[float(v) for v in line.split()] for line in out.read_text().splitlines()]
    assert [row[0] for row in rows] == [3, 4, 5, 30]
    assert rows[0][1:] == [0.5, 0, 0, 0, 0, 0, 1]


def test_the_first_pose_is_held_where_nothing_else_fixes_the_graph(run, tmp_path, graph):
    out = tmp_path / "out.g2o"
    run(graph, "--out", out, "--force")
    assert out.read_text().splitlines()[0].split() == ["VERTEX_SE2", "3", "0.5", "0.0", "0.0"]
    graph.write_text(SMALL + "FIX 5\n")
    run(graph, "--out", out, "--force")
    lines = [line.split() for line in out.read_text().splitlines()]
    assert ["VERTEX_SE2", "5", "2.5", "0.0", "0.0"] in lines
    assert ["FIX", "5"] in lines
    assert lines[0] != ["VERTEX_SE2", "3", "0.5", "0.0", "0.0"]
    graph.write_text(SMALL + "EDGE_PRIOR_SE2 4 7 8 0.5 1 0 0 1 0 1\n")
    run(graph, "--out", out, "--force")
    moved = [float(x) for x in out.read_text().splitlines()[1].split()[2:]]
    assert moved == pytest.approx([7.0, 8.0, 0.5], abs=1e-3)


def test_the_text_shows_every_step_and_the_classes(run, graph):
    code, out, err = run(graph)
    answer = answer_of(run, graph)
    assert (code, err) == (0, "")
    steps = [line for line in out.splitlines() if "largest step" in line]
    assert len(steps) == answer["iterations"]
    assert f"{answer['chi2_final']:.6f}" in steps[-1]
    assert f"converged ({answer['stop']}), method gn" in out
    for name, part in answer["classes"].items():
        assert any(name in line and f"{part['chi2']:.6f}" in line for line in out.splitlines())


@pytest.fixture
def city_with_false_closures(tmp_path):
    path = tmp_path / "false.g2o"
    false = [f"EDGE_SE2 {i} {i + 200} 1 2 0.5 44 0 0 44 0 44\n" for i in range(10, 60, 10)]
    path.write_text(CITY.read_text() + "# class closures\n" + "".join(false))
    return path


@each("loss", ["huber", "cauchy", "huber:0.5", "cauchy:2.5"])
def test_a_robust_loss_lets_false_closures_pull_less(run, city_with_false_closures, loss):
    plain = answer_of(run, city_with_false_closures, "--init", "tree", due=3)
    robust = answer_of(run, city_with_false_closures, "--init", "tree", "--loss", loss)
    assert (plain["loss"], robust["loss"]) == ("none", loss if ":" in loss else f"{loss}:3")
    assert plain["classes"]["odometry"]["chi2"] > 2000.0
    assert robust["classes"]["odometry"]["chi2"] < 0.5 * plain["classes"]["odometry"]["chi2"]
    assert robust["cost_final"] < robust["chi2_final"]
    if loss.startswith("cauchy"):  # which forgets what is far away
        truth = answer_of(run, CITY)["classes"]["odometry"]["chi2"]
        assert robust["classes"]["odometry"]["chi2"] == pytest.approx(truth, rel=0.05)


def test_the_loss_is_of_every_class_but_odometry(run, graph):
    graph.write_text(SMALL.replace("3 5 2.1", "3 5 9.1").replace("9 1.5 2", "9 7.5 2"))
    answer = answer_of(run, graph, "--loss", "huber:1e-9", due=3)  # of such a scale, next to nothing is left of them
    assert answer["classes"]["odometry"]["chi2"] == pytest.approx(0.0, abs=1e-6)
    assert answer["classes"]["closures"]["chi2"] > 100.0
    assert answer["classes"]["landmarks"]["chi2"] > 100.0
    graph.write_text("\n".join(SMALL.splitlines()[:3] + SMALL.splitlines()[4:6]) + "\n")  # odometry alone
    answer = answer_of(run, graph, "--loss", "huber:1e-9")
    assert answer["cost_initial"] == answer["chi2_initial"] > 1.0


def test_what_comes_next_repeats_the_options(run, graph, tmp_path):
    options = ["--method", "lm", "--loss", "cauchy:2", "--init", "tree", "--from", "g2o", "--max-iterations", "60"]
    options += ["--tolerance", "1e-07", "--error-map", "seed", "--information", "raw", "--lenient"]
    after = run(graph, *options)[1].splitlines()[-1].removeprefix("next: ").partition(" (")[0]
    assert after == shlex.join(["graph_slam", "optimize", str(graph), *options, "--out", "SOLVED.g2o"])
    bare = run(graph)[1].splitlines()[-1]
    assert bare.startswith(f"next: {shlex.join(['graph_slam', 'optimize', str(graph), '--out', 'SOLVED.g2o'])} (")
    for init, other in (("file", "chordal"), ("chordal", "online")):
        after = run(graph, "--init", init, "--max-iterations", "1", "--tolerance", "1e-15")[1].splitlines()[-1]
        words = shlex.split(after.removeprefix("next: ").partition(" (")[0])
        assert words[3:] == ["--init", other, "--max-iterations", "1", "--tolerance", "1e-15"], after


def test_a_graph_of_edges_alone_is_solved_from_its_tree_and_says_so(run, tmp_path, graph):
    whole = answer_of(run, graph)
    graph.write_text("".join(line + "\n" for line in SMALL.splitlines() if line.startswith("EDGE")))
    out = tmp_path / "out.g2o"
    code, text, err = run(graph, "--out", out)
    assert (code, err) == (0, "")
    assert text.splitlines()[0].endswith("   from the spanning tree: the file has no vertex lines")
    answer = answer_of(run, graph)
    assert answer["start"] == "tree"
    assert answer["chi2_final"] == pytest.approx(whole["chi2_final"], rel=1e-6)
    assert answer_of(run, out)["start"] == "file"
    assert answer_of(run, graph, "--init", "chordal")["start"] == "chordal"


def test_the_picture_shows_the_start_that_was_used(run, tmp_path, graph, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "graph_slam_ros.analysis.plots.draw_graph", lambda out, initial, final, *_: drawn.append((initial, final))
    )
    graph.write_text("".join(line + "\n" for line in SMALL.splitlines() if line.startswith("EDGE")))
    assert run(graph, "--plot", tmp_path / "graph.png")[0] == 0
    ((initial, final),) = drawn
    assert initial.tolist() == [[0, 0], [1, 0], [2.1, 0], [1.5, 2]]  # along the tree, not where no line puts them
    assert abs(final - initial).max() > 1e-3


def test_lenient_reading_ends_with_3_and_lists_what_was_lost(run, graph):
    graph.write_text(SMALL + "VERTEX_SE2 6 nan 0 0\nEDGE_SE2 5 6 1 0 0 4 0 0 4 0 4\n")
    assert run(graph)[0] == 2
    code, out, err = run(graph, "--lenient", "--json")
    assert code == 3
    assert [line.split(": ")[:3] for line in err.splitlines()] == [
        ["graph_slam", "lost", "small.g2o:10"],
        ["graph_slam", "lost", "small.g2o:11"],
    ]
    graph.write_text(SMALL)
    assert json.loads(out) | {"losses": []} == answer_of(run, graph)


BROKEN = {
    "malformed": ("VERTEX_SE2 1 2\n", "small.g2o:10"),
    "missing vertex": ("EDGE_SE2 3 77 1 0 0 4 0 0 4 0 4\n", "vertex 77"),
    "no gauge": ("VERTEX_SE2 6 0 0 0\n", "gauge of vertex 6"),
    "undetermined": ("VERTEX_SE2 6 0 0 0\nEDGE_SE2_XY 6 9 1 1 1 0 1\n", "do not determine vertex"),
    "overflow": ("VERTEX_SE2 6 1e200 0 0\nEDGE_SE2 5 6 1 0 0 4 0 0 4 0 4\n", r"not finite"),
}


@each("fault", BROKEN)
def test_a_refusal_is_one_line_that_names_the_culprit_and_exit_code_2(run, graph, fault):
    more, culprit = BROKEN[fault]
    graph.write_text(SMALL + more)
    out = graph.with_name("out.g2o")
    code, stdout, err = run(graph, "--out", out)
    assert (code, stdout) == (2, "")
    assert err.startswith("graph_slam: ")
    assert (err.count("\n"), culprit in err) == (1, True)
    assert not out.exists()


def test_files_that_cannot_be_read_or_written_are_refusals(run, tmp_path, graph):
    nowhere = tmp_path / "no" / "where"
    for words in (
        [nowhere],
        [tmp_path],
        [tmp_path / ("x" * 4096)],
        [graph, "--out", nowhere],
        [graph, "--out", tmp_path],
        [graph, "--plot", nowhere / "a.png"],
        [graph, "--plot", tmp_path / "a.nonsense"],
    ):
        code, _, err = run(*words)
        assert code == 2, err
        assert err.startswith("graph_slam: ")
        assert err.count("\n") == 1
        assert str(words[-1])[:60] in err


@each(
    "words",
    [
        ["--method", "newton"],
        ["--max-iterations", "0"],
        ["--max-iterations", "\u00b2"],
        ["--tolerance", "nan"],
        ["--loss", "tukey"],
        ["--loss", "none:1"],
        ["--loss", "huber:0"],
        ["--loss", "cauchy:-1"],
        ["--loss", "cauchy:inf"],
        ["--loss", "huber:1:2"],
        ["--what"],
    ],
)
def test_options_that_cannot_be_are_refused_in_one_line(graph, words, capsys):
    with pytest.raises(SystemExit) as refusal:
        main(["optimize", str(graph), *words])
    assert refusal.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert words[0] in err
    assert " _" not in err  # no name of a function
