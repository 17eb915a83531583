"""The command ``graph_slam optimize``: answers, files, exit codes, and one line where it refuses."""

import json
import re
import shlex

import pytest
from places import ROOT
from rows import each

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
def run(told):
    return lambda *words: told("optimize", *words)


def answer_of(run, *words, due=0):
    code, out, err = run(*words, "--json")
    assert (code, bool(err)) == (due, bool(due))
    assert len(out.splitlines()) == 1
    return json.loads(out)


def test_the_answer_has_the_promised_keys_and_adds_up_and_the_text_has_them(run, graph):
    answer = answer_of(run, graph)
    assert set(answer) == KEYS
    edges = {name: part["edges"] for name, part in answer["classes"].items()}
    assert edges == {"odometry": 2, "closures": 1, "landmarks": 2}
    assert all(set(part) == {"edges", "chi2"} for part in answer["classes"].values())
    assert sum(part["chi2"] for part in answer["classes"].values()) == pytest.approx(answer["chi2_final"], rel=1e-12)
    assert (answer["converged"], answer["error_map"], type(answer["iterations"])) == (True, "relative", int)
    assert 0 < answer["chi2_final"] < answer["chi2_initial"]
    code, out, err = run(graph)
    assert (code, err) == (0, "")
    steps = [line for line in out.splitlines() if "largest step" in line]
    assert len(steps) == answer["iterations"]
    assert f"{answer['chi2_final']:.6f}" in steps[-1]
    assert f"converged ({answer['stop']}), method gn" in out
    for name, part in answer["classes"].items():
        assert any(name in line and f"{part['chi2']:.6f}" in line for line in out.splitlines())


@each("method, loss", [("gn", "none"), ("lm", "none"), ("gn", "cauchy:2.5"), ("gn", "huber")])
def test_the_city_comes_to_the_value_that_its_readme_states_and_a_loss_is_told(run, method, loss):
    answer = answer_of(run, CITY, "--method", method, "--loss", loss, "--error-map", "seed")
    assert (answer["method"], answer["error_map"]) == (method, "seed")
    assert answer["loss"] == (loss if ":" in loss or loss == "none" else f"{loss}:3")
    if loss == "none":
        assert answer["chi2_final"] == pytest.approx(465.969818, rel=1e-6)  # the tolerance of convergence
    else:
        assert answer["cost_final"] < answer["chi2_final"]


def test_what_is_written_is_the_optimum_again_with_the_first_pose_held(run, tmp_path, graph):
    for source in (graph, CITY):
        out = tmp_path / "out.g2o"
        first = answer_of(run, source, "--out", out, "--force")
        again = answer_of(run, out)
        assert again["chi2_initial"] == pytest.approx(first["chi2_final"], rel=1e-9)
        assert again["classes"].keys() == first["classes"].keys()
        assert answer_of(run, source)["chi2_initial"] == first["chi2_initial"]  # the source is as it was
    first, last = "VERTEX_SE2 3 0.5 0.0 0.0", "VERTEX_SE2 5 2.5 0.0 0.0"
    for more, init, held in (("", "auto", first), ("FIX 5\n", "auto", last), ("FIX 3 5\n", "chordal", last)):
        graph.write_text(SMALL + more)
        run(graph, "--init", init, "--out", out, "--force")
        assert held in (lines := [" ".join(line.split()) for line in out.read_text().splitlines()])
        assert ("FIX 5" in lines, lines[0] == first) == (bool(more), more != "FIX 5\n")


def test_a_trajectory_has_the_poses_in_order_of_id_with_the_id_as_stamp(run, tmp_path, graph):
    out = tmp_path / "poses.tum"
    graph.write_text("VERTEX_SE2 30 5 6 -1\n" + SMALL + "EDGE_SE2 5 30 0 0 0 1 0 0 1 0 1\nFIX 3\n")
    code, text, err = run(graph, "--out", out)
    assert (code, err) == (0, "")
    assert text.splitlines()[-1].startswith(f"next: evo_traj tum {out}")
    rows = [[float(v) for v in line.split()] for line in out.read_text().splitlines()]
    assert [row[0] for row in rows] == [3, 4, 5, 30]
    assert rows[0][1:] == [0.5, 0, 0, 0, 0, 0, 1]


