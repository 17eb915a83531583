"""Faults: each makes wrong what it says and nothing else, and the table tells what."""

import csv

import numpy as np
import pytest
from scipy.stats import chi2

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.tools.simulation import (
    KINDS,
    MESSAGE_KINDS,
    Fault,
    city_graph,
    faulty_recording,
    options_of,
    simulate,
    with_closures,
)
from graph_slam_ros.tools.simulation.false_closures import disagreement, false_closures
from graph_slam_ros.tools.simulation.options import about
from graph_slam_ros.tools.simulation.recording import space_of

WORLDS = {"warehouse": {"aisles": 2, "laps": 2, "aisle_m": 8.0}, "flight": {"laps": 2}}


@pytest.fixture(scope="module", params=WORLDS)
def recording(request):
    return with_closures(simulate(request.param, 7, **WORLDS[request.param]), 30, seed=7)


PUT = {
    "false_closures": {"rate": 0.5, "policy": "group"},
    "wrong_ids": {"rate": 0.2},
    "swapped_ids": {"pairs": 2},
    "moved_landmarks": {"count": 2},
    "outliers": {"rate": 0.1},
    "slip": {"lasting": 0.1},
    "carried": {"distance_m": 3.0},
    "jump": {},
}


def sightings(recording):
    """(stamp, place in the message) to sighting."""
    return {(seen.stamp_ns, k): s for seen in recording.seen for k, s in enumerate(seen.sightings)}


def rows_of(wrong, topic):
    return {(row.stamp_ns, row.index): row for row in wrong if row.topic == topic}


def motions(recording):
    group, poses = space_of(recording.T_odom_base[0]).group, recording.T_odom_base
    return np.stack(group.between(tuple(poses[:-1].T), tuple(poses[1:].T)), axis=1)


def test_the_table_names_what_is_wrong_and_all_else_is_as_it_was(recording):
    """The same seed puts the same faults, and one more changes none of the others."""
    assert KINDS.keys() == PUT.keys()
    for kind, options in PUT.items():
        fault, jump = Fault.named(kind, **options), Fault.named("jump", at=0.1)
        faulty, wrong = faulty_recording(recording, [fault], seed=5)
        assert {row.fault for row in wrong} == {kind}
        before, after = sightings(recording), sightings(faulty)
        table = rows_of(wrong, "/landmarks")
        assert set(before) == set(after)
        assert {key for key in before if before[key] != after[key]} == set(table)
        for key, row in table.items():
            assert (row.id, row.true_id) == (after[key].id, before[key].id)
        moved = np.abs(motions(faulty) - motions(recording)).max(axis=1) > 1e-9
        assert set(recording.stamps_ns[1:][moved]) == {stamp_ns for stamp_ns, _ in rows_of(wrong, "/odom")}
        assert [c for c in faulty.closures if c in recording.closures] == list(recording.closures)
        false = [c for c in faulty.closures if c not in recording.closures]
        assert {(c.stamp_ns, str(c.from_stamp_ns)) for c in false} == {
            (row.stamp_ns, row.id) for row in wrong if row.topic == "/closures"
        }
        assert len(false) == (30 if kind == "false_closures" else 0)
        assert np.array_equal(faulty.T_world_base, recording.T_world_base)
        assert faulty.landmarks == recording.landmarks
        assert faulty_recording(recording, [fault], seed=5)[1] == wrong
        both = faulty_recording(recording, [fault, jump], seed=5)[1]
        assert [r for r in both if "jump" not in r.fault.split("+")] == [r for r in wrong if r.fault != "jump"]
        if kind not in ("slip", "carried", "jump"):  # which draw nothing
            assert faulty_recording(recording, [fault], seed=6)[1] != wrong


def test_a_fault_that_does_not_fit_is_refused_by_name():
    recording = simulate("warehouse", 1, aisles=2, laps=1, sensor="bearing")
    for fault, told in (
        ("fire", "no fault 'fire'; there are false_closures, wrong_ids"),
        ("slip:fast=2", "slip: no option 'fast'; it has at, lasting, factor"),
        ("slip:at=1.5", r"slip: at: 1.5 is not in \[0, 1\]"),
        ("slip:at", "'at' is not key=value"),
        ("slip:at=0.1,factor=2,at=0.2", "slip: at is given twice"),
        ("slip:at=1.0", "nothing is driven any more"),
        ("carried:at=0.9,distance_m=1000", "carried: after 0.9 of the whole it comes no farther than"),
        ("swapped_ids:at=0.0", r"swapped_ids: needs 2 landmarks that are seen often enough; there are 0"),
        ("false_closures", "there is no true one to be like"),
        ("false_closures:policy=odd", "'odd' is not one of random, local"),
        ("outliers", "a bearing has no range"),
    ):
        with pytest.raises(GraphSlamError, match=told):
            faulty_recording(recording, [Fault.parsed(fault)], seed=1)


