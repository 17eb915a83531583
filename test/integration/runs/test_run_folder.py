"""What of a folder is a run's, what is never removed, and how its files are opened."""

import contextlib
import itertools
import json
import os
import shutil
import signal

import pytest
from places import ROOT
from reliability import times

from graph_slam_ros import cli
from graph_slam_ros.runs.folder import MARK, RunError, is_run, keep_earlier, remove
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config, Odometry
from graph_slam_ros.tools.simulation import simulate, write_bag

GOLDEN = ROOT / "test" / "golden"
NAMES = ("run_1.mcap", "map.mcap", "ingest.mcap", "ingest_2.mcap", "run.mcap", "config.yaml", "graph.g2o", "path.tum")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    file = tmp_path_factory.mktemp("recorded") / "drive.mcap"
    write_bag(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0), file)
    return file


@pytest.fixture(scope="module")
def saved(bag, tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "run"
    replay(bag, folder)
    return folder


@pytest.fixture
def run(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "run")


def state(folder):
    """Names, kinds and contents of what is below a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else path.lstat().st_mode
        for path in folder.rglob("*")
    }


def code_of(*words):
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as end:
        return end.code


# -- what is not ours --------------------------------------------------------------------------------------------------


def test_a_folder_of_recordings_with_the_names_of_a_run_is_never_cleared(bag, tmp_path, capsys):
    several = [*([name] for name in NAMES), NAMES, ("run_1.mcap", "map.mcap")]
    for k, (names, force) in enumerate(itertools.product(several, (False, True))):
        mine = tmp_path / str(k)
        mine.mkdir()
        for name in names:
            shutil.copy(bag, mine / name)
        before = state(mine)
        assert code_of("replay", bag, "--out", mine, *["--force"] * force) == 2, names
        assert "not empty and not an earlier run; nothing was written" in capsys.readouterr().err, names
        with pytest.raises(RunError):
            RunRecorder(mine, Config(), force=force)
        keep_earlier(mine, 0)
        assert state(mine) == before, names
        shutil.rmtree(mine)


def test_a_run_json_of_somebody_else_makes_no_run(bag, tmp_path):
    contents = ("{}", "[]", '{"format": "theirs"}', '{"keyframes": 9, "ended": true}', "[" * 10**5, "")
    for k, content in enumerate(contents):
        mine = tmp_path / str(k)
        mine.mkdir()
        shutil.copy(bag, mine / "run_1.mcap")
        (mine / "run.json").write_text(content)
        before = state(mine)
        assert not is_run(mine)
        with pytest.raises(RunError, match="not an earlier run"):
            replay(bag, mine, force=True)
        assert state(mine) == before


def test_a_recording_of_the_user_in_a_run_folder_is_not_removed_whatever_its_name(bag, run, capsys):
    for name in ("run_7.mcap", "ingest_4.mcap", "map_1.mcap"):
        shutil.copy(bag, run / name)
        before = state(run)
        assert code_of("replay", bag, "--out", run, "--force") == 2, name
        assert f"{run / name}: not written by this run, and so never removed" in capsys.readouterr().err
        with contextlib.suppress(OSError):
            remove(run)
        assert (run / name).read_bytes() == bag.read_bytes(), name
        (run / name).unlink(), (run / "run.json").write_bytes(before["run.json"])
    assert code_of("replay", bag, "--out", run, "--force") == 0


def test_what_else_is_in_a_run_folder_stays_when_the_run_is_replaced(bag, run):
    for name in ("notes.txt", "run_of_last_year.mcap", "path.tum.new", ".hidden.new"):
        (run / name).write_text("mine")
    (run / ".0123abcd.new").write_text("left behind by a killed process")
    before = set(state(run)) - {".0123abcd.new"}
    replay(bag, run, force=True)
    assert set(state(run)) == before
    assert (run / "notes.txt").read_text() == "mine"


def test_a_run_is_marked_from_its_first_moment_and_until_it_is_saved_says_that_it_is_not_ended(tmp_path):
    recorder = RunRecorder(tmp_path / "run", Config())
    assert json.loads((tmp_path / "run" / "run.json").read_text())["format"] == MARK
    assert not json.loads((tmp_path / "run" / "run.json").read_text())["ended"]
    recorder.sink(Odometry(1, (0.0, 0.0, 0.0)))
    recorder.abandon()
    for file in (tmp_path / "run").glob("*.mcap"):
        file.unlink()
    assert is_run(tmp_path / "run"), "by its mark alone"
    RunRecorder(tmp_path / "run", Config()).close()  # it held nothing


def test_a_run_of_an_earlier_version_is_known_by_its_journal_read_and_never_replaced(bag, tmp_path):
    (golden,) = GOLDEN.iterdir()
    old = shutil.copytree(golden, tmp_path / "old")
    assert is_run(old)
    cut = shutil.copytree(golden, tmp_path / "cut")
    (cut / "run.json").unlink()
    assert is_run(cut), "cut off before it was saved"
    for folder in (old, cut):
        before = state(folder)
        for force in (False, True):
            with pytest.raises(RunError, match="a run of an earlier version, which is never replaced"):
                replay(bag, folder, force=force)
        assert state(folder) == before
    keep_earlier(old, 0)
    assert state(tmp_path / "old-1")["ingest.mcap"] == (golden / "ingest.mcap").read_bytes()
    (cut / "ingest.mcap").write_bytes(bag.read_bytes())
    assert not is_run(cut), "its journal is a recording"


# -- --force -----------------------------------------------------------------------------------------------------------


def test_a_run_or_a_file_that_is_there_is_replaced_with_force_alone(bag, run, tmp_path, capsys):
    graph, city = tmp_path / "world.g2o", ["simulate", "city", "--poses", "12", "--set", "blocks=2"]
    assert code_of(*city, "--out", graph) == 0
    other = shutil.copytree(run, tmp_path / "other")
    commands = [
        (["replay", bag], other),
        (["recover", run], other),
        (["map", "freeze", run], other),
        (["map", "export", run], tmp_path / "path.mcap"),
        (["optimize", graph], tmp_path / "solved.g2o"),
        (["simulate", "manhattan", "--poses", "20", "--set", "blocks=2"], tmp_path / "world.mcap"),
        (city, tmp_path / "world_2.g2o"),
    ]
    for words, out in commands:
        words = [*words, "--out", out]
        if out != other:
            assert code_of(*words) == 0, words
        before = state(tmp_path)
        capsys.readouterr()
        assert code_of(*words) == 2, words
        (line,) = capsys.readouterr().err.splitlines()
        assert str(out) in line
        assert "--force" in line
        assert state(tmp_path) == before
        assert code_of(*words, "--force") == 0, words
    for words, out in (
        (["optimize", graph, "--out"], tmp_path / "a.g2o"),
        (["optimize", graph, "--plot"], tmp_path / "a.png"),
    ):
        assert code_of(*words, out) in (0, 3)
        assert code_of(*words, out) == 2
        assert code_of(*words, out, "--force") in (0, 3)


def test_a_file_that_is_not_a_regular_one_is_not_replaced_even_with_force(tmp_path, capsys):
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / "link.g2o").symlink_to(victim)
    (tmp_path / "dangling.g2o").symlink_to(tmp_path / "nowhere")
    os.mkfifo(tmp_path / "fifo.g2o")
    (tmp_path / "folder.g2o").mkdir()
    before = state(tmp_path)
    for name in ("link.g2o", "dangling.g2o", "fifo.g2o", "folder.g2o"):
        assert code_of("simulate", "city", "--poses", "12", "--out", tmp_path / name, "--force") == 2
        assert f"{name}: not a regular file, and so not replaced" in capsys.readouterr().err
    assert state(tmp_path) == before


# -- one way to open ---------------------------------------------------------------------------------------------------

TABLES = ("run.json", "config.yaml", "graph.g2o", "ledger.csv", "ledger_changes.csv", "path.tum", "covariances.csv")
SCORED = ("sightings.tum", "odometry.tum", "landmarks.csv")
READERS = {  # and the files of the run that they need
    ("explain", "RUN"): ("run.json", "config.yaml", "map.mcap"),
    ("explain", "RUN", "--without", "3"): ("config.yaml", "map.mcap"),
    ("explain", "RUN", "--influence", "1"): ("map.mcap",),
    ("advise", "RUN"): ("map.mcap",),
    ("evaluate", "RUN", "--truth", "BAG"): ("run.json", "config.yaml", "path.tum", "covariances.csv", *SCORED),
    ("map", "export", "RUN", "--out", "OUT.png"): ("run.json", "config.yaml", "path.tum", "covariances.csv", *SCORED),
    ("replay", "RUN", "--out", "OUT"): ("config.yaml", "ingest.mcap"),
    ("recover", "RUN", "--out", "OUT"): ("config.yaml", "map.mcap"),
    ("map", "export", "RUN", "--out", "OUT.tum"): ("map.mcap",),
    ("map", "diff", "RUN", "RUN"): ("map.mcap",),
    ("replay", "BAG", "--out", "RUN", "--force"): (*TABLES[1:], *SCORED, "path.png", "ingest.mcap", "run.mcap"),
}


def fifo(path, victim):
    os.mkfifo(path)


def link(path, victim):
    path.symlink_to(victim)


@pytest.fixture
def no_wait():
    """What waits for a FIFO waits for ever: an alarm ends it."""

    def end(*_):
        raise TimeoutError("it waits")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def test_no_command_waits_for_a_fifo_in_a_run_folder_or_follows_a_link(bag, saved, tmp_path, no_wait, capsys):
    """Each command with each file that it needs; some of them in turn, all with ``make soak``."""
    pytest.importorskip("evo")
    cases = [(words, name) for words, names in READERS.items() for name in names]
    for k, ((words, name), kind) in enumerate([*itertools.product(cases, (fifo, link))][:: times(5, 1)]):
        run, victim, what = shutil.copytree(saved, tmp_path / f"run_{k}"), tmp_path / "victim", (words, name, kind)
        victim.write_bytes((run / name).read_bytes() if (run / name).is_file() else b"a picture of mine")
        before = victim.read_bytes()
        (run / name).unlink(missing_ok=True)
        kind(run / name, victim)
        outs = {f"OUT{ending}": tmp_path / f"out_{k}{ending}" for ending in ("", ".png", ".tum")}
        names = {"RUN": run, "BAG": bag} | outs
        assert code_of(*(names.get(word, word) for word in words)) == 2, what
        (line,) = capsys.readouterr().err.splitlines()
        assert "not a regular file" in line or "a symbolic link" in line or "never removed" in line, (what, line)
        assert victim.read_bytes() == before, what


def test_evaluate_replaces_a_planted_link_and_does_not_write_through_it(bag, run, tmp_path):
    pytest.importorskip("evo")
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (run / "path.png").unlink(missing_ok=True)
    (run / "path.png").symlink_to(victim)
    assert code_of("evaluate", run, "--truth", bag) == 0
    assert victim.read_text() == "mine"
    assert not (run / "path.png").is_symlink()
    assert (run / "path.png").read_bytes().startswith(b"\x89PNG")
