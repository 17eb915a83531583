"""The ledger of a saved run: what it says is what was decided."""

import csv

import numpy as np
import pytest
import small_drive

from graph_slam_ros.errors import FormatError
from graph_slam_ros.node.events import of_update
from graph_slam_ros.runs.journal import CHANGES, LEDGER
from graph_slam_ros.runs.ledger_file import read_ledger
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Closure, GraphSlam
from graph_slam_ros.slam.robust.ledger import Verdict

S = 10**9


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder, (*drive, end, optimize) = tmp_path_factory.mktemp("run"), small_drive.drive()
    false = Closure(1020 * S, 1003 * S, "closures", (3.0, 3.0, 1.0), tuple((1e-4 * np.eye(3)).ravel().tolist()))
    measured = [*drive, false, end, optimize]
    return measured, folder, record_run(folder, small_drive.config(), measured, [])[0]


def test_what_is_read_and_told_on_events_is_what_was_decided(run):
    measured, folder, slam = run
    entries, stamps = read_ledger(folder), slam.view.keyframes.stamps_ns
    assert [entry.edge for entry in entries] == list(range(slam.view.graph.edge_count))
    assert [entry.verdict for entry in entries] == slam.view.ledger.verdict.values.tolist()
    chi2, numbers = slam.view.solver.chi2_of(np.arange(len(entries)))
    assert [(entry.chi2, entry.dof) for entry in entries] == list(zip(chi2.tolist(), numbers.tolist(), strict=True))
    for entry in entries:  # keyframes are the first vertices of the file
        attached = [vertex for vertex in entry.vertices if vertex < len(stamps)]
        assert entry.stamp_ns == stamps[max(attached, default=entry.keyframe)]
    (false,) = (entry for entry in entries if entry.label == "closures")
    assert (false.source, false.weight) == ("closures", 0.0)
    again, told = GraphSlam(small_drive.config()), []
    for m in measured:
        told += of_update(again.view, again.process(m))
    with (folder / CHANGES).open(newline="") as stream:
        rows = [(int(row["edge"]), Verdict[row["verdict"].upper()]) for row in csv.DictReader(stream)]
    changes = [(change.edge, change.verdict) for change in slam.view.ledger.history]
    events = [dict(status.values) for status in told if status.name == "graph_slam: verdict"]
    assert rows == changes and (false.edge, Verdict.PENDING) in changes
    assert [int(event["edge"]) for event in events] == [edge for edge, _ in changes]


def test_what_is_no_ledger_is_refused_by_name(run, tmp_path):
    with pytest.raises(FormatError, match=r"ledger\.csv: No such file"):
        read_ledger(tmp_path)
    (tmp_path / LEDGER).write_text("edge,label\n0,odometry\n")
    with pytest.raises(FormatError, match="not a ledger"):
        read_ledger(tmp_path)
    rows = list(csv.reader((run[1] / LEDGER).read_text().splitlines()))
    for word in ("", "x", "nan", "9" * 5000):
        rows[2][0] = word
        with (tmp_path / LEDGER).open("w", newline="") as stream:
            csv.writer(stream).writerows(rows)
        with pytest.raises(FormatError, match=r"ledger\.csv:3: not a ledger: .{,99}$"):
            read_ledger(tmp_path)
