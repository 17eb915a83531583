"""``graph_slam explain``: whoever reads it learns why, in numbers that are those of the run."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from faulty import faulty_run
from rows import each

from graph_slam_ros import cli
from graph_slam_ros.analysis import measurement_text
from graph_slam_ros.analysis.explain import explain_edge
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.edge_tags import EDGE_TAGS
from graph_slam_ros.runs.folder import GRAPH
from graph_slam_ros.runs.ledger_file import CHANGES, LEDGER, Entry, read_ledger
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.slam.robust.ledger import Reason, Verdict


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return faulty_run(tmp_path_factory.mktemp("faulty"))[1]


def told(capsys, *words):
    code = cli.main(["explain", *map(str, words)])
    out, err = capsys.readouterr()
    return code, " ".join(out.split()), err


def copied(run, to):
    return Path(shutil.copytree(run, to / "run"))


def first(run, **wanted):
    return next(e for e in read_ledger(run) if all(getattr(e, k) == v for k, v in wanted.items()))


def test_the_summary_counts_what_the_ledger_has(run, capsys):
    code, out, err = told(capsys, run)
    entries = read_ledger(run)
    assert (code, err) == (0, "")
    assert f"{len(entries)} edges; {sum(e.verdict > 0 for e in entries)} are measurements that can be rejected" in out
    in_and_out = [sum(e.label == "closures" and e.is_in is which for e in entries) for which in (True, False)]
    assert re.search(rf"closures {in_and_out[0]} {in_and_out[1]}\b", out)
    worst = max((e for e in entries if not e.is_in), key=lambda e: e.statistic / e.threshold)
    assert f"edge {worst.edge}" in out
    assert "inert" not in out


def test_a_stranger_learns_why_a_closure_was_rejected(run, capsys):
    false = first(run, label="closures", verdict=Verdict.PENDING)
    _, out, _ = told(capsys, run, false.edge)
    assert f"edge {false.edge}: a loop closure by closures: held back: unlikely" in out
    assert f"keyframe {false.vertices[0]} and keyframe {false.vertices[1]}" in out
    assert f"chi2 {false.statistic:.4g} with 3 degrees of freedom" in out
    assert f"up to {false.threshold:.4g} would have passed (noise alone exceeds 21.11 once in 10000 times" in out
    assert re.search(r"what if it were in with its full weight: chi2 \+\d", out)
    strained = [int(edge) for edge in re.findall(r"against edge (\d+)", out)]
    assert strained
    assert all(read_ledger(run)[edge].is_in for edge in strained)


def test_what_was_expected_is_what_the_map_says(run):
    """Of a false closure: the relative pose of the two keyframes, as far as the map is right."""
    false = first(run, label="closures", verdict=Verdict.PENDING)
    rows = np.loadtxt(run / "path.tum")
    a, b = (rows[vertex] for vertex in false.vertices)
    heading = 2.0 * np.arctan2(a[6], a[7])
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    assert measurement_text.expected(false)[:2] == pytest.approx(turn @ (b[1:3] - a[1:3]), abs=0.5)


def test_a_landmark_is_explained_by_name_and_an_unknown_one_is_refused(run, capsys):
    wrong = next(e for e in read_ledger(run) if e.landmark and not e.is_in)
    _, out, _ = told(capsys, run, wrong.landmark)
    assert f"landmark {wrong.landmark}:" in out
    assert f"edge {wrong.edge}" in out
    code, _, err = told(capsys, run, "landmark:7")
    assert code == 2
    assert "7: neither the id of an edge nor a landmark; there are 0/0" in err
    code, _, err = told(capsys, run, "99999")
    assert (code, "no edge 99999: their ids are below" in err) == (2, True)


def test_each_verdict_is_explained_in_its_words(run):
    saved = SavedGraph(run, [])
    entry = next(e for e in saved.entries if (e.label, e.verdict) == ("closures", Verdict.ACCEPTED))
    for verdict, reason, words in (
        (Verdict.REJECTED, Reason.DOES_NOT_FIT, "after a solve with it, it had chi2"),
        (Verdict.REJECTED, Reason.OUTVOTED, "in the solution of least cost of the whole graph it has chi2"),
        (Verdict.REJECTED, Reason.WITHDRAWN, "withdrawn is final"),
        (Verdict.DOWN_WEIGHTED, Reason.NONE, "it is accepted, but its loss leaves it little weight"),
    ):
        saved.entries[entry.edge] = dataclasses.replace(entry, verdict=verdict, reason=reason)
        assert words in " ".join(" ".join(explain_edge(saved, str(entry.edge))).split())


@each("words", [(), (3,), ("--without", 3), ("--influence",)])
def test_a_run_that_was_never_saved_is_explained_from_its_map(run, tmp_path, words, capsys):
    copy = copied(run, tmp_path)
    for name in (LEDGER, CHANGES, GRAPH):
        (copy / name).unlink()
    answers = []
    for folder in (run, copy):
        assert cli.main(["explain", str(folder), *map(str, words)]) == 0
        lines = capsys.readouterr().out.replace(str(folder), "RUN").splitlines()
        answers.append([line for line in lines if not line.startswith("solved in")])
    assert answers[0] == answers[1] != []


def test_a_gate_that_decides_nothing_is_warned_of(tmp_path, capsys):
    """Nothing is false, and the noise of all sightings is told twenty times too large."""
    bag = tmp_path / "drive.mcap"
    assert cli.main(["simulate", "manhattan", "--out", str(bag), "--poses", "60", "--set", "blocks=4"]) == 0
    for sigma_m, is_inert in ((0.05, False), (3.0, True)):
        run = tmp_path / f"run of {sigma_m}"
        replay(bag, run, Config.from_mapping({"landmarks.added_sigma_m": sigma_m}))
        assert ("warning: the gate of landmarks is inert" in told(capsys, run)[1]) == is_inert


def test_another_explanation_is_warned_of_with_how_to_try_it(run, tmp_path, capsys):
    copy = copied(run, tmp_path)
    rival = {"cost": 120.0, "best_cost": 100.0, "only_here": [5, 6], "only_there": [7]}
    (copy / "run.json").write_text(json.dumps({"rivals": [rival]}))
    _, text, _ = told(capsys, copy)
    assert f"this explanation costs 100, another 120: graph_slam explain {copy} --with 5 6 --without 7" in text


@each("tag", EDGE_TAGS)
def test_every_type_of_edge_can_be_told(tag):
    edge = EDGE_TAGS[tag]
    m, sizes = edge.residual_size, edge.measured_size
    measured = np.zeros(sizes)
    if m == 6 or "attitude" in edge.name:
        measured[-1] = 1.0
    information = np.eye(m)[np.triu_indices(m)]
    entry = dataclasses.replace(_ENTRY, tag=tag, measured=tuple(measured), information=tuple(information), dof=m)
    entry = dataclasses.replace(entry, residual=tuple(np.full(m, 0.25)))
    assert measurement_text.expected(entry) == pytest.approx([0.25] * m)
    assert len(measurement_text.with_units(entry, measurement_text.sigmas(entry)).split(", ")) == m


_ENTRY = Entry(0, "", "", "", "", (0,), 0, 0, (), (), (), 0.0, 0, 1.0, 0.0, 1.0, Verdict.ACCEPTED, Reason.NONE)
