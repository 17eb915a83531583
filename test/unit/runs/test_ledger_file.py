"""The ledger of a saved run: what it says is what was decided, and what was put wrong is told."""

import csv
import random

import numpy as np
import pytest
from faulty import CONFIG, faulty_run

from graph_slam_ros.errors import FormatError
from graph_slam_ros.measurements.types import from_record
from graph_slam_ros.node.events import of_update
from graph_slam_ros.runs.journal import read_ingest
from graph_slam_ros.runs.ledger_file import CHANGES, LEDGER, read_ledger
from graph_slam_ros.slam import GraphSlam, Update
from graph_slam_ros.slam.robust.ledger import Reason, Verdict, VerdictChange


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    return faulty_run(tmp_path_factory.mktemp("faulty"))


def written_changes(folder):
    with (folder / CHANGES).open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    member = {"verdict": Verdict, "reason": Reason}
    number = {"statistic": float, "threshold": float}
    return [
        VerdictChange(**{k: member[k][v.upper()] if k in member else number.get(k, int)(v) for k, v in row.items()})
        for row in rows
    ]


def test_what_is_wrong_and_nothing_else_is_out_and_who_told_it_is_named(replayed):
    wrong, folder, _ = replayed
    out = [entry for entry in read_ledger(folder) if entry.weight == 0.0]
    assert {entry.verdict for entry in out} <= {Verdict.PENDING, Verdict.REJECTED}
    told = [("closures", "")] * sum(row["fault"] == "false_closures" for row in wrong)
    told += [("detections", row["id"]) for row in wrong if row["fault"] == "wrong_ids"]
    assert sorted((entry.source, entry.landmark) for entry in out) == sorted(told)


def test_what_is_read_is_what_was_decided(replayed):
    _, folder, done = replayed
    slam, entries = done.slam, read_ledger(folder)
    assert [entry.edge for entry in entries] == list(range(slam.graph.edge_count))
    assert [entry.verdict for entry in entries] == slam.ledger.verdict.values.tolist()
    assert written_changes(folder) == slam.ledger.history
    chi2, numbers = slam.solver.chi2_of(np.arange(len(entries)))
    assert [entry.chi2 for entry in entries] == chi2.tolist()
    assert [entry.dof for entry in entries] == numbers.tolist()
    stamps = slam.keyframes.stamps_ns
    for entry in entries:  # keyframes are the first vertices of the file
        attached = [vertex for vertex in entry.vertices if vertex < len(stamps)]
        assert entry.stamp_ns == stamps[max(attached, default=entry.keyframe)]


def test_an_update_tells_each_change_once_and_events_have_it(replayed):
    _, folder, done = replayed
    updates: list[Update] = []
    slam = GraphSlam(CONFIG)
    statuses = []
    for record in read_ingest(folder, []):
        updates.append(slam.process(from_record(record)))
        statuses += of_update(slam, updates[-1])
    told = [change for update in updates for change in update.changes]
    assert told == done.slam.ledger.history
    events = [dict(status.values) for status in statuses if status.name == "graph_slam: verdict"]
    assert [int(event["edge"]) for event in events] == [change.edge for change in told]
    edges = [dict(status.values) for status in statuses if "edge" in status.values and "label" in status.values]
    held_back = {change.edge for change in told if change.verdict is Verdict.PENDING}
    assert {int(e["edge"]) for e in edges if e["verdict"] == "pending"} == held_back


def test_what_is_no_ledger_is_refused_by_name(replayed, tmp_path):
    with pytest.raises(FormatError, match=r"ledger\.csv: no such file"):
        read_ledger(tmp_path)
    (tmp_path / LEDGER).write_text("edge,label\n0,odometry\n")
    with pytest.raises(FormatError, match="not a ledger"):
        read_ledger(tmp_path)
    rng, refused, content = random.Random(0), 0, (replayed[1] / LEDGER).read_text().splitlines()
    for k in range(30):
        rows = list(csv.reader(content))
        rows[rng.randrange(len(rows))][rng.randrange(len(rows[0]))] = ("nan", "1e400", "x", "", "9" * 5000)[k % 5]
        with (tmp_path / LEDGER).open("w", newline="") as stream:
            csv.writer(stream).writerows(rows)
        try:
            assert len(read_ledger(tmp_path)) == len(rows) - 1
        except FormatError as error:
            assert LEDGER in str(error) and len(str(error)) < 1000
            refused += 1
    assert refused > 10
