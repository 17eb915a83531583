"""Odd files in run folders, odd values of settings and an odd environment: one line, its exit code, nothing changed."""

import re

import pytest

from graph_slam_ros import cli
from graph_slam_ros.cli.console import shortened
from graph_slam_ros.replay import replay
from graph_slam_ros.simulation import simulate, write_bag

MOST = 200  # characters of a line on standard error


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A recording and the runs of two."""
    folder = tmp_path_factory.mktemp("made")
    for name, seed in (("drive", 5), ("other", 6)):
        write_bag(simulate("warehouse", seed, aisles=2, laps=1, aisle_m=4.0), folder / f"{name}.mcap")
        replay(folder / f"{name}.mcap", folder / f"{name}_run")
    return folder


def answer(capfd, *words):
    """Exit code and the lines on standard error of a command, in this process."""
    capfd.readouterr()
    try:
        code = cli.main([str(word) for word in words])
    except SystemExit as end:
        code = end.code
    return code, capfd.readouterr().err.splitlines()


def state(folder):
    """Names and contents of what is below a folder."""
    return {str(path.relative_to(folder)): (path.lstat().st_mode, path.lstat().st_size) for path in folder.rglob("*")}


def check(code, err, codes, culprit, what):
    """It is one line that names the culprit, or lines of 200 characters where something was lost."""
    assert code in codes, (what, code, err)
    assert not any("Traceback" in line or "a fault of ours" in line for line in err), (what, err)
    assert all(len(line) <= MOST for line in err), (what, err)
    assert code not in (1, 2) or len(err) == 1, (what, err)
    assert any(re.search(culprit, line) for line in err), (what, culprit, err)


# -- a line ------------------------------------------------------------------------------------------------------------


def test_a_line_of_an_error_keeps_its_beginning_and_its_end(tmp_path, capfd):
    long = "/".join(["a" * 60] * 20)
    for line in (f"graph_slam: {long}/path.tum: no such file", f"{long} {long} x", "y " * 999, "z" * 999, "", "short"):
        out = shortened(line, MOST)
        assert len(out) <= MOST
        assert (out[:9], out[-9:]) == (line[:9], line[-9:])
    told = shortened(f"graph_slam: {long}/run/path.tum: cannot be read: do this", MOST)
    assert told.endswith("/run/path.tum: cannot be read: do this")
    folder = tmp_path / ("b" * 90) / ("c" * 90) / ("d" * 200)
    for words in (("plot", folder), ("info", folder), ("optimize", folder / "a.g2o"), ("info", "e" * 5000)):
        code, err = answer(capfd, *words)
        check(code, err, (2,), "graph_slam", words)
    for words in (("plot", "a", "b\x1b[2J\n" * 99), ("influence", "a", "--count", "\x1b" * 999), ("\n" * 300,)):
        code, err = answer(capfd, *words)
        check(code, err, (2,), "--help shows what there is", words)
        assert not set("".join(err)) & set("\x1b\n"), words
