"""``docs/architecture.md`` says which files a message passes: it is recorded on the running node."""

import json
import re
import shutil
import sys
from itertools import pairwise
from pathlib import Path

import walks
from live_drive import Drive
from live_nodes import finish, node, robot
from places import ROOT


def recorded(file, run):
    """A node in this run folder that records its walks."""
    parameters = f"output.folder:={run}", "inputs.reliable:=true", "inputs.tf:=false"
    return node(*parameters, by=[sys.executable, walks.__file__, str(file)])


def listed(page, title):
    """The files in the first column of the table below this title; a folder stands for all files in it."""
    _, _, rest = page.partition(f"### {title}\n")
    rows = re.findall(r"^\| (`.*?) \|", rest.partition("\n#")[0], re.M)
    return [name for row in rows for name in re.findall(r"`(.*?)`", row)]


def check(table, beginnings):
    """Whether the files of the table are those that were passed, in the order of most messages."""

    def row_of(file):
        return next((name for name in (file, str(Path(file).parent)) if name in table), file)

    ways = [[([*dict.fromkeys(map(row_of, files))], times) for files, times in found] for found in beginnings]
    first = {file: k for k in reversed(range(len(ways))) for files, _ in ways[k] for file in files}
    assert sorted(first.keys() - set(table)) == [], "are passed, and docs/architecture.md does not list them"
    assert sorted(set(table) - first.keys()) == [], "are not passed, and docs/architecture.md lists them"
    for a, b in pairwise(table):
        both = [(files, times) for files, times in ways[first[a]] if a in files and b in files]
        before = sum(times if files.index(a) < files.index(b) else -times for files, times in both)
        assert first[a] < first[b] or (first[a] == first[b] and before >= 0), f"{b} is passed before {a}"


def test_a_message_passes_the_files_that_the_page_lists_in_their_order(tmp_path):
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in (*walks.OF_COURSE, walks.BUT)), "what the tables leave out"
    drive, run = Drive(), tmp_path / "run"
    with recorded(tmp_path / "drive.json", run) as n, robot() as r:
        r.wait_for_node()
        drive.go(r, 200)
        r.save_in_turn()
        drive.go(r, 20)
        r.settle()
        shutil.copytree(run, tmp_path / "cut_off" / "run")  # as a power cut leaves it
        finish(n, r)
    found = json.loads((tmp_path / "drive.json").read_text())
    for title, walk in (("Odometry", "odometry"), ("A sighting", "sighting"), ("A solve", "solve")):
        check(listed(page, title), found[walk])
    with recorded(tmp_path / "restart.json", tmp_path / "cut_off" / "run") as n, robot() as r:
        r.wait_for_node()
        finish(n, r)
    check(listed(page, "A restart"), json.loads((tmp_path / "restart.json").read_text())["restart"])