def test_what_comes_next_repeats_the_options(run, graph, tmp_path):
    options = ["--method", "lm", "--loss", "cauchy:2", "--init", "tree", "--from", "g2o", "--max-iterations", "60"]
    options += ["--tolerance", "1e-07", "--error-map", "seed", "--information", "raw", "--lenient"]
    after = run(graph, *options)[1].splitlines()[-1].removeprefix("next: ").partition(" (")[0]
    assert after == shlex.join(["graph_slam", "optimize", str(graph), *options, "--out", "SOLVED.g2o"])
    after = (
        run(graph, *options, "--out", tmp_path / "a.g2o")[1].splitlines()[-1].removeprefix("next: ").partition(" (")[0]
    )
    assert after == shlex.join(["graph_slam", "optimize", str(graph), *options, "--out", "POSES.tum"])
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


BROKEN = {
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
    nowhere = tmp_path / "no" / "where.g2o"
    for words in ([tmp_path], [tmp_path / ("x" * 4096)], [graph, "--out", nowhere], [graph, "--out", tmp_path],
                  [graph, "--plot", nowhere / "a.png"], [graph, "--plot", tmp_path / "a.nonsense"]):  # fmt: skip
        code, _, err = run(*words)
        assert (code, err.count("\n")) == (2, 1), err
        assert err.startswith("graph_slam: ") and str(words[-1])[:60] in err


OPTIONS = "method newton,max-iterations 0,max-iterations \u00b2,tolerance nan,loss tukey,loss none:1,loss huber:0,"
OPTIONS += "loss cauchy:-1,loss cauchy:inf,loss huber:1:2,what"


@each("options", OPTIONS.split(","))
def test_options_that_cannot_be_are_refused_in_one_line(run, graph, options):
    words = f"--{options}".split()
    code, _, err = run(graph, *words)
    assert (code, err.count("\n")) == (2, 1)
    assert words[0] in err
    assert " _" not in err  # no name of a function


def test_a_graph_as_a_run_judges_its_closures_and_is_reported_explained_and_edited(run, graph, tmp_path, told):
    folder, plan, edited = (tmp_path / name for name in ("a/of_graph", "plan.json", "edited"))
    more = "VERTEX_XY 10 0 2\nEDGE_SE2_XY 5 10 -2.5 2 9 0 9\nEDGE_SE2 3 5 -70 3 2 4 0 0 4 0 4\nFIX 3 10\n"
    graph.write_text(SMALL + more)
    code, out, err = run(graph, "--init", "file", "--out", folder)
    assert (code, err.count("\n")) == (3, 1)
    assert f"results in {folder}: 1 of 5 measurements are not in the map" in out
    assert out.splitlines()[-1].startswith(f"next: graph_slam report {folder} (")
    assert [pose.split()[0] for pose in (folder / "path.tum").open()] == [f"{k}.000000000" for k in (3, 4, 5)]
    assert "1 of closures" in told("report", folder)[1] and told("view", folder, "--port", "x")[0] == 2
    (edge,) = re.findall(r"edge (\d+) +closures.* held back", told("explain", folder)[1])
    assert told("map", "edit", folder, "--new-plan", plan)[0] == 0
    wrong = {"name": "wrong", "who": "A", "when": "2026-05-04T10:30:00Z", "why": "it is", "do": "remove_edge"}
    plan.write_text(json.dumps(json.loads(plan.read_text()) | {"edits": [wrong | {"edge": int(edge)}]}))
    assert told("map", "edit", folder, "--plan", plan, "--out", edited)[0] == 0
    assert "rejected: by hand" in told("explain", edited, edge)[1]
    assert run(edited / "graph.g2o")[0] == 0, "without it nothing is in doubt"


def test_what_is_no_run_is_refused_in_one_line(run, graph, tmp_path, told):
    (other := tmp_path / "other").mkdir()
    (other / "mine").touch()
    (alone := tmp_path / "alone.g2o").write_text("\n".join(SMALL.splitlines()[:3] + SMALL.splitlines()[4:6]))
    (offset := tmp_path / "offset.g2o").write_text(f"{SMALL}VERTEX_OFFSET 20 0.1\nEDGE_PRIOR_OFFSET 20 0.1 9\n")
    assert run(graph, "--out", tmp_path / "again")[0] == 0
    wrong = {
        "holds a run already": (graph, "again"),
        "not empty and not an earlier run": (graph, "other"),
        "a run folder; its graph is": (tmp_path / "again", "new"),
        "odometry alone": (alone, "new"),
        "vertices of R1": (offset, "new"),
    }
    for words, (file, out) in wrong.items():
        code, _, err = run(file, "--out", tmp_path / out)
        assert (code, len(err.splitlines()), words in err) == (2, 1, True), err
    assert not (tmp_path / "new").exists() and list(other.iterdir()) == [other / "mine"]
    assert "graph_slam optimize of a graph" in told("report", graph)[2]
