"""Odd files in the folder of a run, odd settings, and what is not ours: one line, its exit code, nothing is changed."""

import contextlib
import itertools
import os
import random
import re
import shutil
import signal

import pytest
import reliability
from places import ROOT
from plain_rights import answer, plain_rights

from graph_slam_ros import cli
from graph_slam_ros.cli.console import shortened
from graph_slam_ros.runs.folder import RunError, is_run, keep_earlier, remove
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag

MOST = 200  # characters of a line on standard error


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A recording and the runs of two."""
    folder = tmp_path_factory.mktemp("made")
    for name, seed in (("drive", 5), ("other", 6)):
        write_bag(simulate("warehouse", seed, aisles=2, laps=1, aisle_m=4.0), folder / f"{name}.mcap")
        replay(folder / f"{name}.mcap", folder / f"{name}_run")
    return folder


def sizes(folder):
    return {str(path.relative_to(folder)): (path.lstat().st_mode, path.lstat().st_size) for path in folder.rglob("*")}


def check(code, err, codes, culprit, what):
    """It is one line that names the culprit, or lines of 200 characters where something was lost."""
    assert code in codes, (what, code, err)
    assert not any("Traceback" in line or "internal error" in line for line in err), (what, err)
    assert all(len(line) <= MOST for line in err if code != 3 or "lost: " in line), (what, err)
    assert code not in (1, 2) or len(err) == 1, (what, err)
    assert any(re.search(culprit, line) for line in err), (what, culprit, err)


def test_a_line_of_an_error_keeps_its_beginning_and_its_end(tmp_path):
    long = "/".join(["a" * 60] * 20)
    for line in (f"graph_slam: {long}/path.tum: no such file", f"{long} {long} x", "y " * 999, "z" * 999, "", "short"):
        out = shortened(line, MOST)
        assert len(out) <= MOST
        assert (out[:9], out[-9:]) == (line[:9], line[-9:])
    told = shortened(f"graph_slam: {long}/run/path.tum: cannot be read: do this", MOST)
    assert told.endswith("/run/path.tum: cannot be read: do this")
    folder = tmp_path / ("b" * 90) / ("c" * 90) / ("d" * 200)
    for words in (("explain", folder), ("info", folder), ("optimize", folder / "a.g2o"), ("info", "e" * 5000)):
        code, err = answer(*words)
        check(code, err, (2,), "graph_slam", words)
    for words in (
        ("map", "freeze", "a", "b\x1b[2J\n" * 99),
        ("explain", "a", "--influence", "\x1b" * 999),
        ("\n" * 300,),
    ):
        code, err = answer(*words)
        check(code, err, (2,), "--help shows what there is", words)
        assert not set("".join(err)) & set("\x1b\n"), words


SCORED = ("run.json", "config.yaml", "path.tum", "sightings.tum", "odometry.tum", "landmarks.csv", "covariances.csv")
OF_MAP = ("run.json", "config.yaml", "map.mcap")
NEEDS = {  # what each command reads of a run
    ("explain", "RUN"): OF_MAP,
    ("explain", "RUN", "3"): OF_MAP,
    ("explain", "RUN", "--without", "3"): OF_MAP,
    ("explain", "RUN", "--influence", "1"): OF_MAP,
    ("advise", "RUN"): OF_MAP,
    ("evaluate", "RUN", "--truth", "BAG"): SCORED,
    ("map", "export", "RUN", "--out", "OUT.png"): SCORED,
    ("replay", "RUN", "--out", "OUT"): ("run.json", "config.yaml", "ingest.mcap"),
    ("replay", "BAG", "--map", "RUN", "--out", "OUT"): OF_MAP,
    ("recover", "RUN", "--out", "OUT"): OF_MAP,
    ("recover", "RUN"): OF_MAP,
    ("map", "freeze", "RUN", "--out", "OUT"): OF_MAP,
    ("map", "export", "RUN", "--out", "OUT.tum"): OF_MAP,
    ("map", "diff", "RUN", "OTHER"): OF_MAP,
    ("map", "merge", "OTHER", "RUN", "--out", "OUT"): OF_MAP,
}
SOME = [*NEEDS][reliability.times(4, 0) :: reliability.times(6, 1)]
CASES = [(words, name) for words, names in NEEDS.items() for name in names]


def of_another_kind(path, other):
    kinds = {".tum": "graph.g2o", ".g2o": "path.tum", ".csv": "run.json", ".json": "run.mcap"}
    shutil.copy(other / kinds.get(path.suffix, "ledger.csv"), path)
    if path.suffix == ".mcap":
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + 999 * b"\0")


def folder(path, other):
    path.unlink()
    path.mkdir()


WORDS = ["", "x", "nan", "inf", "1e400", "1_0", "\u0663", "-1", "9" * 25, "9" * 5000, '"', "rejected", "EDGE_SE2_XY"]


def another_word(path, other):
    """One word of a line is another, or a line is there twice; of what is no text, three bytes are others."""
    rng, content = random.Random(path.name), path.read_bytes()
    if path.suffix == ".mcap":
        at = rng.randrange(len(content))
        path.write_bytes(content[:at] + rng.randbytes(3) + content[at + 3 :])
        return
    lines = content.decode().splitlines()
    line, separator = rng.randrange(len(lines)), "," if path.suffix == ".csv" else " "
    words = lines[line].split(separator)
    words[rng.randrange(len(words))] = rng.choice(WORDS)
    lines[line : line + 1] = [separator.join(words), lines[line]] if rng.random() < 0.2 else [separator.join(words)]
    path.write_text("\n".join(lines))


ODD_FILES = {
    "unreadable": lambda path, _: path.chmod(0),
    "sparse": lambda path, _: os.truncate(path, 2**40),
    "of another kind": of_another_kind,
    "of another run": lambda path, other: shutil.copy(other / path.name, path),
    "a folder": folder,
    "cut": lambda path, _: os.truncate(path, path.stat().st_size // 2),
    "not text": lambda path, _: path.write_bytes(b"\xff" + path.read_bytes()[50:]),
    "another word": another_word,
}


def asked(words, made, folder):
    """The answer of a command about the run of a folder, to somebody who is no superuser."""
    names = {"RUN": folder / "run", "BAG": made / "drive.mcap", "OTHER": made / "other_run"}
    names |= {f"OUT{ending}": folder / f"out{ending}" for ending in ("", ".png", ".tum")}
    with plain_rights():
        return answer(*(names.get(word, word) for word in words))


def wrong_with(odd, words, name, made, folder):
    """What a command does wrong where one file of a run is odd; empty: nothing."""
    shutil.copytree(made / "drive_run", folder / "run")
    ODD_FILES[odd](folder / "run" / name, made / "other_run")
    before = sizes(folder)
    code, err = asked(words, made, folder)
    after = sizes(folder)
    changed = {file for file in before if after.get(file) != before[file]}
    completed = words == ("recover", "RUN") and code in (0, 3)
    try:
        check(code, err, (0, 2, 3, 4), re.escape(name) + r"|run\.json|of the same drive in", (odd, words, name))
        assert code != 0 or "beware" in "".join(err) or odd == "another word", "nothing is said"
        assert completed or changed <= {"run/path.png"}, changed
        assert code in (0, 3, 4) or not [*folder.glob("out*")] or "no odometry of it could be used" in err[0]
    except AssertionError as error:
        return f"{odd} {words} {name}: {code} {err}: {error}"
    finally:
        (folder / "run" / name).chmod(0o700)
        shutil.rmtree(folder)
    return ""


def test_an_odd_file_in_the_folder_of_a_run_is_named_by_each_command_that_reads_it(made, tmp_path):
    """Each command with each file that it needs; some of them in turn, all with ``make soak``."""
    cases = [*itertools.product(ODD_FILES, CASES)][:: reliability.times(41, 1)]
    wrong = [wrong_with(odd, *case, made, tmp_path / str(k)) for k, (odd, case) in enumerate(cases)]
    reliability.tell("odd_files", tried=len(cases), failed=sum(map(bool, wrong)))
    assert not any(wrong), "\n".join(filter(None, wrong))


def test_a_run_that_may_be_read_and_not_written_is_read_and_stays(made, tmp_path):
    """Of another user, or of one's own that is write-protected: what would be written into it is refused."""
    run = tmp_path / "run"
    shutil.copytree(made / "drive_run", run)
    os.chmod(run, 0o555)
    refused = {("recover", "RUN")}
    before = sizes(tmp_path)
    for words in (*SOME, ("replay", "BAG", "--out", "RUN", "--force")):
        code, err = asked(words, made, tmp_path)
        assert not any("internal error" in line for line in err), (words, err)
        if words in refused or words[-1] == "--force":
            check(code, err, (2,), f"{run}.*: Permission denied", words)
        else:
            assert code == (4 if words == ("map", "diff", "RUN", "OTHER") else 0), (words, err)
            assert not err or "no picture" in err[0], (words, err)
        for out in tmp_path.glob("out*"):
            shutil.rmtree(out) if out.is_dir() else out.unlink()
        assert sizes(tmp_path) == before, words
        reliability.tell("folders_of_others", tried=1, failed=0)
    os.chmod(run, 0o700)


