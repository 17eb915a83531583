"""What asks a saved run, of runs that are damaged: it is answered, or one line tells what is wrong and where."""

import csv
import io
import random
import shutil
from pathlib import Path

import pytest

from graph_slam_ros import cli
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.runs import GRAPH, SUMMARY
from graph_slam_ros.runs.ledger_file import CHANGES, LEDGER, read_changes, read_ledger
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config

CONFIG = "config.yaml"
READ = (LEDGER, CHANGES, GRAPH, SUMMARY, CONFIG)
CLOSURES = {
    "inputs.names": "odom detections closures",
    "closures.type": "vision_msgs/msg/Detection3DArray",
    "closures.use": "closure",
}
WORDS = ["", "x", "nan", "inf", "-inf", "1e400", "1e300", "1_0", "٣", "-1", "0", "1.5", "9" * 25, "9" * 5000, "0 0"]
WORDS += ["99999 1", '"', "a,b", "accepted", "rejected", "none", "odometry", "closures", "EDGE_SE2_XY", "EDGE_SE3:QUAT"]
ASKED = (
    lambda run, edge: ("explain", run, edge),
    lambda run, edge: ("solve", run, "--without", edge),
    lambda run, edge: ("solve", run, "--with", edge),
    lambda run, edge: ("influence", run, "--count", 1),
)
MUTATIONS = 100


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    bag, run = folder / "drive.mcap", folder / "run"
    city = ["--poses", "25", "--set", "blocks=4", "--closures", "6", "--fault", "false_closures:rate=0.5"]
    assert cli.main(["simulate", "manhattan", "--out", str(bag), *city]) == 0
    replay(bag, run, Config.from_mapping(CLOSURES))
    assert read_changes(run, len(read_ledger(run)))
    return run


@pytest.fixture
def run(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "run"))


def told(capsys, *words):
    code = cli.main([*map(str, words)])
    out, err = capsys.readouterr()
    return code, out, err


BEWARE = ("is not the one that run.json was saved with", "run.json is not the summary of a run")


def is_refused(capsys, what, command, run, *words):
    """Whether a command does not do it, but tells in one line which part of the run is wrong."""
    code, out, err = told(capsys, command, run, *words)
    if code == 0:
        assert out, (what, command, words)
        assert all(any(word in line for word in BEWARE) for line in err.splitlines()), (what, err)
        return False
    assert (code, out, err.count("\n")) == (2, "", 1), (what, command, words, err)
    assert any(word in err for word in (*READ, run.name, "vertex", "edge")), (what, command, words, err)
    assert len(err) < 1000, (what, command, words, err)
    return True


def cell_changed(text, rng):
    """Another word in a column, a row twice, or rows or columns in another order."""
    rows = list(csv.reader(io.StringIO(text, newline="")))
    row, column = rng.randrange(len(rows)), rng.randrange(len(rows[0]))
    match rng.randrange(8):
        case 0:
            rows.insert(row, rows[rng.randrange(len(rows))])
        case 1:
            del rows[row]
        case 2:
            del rows[row][column]
        case _:
            rows[row][column] = rng.choice(WORDS)
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def word_changed(text, rng):
    lines = text.splitlines()
    line = rng.randrange(len(lines))
    words = lines[line].split(" ")
    words[rng.randrange(len(words))] = rng.choice(WORDS)
    lines[line] = " ".join(words)
    return "\n".join(lines)


def damaged(content, name, rng):
    """Bytes of a file with one thing wrong with them."""
    at = rng.randrange(len(content))
    match rng.randrange(6):
        case 0:
            return content[:at]
        case 1:
            return content[:at] + rng.randbytes(3) + content[at:]
        case 2:
            return content[:at] + content[at + rng.randrange(200) :]
        case _:
            changed = cell_changed if name.endswith(".csv") else word_changed
            return changed(content.decode(), rng).encode()


