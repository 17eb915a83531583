"""What asks a saved run, of runs that are damaged: it is answered, or one line tells what is wrong and where."""

import csv
import io
import random
import shutil
from pathlib import Path

import pytest

from graph_slam_ros import cli, load_run
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import FormatError
from graph_slam_ros.runs.folder import GRAPH, SUMMARY
from graph_slam_ros.runs.ledger_file import LEDGER, read_ledger
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config

CONFIG = "config.yaml"
MAP = "map.mcap"
READ = (SUMMARY, CONFIG)
CLOSURES = {
    "inputs.names": "odom detections closures",
    "closures.type": "vision_msgs/msg/Detection3DArray",
    "closures.use": "closure",
}
WORDS = ["", "x", "nan", "inf", "-inf", "1e400", "1e300", "1_0", "٣", "-1", "0", "1.5", "9" * 25, "9" * 5000, "0 0"]
WORDS += ["99999 1", '"', "a,b", "accepted", "rejected", "none", "odometry", "closures", "EDGE_SE2_XY", "EDGE_SE3:QUAT"]
ASKED = (
    lambda run, edge: ("explain", run, edge),
    lambda run, edge: ("explain", run, "--without", edge),
    lambda run, edge: ("explain", run, "--with", edge),
    lambda run, edge: ("explain", run, "--influence", 1),
)
MUTATIONS = 100


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    bag, run = folder / "drive.mcap", folder / "run"
    city = ["--poses", "25", "--set", "blocks=4", "--closures", "6", "--fault", "false_closures:rate=0.5"]
    assert cli.main(["simulate", "manhattan", "--out", str(bag), *city]) == 0
    replay(bag, run, Config.from_mapping(CLOSURES))
    return run


@pytest.fixture
def run(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "run"))


def told(capsys, *words):
    code = cli.main([*map(str, words)])
    out, err = capsys.readouterr()
    return code, out, err


def is_refused(capsys, what, command, run, *words):
    """Whether a command does not do it, but tells in one line which part of the run is wrong."""
    code, out, err = told(capsys, command, run, *words)
    if code in (0, 3):
        assert out, (what, command, words)
        lines = err.splitlines()
        assert bool(lines) is (code == 3), (what, err)
        assert all(line.startswith("graph_slam: lost: ") for line in lines), (what, err)
        return False
    assert (code, out, err.count("\n")) == (2, "", 1), (what, command, words, err)
    assert any(word in err for word in (*READ, MAP, run.name, "vertex", "edge")), (what, command, words, err)
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
        name = rng.choice(READ)
        content = (whole / name).read_bytes()
        (run / name).write_bytes(damaged(content, name, rng))
        edge, what = rng.randrange(edges), f"mutation {number} of {name}"
        refused += is_refused(capsys, what, *rng.choice(ASKED)(run, edge))
        (run / name).write_bytes(content)
    assert refused > 0.1 * MUTATIONS


def test_a_damaged_ledger_is_read_or_refused_with_its_line(whole, run):
    rng, refused = random.Random(0), 0
    content = (whole / LEDGER).read_bytes()
    for _ in range(MUTATIONS):
        (run / LEDGER).write_bytes(damaged(content, LEDGER, rng))
        try:
            assert load_run(run).edges
        except FormatError as error:
            assert LEDGER in str(error)
            assert len(str(error)) < 1000
            refused += 1
    assert refused > 0.3 * MUTATIONS


@pytest.mark.parametrize(("name", "how"), [(CONFIG, "folder"), (CONFIG, "not UTF-8"), (MAP, "folder")])
def test_what_is_no_file_of_its_kind_is_refused_by_its_name(run, name, how, capsys):
    content = (run / name).read_bytes()
    (run / name).unlink()
    if how == "folder":
        (run / name).mkdir()
    else:
        (run / name).write_bytes(b"\xff" + content[50:])
    code, _, err = told(capsys, "explain", run)
    assert (code, name in err, err.count("\n")) == (2, True, 1)


@pytest.mark.parametrize("asked", [[], ["5"], ["--loss", "none"], ["--influence"]])
def test_a_folder_that_is_no_run_is_refused_and_a_mere_journal_is_answered(whole, tmp_path, asked, capsys):
    begun = tmp_path / "begun"
    begun.mkdir()
    for name in (CONFIG, "ingest.mcap"):
        shutil.copy(whole / name, begun)
    code, out, _ = told(capsys, "explain", begun, *asked)
    assert (code, bool(out)) == (0, True)
    for folder in (tmp_path / "none", tmp_path, whole / GRAPH):
        code, out, err = told(capsys, "explain", folder, *asked)
        assert (code, out, err.count("\n"), str(folder) in err) == (2, "", 1, True)


def test_ids_of_edges_are_strict_and_none_is_let_in_and_taken_out_or_counts_twice(run, capsys):
    for word in ("9" * 5000, "٣", "-1", "1_0"):
        code, _, err = told(capsys, "explain", run, word)
        assert (code, err.count("\n")) == (2, 1)
    code, _, err = told(capsys, "explain", run, "--with", "7", "--without", "5", "7")
    assert (code, "edge 7: cannot be taken out and let in at once" in err) == (2, True)
    once, twice = (SavedGraph(run, []).solve(let_in=[7] * times).evaluate() for times in (1, 2))
    assert twice.classes["believed"].edges == once.classes["believed"].edges == 1


def test_names_of_landmarks_may_be_anything_and_an_error_is_one_line_still(run):
    """Written, and read again from the table."""
    names = ('a "quoted", one', "two\r\nlines", "7")
    entries = [e for e in read_ledger(run) if e.landmark]
    rows = list(csv.reader((run / LEDGER).open(newline="")))
    for entry, name in zip(entries, names, strict=False):
        rows[entry.edge + 1][rows[0].index("landmark")] = name
    with (run / LEDGER).open("w", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows(rows)
    assert [read_ledger(run)[entry.edge].landmark for entry in entries[:3]] == list(names)