def test_in_a_graph_the_table_names_the_lines_that_are_more_and_no_others(tmp_path, told):
    clean, faulty = tmp_path / "clean.g2o", tmp_path / "faulty.g2o"
    assert told("simulate", "city", "--poses", 800, "--set", "blocks=8", "--out", clean)[0] == 0
    assert (tmp_path / "clean.truth.tum").is_file()
    faults = "--fault", "false_closures:policy=aliased", "--fault", "false_closures:count=7"
    code, out, err = told("simulate", clean, "--out", faulty, "--seed", 3, *faults)
    assert (code, err) == (0, "")
    with (tmp_path / "faulty.faults.csv").open() as stream:
        table = {int(row["line"]): row for row in csv.DictReader(stream)}
    assert f"{len(table)} edges are wrong" in out
    true, lines = read_g2o(clean).graph.edge_count, faulty.read_text().splitlines()
    closures = true - 799
    assert len(table) == round(closures * 0.3 / 0.7) + 7
    left = [line.split()[:3] for n, line in enumerate(lines, 1) if n not in table and line[0] != "#"]
    assert left == [line.split()[:3] for line in clean.read_text().splitlines() if line[0] != "#"]
    for n, row in table.items():
        assert lines[n - 1].split()[:3] == [row["tag"], row["first"], row["second"]]
    assert read_g2o(faulty).graph.edge_count == true + len(table)


def test_a_recording_with_faults_has_their_table_beside_it(tmp_path, told):
    bag, table = tmp_path / "a.world.mcap", tmp_path / "a.world.faults.csv"
    hall = "simulate", "warehouse", "--set", "aisles=2", "--set", "aisle_m=6", "--out", bag
    faults = "--fault", "false_closures:rate=0.5,group=5", "--fault", "swapped_ids:at=0.6"
    code, out, err = told(*hall, "--closures", 10, *faults)
    assert (code, err) == (0, "")
    with table.open() as stream:
        rows = list(csv.DictReader(stream))
    assert f"wrote {table}: {len(rows)} measurements are wrong" in out
    assert list(rows[0]) == ["topic", "stamp_ns", "index", "id", "fault", "true_id"]
    assert [row["fault"] for row in rows].count("false_closures") == 10
    assert open_bag(bag).topics["/closures"].count > 10
    table.unlink()
    assert told(*hall, "--force")[0] == 0
    assert not table.exists()
    assert "/closures" not in open_bag(bag).topics


def test_a_command_that_cannot_be_done_is_refused_in_one_line(tmp_path, told):
    graph, out = tmp_path / "city.g2o", tmp_path / "out"
    assert told("simulate", "city", "--poses", 60, "--set", "blocks=3", "--out", graph)[0] == 0
    for words, says in (
        (["city", "--out", f"{out}.mcap"], "city is a graph: --out FILE.g2o"),
        (["manhattan", "--out", f"{out}.g2o"], "manhattan is a recording: --out FILE.mcap"),
        (["city", "--closures", "5", "--out", f"{out}.g2o"], "city: no use for --closures"),
        (["city", "--seed", "-1", "--out", f"{out}.g2o"], "seed -1 is negative"),
        (["sphere", "--set", "laps=5", "--out", f"{out}.g2o"], "sphere: no option 'laps'; it has poses, sigma_m"),
        (["spere", "--out", f"{out}.g2o"], "did you mean 'sphere'"),
        ([graph, "--set", "blocks=4", "--out", f"{out}.g2o"], "no use for --set: it is no world"),
        ([graph, "--out", graph], "cannot be read from and written to at once"),
        ([graph, "--fault", "slip", "--out", f"{out}.g2o"], "slip: a graph has no messages"),
        (["none.g2o", "--out", f"{out}.g2o"], "no world 'none.g2o'"),
    ):
        code, _, err = told("simulate", *words)
        assert (code, err.count("\n")) == (2, 1), words
        assert says in err
    said = told("simulate", "sphere", "--poses", 40, "--out", tmp_path / "s.g2o")[1]
    assert "sphere: with 40 poses nothing is closed: a larger --poses" in said


def test_the_help_tells_every_fault_and_all_that_can_be_set(told):
    out = told("simulate", "--help")[1]
    assert "gnss_outage_s=0.0 [s]" in out and "aisle_m=12.0 [m]" in out
    for name, kind in (KINDS | MESSAGE_KINDS).items():
        assert f"  {name}: {about(kind)}" in out
        assert all(f"    {key}=" in out for key in options_of(kind))


@pytest.mark.parametrize("world", ["city", "flight"])
def test_what_agrees_with_the_truth_is_no_false_closure(world):
    """In a small world: what is drawn anywhere is true now and then."""
    if world == "city":
        truth, root, dof = city_graph(seed=3, poses=1000, blocks=3)[1], np.diag([20.0, 20.0, 100.0]), 3
    else:
        flown = simulate("flight", 3, laps=3).T_world_base
        truth, root, dof = flown[:: len(flown) // 1000], np.diag([20.0] * 3 + [100.0] * 3), 6
    for policy in ("random", "local", "group", "aliased"):
        vague = root / (4.0 if policy == "local" else 10.0)

        def off(margin, policy=policy, vague=vague):
            rng = np.random.default_rng(1)
            ends, measured, _ = false_closures(truth, vague[None], rng, policy, count=300, margin=margin)
            return disagreement(truth, ends, measured, vague)

        assert off(4.0).min() > 4.0 * chi2.ppf(0.9999, dof)
        assert (off(0.0) < 4.0 * chi2.ppf(0.9999, dof)).any(), "or the test shows nothing"