@pytest.mark.filterwarnings("error")
def test_a_damaged_run_is_answered_or_refused_by_name(whole, run, capsys):
    rng, edges = random.Random(0), len(read_ledger(whole))
    refused = 0
    for number in range(MUTATIONS):
        name = rng.choice(READ[:2] + READ)
        content = (whole / name).read_bytes()
        (run / name).write_bytes(damaged(content, name, rng))
        edge, what = rng.randrange(edges), f"mutation {number} of {name}"
        refused += is_refused(capsys, what, "explain", run)
        is_refused(capsys, what, *rng.choice(ASKED)(run, edge))
        (run / name).write_bytes(content)
    assert refused > 0.3 * MUTATIONS


@pytest.mark.parametrize("name", READ)
@pytest.mark.parametrize("how", ["missing", "folder", "not UTF-8"])
def test_what_is_no_file_of_text_is_refused_by_its_name(run, name, how, capsys):
    content = (run / name).read_bytes()
    (run / name).unlink()
    if how == "folder":
        (run / name).mkdir()
    elif how == "not UTF-8":
        (run / name).write_bytes(content[:50] + b"\xff" + content[50:])
    command = ["solve", run, "--without", "5"] if name == GRAPH else ["explain", run]
    code, _, err = told(capsys, *command)
    assert (code, name in err, err.count("\n")) == (2, True, 1)


@pytest.mark.parametrize("asked", [["explain"], ["explain", "5"], ["solve", "--loss", "none"], ["influence"]])
def test_a_folder_that_is_no_finished_run_is_refused(whole, tmp_path, asked, capsys):
    begun = tmp_path / "begun"
    begun.mkdir()
    for name in (CONFIG, "ingest.mcap"):
        shutil.copy(whole / name, begun)
    for folder in (begun, tmp_path / "none", tmp_path, whole / GRAPH):
        code, out, err = told(capsys, asked[0], folder, *asked[1:])
        assert (code, out, err.count("\n"), str(folder) in err) == (2, "", 1, True)


@pytest.mark.parametrize("name", [LEDGER, GRAPH])
def test_files_of_two_runs_or_cut_between_two_lines_are_not_taken_for_one(run, name, capsys):
    lines = (run / name).read_text().splitlines(keepends=True)
    (run / name).write_text("".join(lines[:-1]))
    code, _, err = told(capsys, "solve", run, "--without", "5")
    assert (code, f"{GRAPH} and {LEDGER} are not of one run, or not whole: EDGE_SE2" in err) == (2, True)


def test_ids_of_edges_are_strict_and_none_is_let_in_and_taken_out_or_counts_twice(run, capsys):
    for word in ("9" * 5000, "٣", "-1", "1_0"):
        code, _, err = told(capsys, "explain", run, word)
        assert (code, err.count("\n")) == (2, 1)
    code, _, err = told(capsys, "solve", run, "--with", "7", "--without", "5", "7")
    assert (code, "edge 7: cannot be taken out and let in at once" in err) == (2, True)
    once, twice = (SavedGraph(run).solve(let_in=[7] * times).evaluate() for times in (1, 2))
    assert twice.classes["believed"].edges == once.classes["believed"].edges == 1


def test_names_of_landmarks_may_be_anything_and_an_error_is_one_line_still(run, capsys):
    names = ('a "quoted", one', "two\r\nlines", "7")
    entries = [e for e in read_ledger(run) if e.landmark]
    rows = list(csv.reader((run / LEDGER).open(newline="")))
    for entry, name in zip(entries, names, strict=False):
        rows[entry.edge + 1][rows[0].index("landmark")] = name
    with (run / LEDGER).open("w", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows(rows)
    for name, shown in ((names[0], names[0]), (names[1], r"two\r\nlines"), ("landmark:7", "7")):
        code, out, err = told(capsys, "explain", run, name)
        assert (code, out.splitlines()[0].startswith(f"landmark {shown}: 1 edges, ")) == (0, True)
        assert err == "graph_slam: beware: ledger.csv is not the one that run.json was saved with\n"
    code, _, err = told(capsys, "explain", run, "no such\nname")
    assert (code, err.count("\n"), "no such\\nname" in err, "two\\r\\nlines" in err) == (2, 1, True, True)