def test_a_private_folder_of_somebody_else_is_refused_by_name(made, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(made / "drive_run", run)
    if os.geteuid() == 0:
        os.chown(run, 65534, 65534)
    os.chmod(run, 0o700 if os.geteuid() == 0 else 0)
    extra = [("info", "RUN"), ("replay", "BAG", "--out", "RUN"), ("replay", "BAG", "--out", "RUN", "--force")]
    for words in (*SOME, *extra):
        code, err = asked(words, made, tmp_path)
        check(code, err, (2,), str(run), words)
        assert not [*tmp_path.glob("out*")], words
        reliability.tell("folders_of_others", tried=1, failed=0)
    os.chmod(run, 0o700)


NUMBERS = ["", " ", "nan", "-nan", ".nan", "inf", "-.inf", "1e999", "-1", "1_0", "\u0663", "1,5", "null", "~", "[1]"]
NUMBERS += ["true", "*a", "%TAG ! x", "2001-99-99", "@", "`", "'"]
NUMBERS += ["9" * 400, "9" * 9999, "0x" + "f" * 99, "[" * 99, "{" * 9999, "{a: 1}", "{a: {b: {c: 1}}}", "{a: 1, a: 2}"]
NUMBERS += ["- 1", "a: 1", "1: 2: 3", "!!python/object/apply:os.system [id]", "!!float x", "!x 1", "<<: {a: 1}"]
NUMBERS += ["1\n2", "1\0", "\x1b[2J", "\u202e1", "\ufeff1\ufeff", "\udcff", "\U0001f916"]
KEYS = ["", "=", "a", "a.b", "keyframes", "keyframes.", ".min_distance_m", "min_distance_m", "__class__"]
KEYS += ["keyframes..min_distance_m"]
KEYS += ["\0", "\x1b]0;x\x07", "keyframes.min_distance_m.x", "k" * 99999, "odom.\udcff"]
KEYS += ["\u043a\u043b\u044e\u0447", "keyframes.min_distanc\u0435_m"]
OTHERS = [f"world.dimensions={v}" for v in ("2.0", "4", "9" * 30, "two", "-2", "[2]")]
OTHERS += [f"odom.topic={v}" for v in ("x" * 99999, "a b", "\x1b[2J", "/a//b", "{a: 1}", "1", "\u202e")]
OTHERS += [f"inputs.names={v}" for v in ("a " * 9999, "odom odom", "/", "\x1b[2J", "a.b")]
SETTINGS = [f"keyframes.min_distance_m={v}" for v in NUMBERS] + [f"{key}=1" for key in KEYS] + ["=", "a"] + OTHERS


def test_a_setting_that_is_none_is_refused_by_name_before_anything_is_read_or_written(made, tmp_path):
    wrong = []
    tried = SETTINGS[:: reliability.times(3, 1)]
    for text in tried:
        try:
            code, err = answer("replay", made / "drive.mcap", "--out", tmp_path / "out", "--set", text)
            key = re.escape(ascii(text.partition("=")[0])[1:9])
            check(code, err, (2,), f"{key}|--set|KEY=VALUE|unknown parameter|no topic /", text[:99])
            assert not set("".join(err)) & set("\x1b\u202e\x07\udcff"), text[:99]
            assert not (tmp_path / "out").exists(), text[:99]
        except AssertionError as error:
            wrong.append(str(error)[:300])
            shutil.rmtree(tmp_path / "out", ignore_errors=True)
    reliability.tell("settings", tried=len(tried), failed=len(wrong))
    assert not wrong, "\n".join(wrong)


LONG = ["x" * 99999, ":" * 5000, "a:" * 5000, "../" * 2000, "*a" * 200, "[" * 5000, "(a+)+" * 50, "\x1b[2J" * 999]
LONG += ["\u00e9" * 5000]
ODD = ["1e" + "9" * 5000, "landmark:" * 999, "/dev/zero", "/proc/kmsg", "\udcff", "%s%n", "\n"]
TAKING = [  # what takes it, whatever it is for
    ("info", "X"),
    ("evaluate", "RUN", "--truth", "X"),
    ("evaluate", "RUN", "--truth", "BAG", "--estimate", "X"),
    ("explain", "RUN", "X"),
    ("explain", "RUN", "--loss", "X"),
    ("replay", "BAG", "--out", "OUT", "--config", "X"),
    ("map", "merge", "RUN", "X", "--out", "OUT"),
    ("simulate", "warehouse", "--out", "OUT", "--fault", "X"),
    ("optimize", "X", "--out", "OUT"),
]


def test_a_long_or_odd_argument_is_refused_in_a_line(made, tmp_path):
    for words, odd in [*itertools.product(TAKING, LONG + ODD)][:: reliability.times(7, 1)]:
        names = {"RUN": made / "drive_run", "BAG": made / "drive.mcap", "OUT": tmp_path / "out", "X": odd}
        code, err = answer(*(names.get(word, word) for word in words))
        check(code, err, (2,), "graph_slam", (words, odd[:20]))
        assert not set("".join(err)) & set("\x1b\udcff"), (words, odd[:20])
        assert not any(tmp_path.iterdir()), (words, odd[:20])
        reliability.tell("arguments", tried=1, failed=0)


GOLDEN = ROOT / "test" / "golden"
NAMES = ("run_1.mcap", "map.mcap", "ingest.mcap", "ingest_2.mcap", "run.mcap", "config.yaml", "graph.g2o", "path.tum")


@pytest.fixture
def bag(made):
    return made / "drive.mcap"


@pytest.fixture
def saved(made):
    return made / "drive_run"


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


def test_a_run_whose_run_json_is_lost_is_known_by_its_journal_and_never_replaced(bag, run):
    (run / "run.json").unlink()
    with pytest.raises(RunError, match="nothing was written"):
        replay(bag, run, force=is_run(run))


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
    for k, ((words, name), kind) in enumerate([*itertools.product(cases, (fifo, link))][:: reliability.times(9, 1)]):
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
