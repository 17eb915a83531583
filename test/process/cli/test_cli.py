"""The command line: every exit code, one line for what is refused, never a traceback."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import time

import pytest
from executables import executable
from rows import each

from graph_slam_ros import __version__, cli
from graph_slam_ros.cli.parser import COMMANDS, parser
from graph_slam_ros.config.config import parameters
from graph_slam_ros.recordings.bag import BagWriter, open_bag

RESULTS = ("graph.g2o", "path.tum", "sightings.tum", "landmarks.csv", "ledger.csv", "ledger_changes.csv")
COMMAND = executable("graph_slam")
SIMULATE = ("simulate", "warehouse", "--set", "aisles=2", "--set", "laps=1", "--set", "aisle_m=4")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    file = tmp_path_factory.mktemp("a folder") / "drive it.mcap"
    words = ("--seed", "4", "--poses", "80", "--set", "blocks=4")
    assert cli.main(["simulate", "manhattan", "--out", str(file), *words]) == 0
    return file


@pytest.fixture(scope="module")
def long_bag(tmp_path_factory):
    """Of several chunks."""
    file = tmp_path_factory.mktemp("long") / "long.mcap"
    assert cli.main(["simulate", "manhattan", "--out", str(file), "--poses", "200"]) == 0
    return file


@pytest.fixture(scope="module")
def run(bag, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert cli.main(["replay", str(bag), "--out", str(folder)]) == 0
    return folder


def told(capsys, *words):
    """(exit code, standard output, lines on standard error)."""
    try:
        code = cli.main([str(w) for w in words])
    except SystemExit as end:  # argparse
        code = end.code
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    return code, out, err.splitlines()


def results(folder):
    return {name: (folder / name).read_bytes() for name in RESULTS}


# -- 0 --------------------------------------------------------------------------------------------------------------


def test_replay_says_what_happened_and_ends_with_0(bag, run, tmp_path, capsys):
    code, out, err = told(capsys, "replay", bag, "--out", tmp_path / "run")
    assert (code, err) == (0, [])
    summary = json.loads((tmp_path / "run" / "run.json").read_text())
    for number in (summary["keyframes"], summary["landmarks"], summary["edges"], f"{summary['chi2']:.3f}"):
        assert f" {number}" in out
    assert f"results in {tmp_path / 'run'}" in out
    assert results(tmp_path / "run") == results(run)


def test_replay_of_a_run_repeats_it_and_a_setting_changes_it(run, tmp_path, capsys):
    assert told(capsys, "replay", run, "--out", tmp_path / "same")[0] == 0
    assert results(tmp_path / "same") == results(run)
    assert told(capsys, "replay", run, "--out", tmp_path / "other", "--set", "landmarks.loss=none")[0] == 0
    assert results(tmp_path / "other") != results(run)


def test_settings_go_before_the_file_and_the_file_before_the_defaults(bag, tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("keyframes:\n  min_distance_m: 0.7\nsolve:\n  every_keyframes: 7\n")
    options = ("--config", tmp_path / "mine.yaml", "--set", "solve.every_keyframes=9")
    assert told(capsys, "replay", bag, "--out", tmp_path / "run", *options)[0] == 0
    used = (tmp_path / "run" / "config.yaml").read_text()
    assert "min_distance_m: 0.7" in used
    assert "every_keyframes: 9" in used


def test_the_command_that_info_prints_works_as_it_is(bag, run, tmp_path, capsys, monkeypatch):
    code, out, err = told(capsys, "info", bag)
    assert (code, err) == (0, [])
    lines = out.splitlines()
    topics = {line.split()[0]: line for line in lines if line.startswith("/")}
    assert set(topics) == set(open_bag(bag).topics)
    assert "nav_msgs/msg/Odometry" in topics["/odom"]
    assert "odom -> base_link" in topics["/odom"]
    assert " Hz" in topics["/odom"]
    assert any(line.startswith("span ") for line in lines)
    monkeypatch.chdir(tmp_path)
    program, *words = shlex.split(lines[-1])
    assert program == "graph_slam"
    assert words[-2:] == ["--out", "drive_it_run"]
    assert told(capsys, *words)[0] == 0
    assert results(tmp_path / words[-1]) == results(run)


def test_replay_names_what_could_be_an_input_and_is_none(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert told(capsys, *SIMULATE, "--set", "gnss=1", "--set", "imu=10", "--out", "drive.mcap")[0] == 0
    code, out, err = told(capsys, "replay", "drive.mcap", "--out", "run")
    assert (code, err) == (0, [])
    assert "not used   /gps/fix (sensor_msgs/msg/NavSatFix): graph_slam info drive.mcap prints the command" in out
    _, *words = shlex.split(told(capsys, "info", "drive.mcap")[1].splitlines()[-1])
    assert "not used" not in told(capsys, *words)[1]


def test_simulate_replay_evaluate_end_to_end(bag, run, capsys):
    code, out, err = told(capsys, "evaluate", run, "--truth", bag, "--json")
    assert (code, err) == (0, [])
    scores = json.loads(out)
    assert {"position_m", "heading_rad", "drift", "map_m", "n", "odometry", "consistency"} < set(scores)
    assert set(scores["position_m"]) == set(scores["heading_rad"]) == {"rmse", "median", "max"}
    assert set(scores["map_m"]) == {"rmse"}
    assert scores["n"] > 50
    assert scores["position_m"]["rmse"] < 0.5 * scores["odometry"]["position_m"]["rmse"]
    assert (run / "path.png").stat().st_size > 10_000
    code, out, _ = told(capsys, "evaluate", run, "--truth", f"{bag}:/ground_truth", "--plot", run / "b.png")
    assert code == 0
    assert f"{scores['position_m']['rmse']:.3f}" in out


EVERY = [f"{name} {k}".rstrip() for name, row in COMMANDS.items() for k in ("", *getattr(row, "commands", ()))]


def test_help_and_version_end_with_0(capsys):
    assert told(capsys, "--version") == (0, f"graph_slam_ros {__version__}\n", [])
    code, out, _ = told(capsys, "--help")
    assert code == 0
    assert len(COMMANDS) <= 18
    for command in COMMANDS:
        assert re.search(rf"^    {command}\b", out, re.MULTILINE), command


@each("command", EVERY)
def test_every_help_has_an_example_that_the_command_line_takes(command, capsys):
    code, out, _ = told(capsys, *command.split(), "--help")
    assert code == 0
    assert out.startswith(f"usage: graph_slam {command}")
    assert "Exit codes: 0 done, 1 internal error, 2 refused" in out.replace("\n", " ")
    about = out.split("\n\n")[1]
    assert about[0].isupper() and about.endswith("."), "a sentence says what it does"
    nameless = re.findall(r"^  (\S+)(?: [A-Z]\S*)*$(?!\n {10})", out.partition("\nExample")[0], re.MULTILINE)
    assert set(nameless) <= {"COMMAND"}, f"without help: {nameless}"
    examples = re.findall(rf"^  graph_slam ({command}\b.*)$", out.partition("\nExample")[2], re.MULTILINE)
    assert examples
    for example in examples:
        assert callable(parser().parse_args(shlex.split(example)).run)


def test_params_tells_default_unit_bounds_meaning_and_when_it_may_change(capsys):
    code, out, _ = told(capsys, "params")
    lines = out.splitlines()
    assert code == 0
    names = [line.split(" = ")[0] for line in lines[:-1:2]]
    assert names == [p.name for p in parameters()]
    assert all(line.startswith("    ") and line.strip() for line in lines[1:-1:2])
    code, out, _ = told(capsys, "params", "keyframes.min_distance_m")
    first, meaning, _ = out.splitlines()
    assert first == "keyframes.min_distance_m = 0.25 m   (in [0.001, 1e+09]; may change at any time)"
    assert meaning == "    a keyframe is added after the robot moved this far"
    only = told(capsys, "params", "odometry.*")[1].splitlines()[:-1:2]
    assert [line.split(" = ")[0] for line in only] == [p.name for p in parameters() if p.name.startswith("odometry.")]
    assert "one of twist, density, motion; read at the start" in only[0]
    assert "keyframes.min_distance_m" in told(capsys, "params", "the robot moved this FAR")[1]


@each(
    "typed, offered",
    [
        (("repl",), {"replay"}),
        (("completion", ""), {"bash", "zsh"}),
        (("optimize", "--init", "c"), {"chordal"}),
        (("replay", "bag", "--fo"), {"--force"}),
        (("map", "e"), {"edit", "export"}),
        (("map", "export", "run", "--la"), {"--last-drive"}),
        (("info", "dr"), {"drive.mcap"}),
    ],
)
@each("shell", ["bash", "zsh"])
def test_a_shell_completes_commands_options_choices_and_files(shell, typed, offered, tmp_path, capsys):
    if shutil.which(shell) is None:
        return
    (tmp_path / "drive.mcap").touch()
    code, script, _ = told(capsys, "completion", shell)
    assert code == 0
    if shell == "zsh":  # whose completion runs in its line editor alone: it loads without a complaint
        done = subprocess.run(["zsh", "-f", "-c", script], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stderr) == (0, "")
        return
    words = " ".join(shlex.quote(word) for word in ("graph_slam", *typed))
    ask = f"COMP_WORDS=({words}); COMP_CWORD={len(typed)}; _graph_slam; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    fallback = f'; [ -n "${{COMPREPLY[*]}}" ] || compgen -f -- {shlex.quote(typed[-1])}'  # -o default
    done = subprocess.run(
        ["bash", "-c", script + ask + fallback], capture_output=True, text=True, timeout=60, cwd=tmp_path
    )
    assert done.stderr == ""
    assert set(done.stdout.split()) == offered


def test_each_command_ends_with_a_line_of_what_to_do_next(bag, run, tmp_path, capsys):
    for words in (
        ("replay", bag, "--out", tmp_path / "a_run"),
        ("recover", run, "--out", tmp_path / "recovered"),
        ("map", "freeze", run, "--out", tmp_path / "frozen"),
        ("map", "export", run, "--out", tmp_path / "a.g2o"),
        ("optimize", tmp_path / "a.g2o"),
        ("optimize", tmp_path / "a.g2o", "--out", tmp_path / "a.tum"),
        ("simulate", "manhattan", "--poses", "20", "--out", tmp_path / "b.mcap"),
        ("map", "diff", run, tmp_path / "a_run"),
        ("explain", run),
        ("explain", run, "3"),
        ("explain", run, "--loss", "none"),
        ("explain", run, "--influence", "1"),
        ("advise", run),
        ("params", "odometry"),
    ):
        code, out, _ = told(capsys, *words)
        assert code in (0, 3), words
        assert out.splitlines()[-1].startswith("next: "), words
        assert out.count("next: ") == 1


# -- 2 --------------------------------------------------------------------------------------------------------------

REFUSED = {
    "no command": ([], "graph_slam: the following arguments are required: COMMAND"),
    "unknown command": (["fly"], "invalid choice: 'fly'"),
    "command of a group": (["merge", "a", "b"], "; graph_slam map merge (--help"),
    "command with a typo": (["replya", "{bag}"], "did you mean 'replay'?"),
    "option with a typo": (["replay", "{bag}", "--frce"], "arguments: --frce; did you mean '--force'?"),
    "recording with a typo": (["info", "{bag}x"], "no such file or folder; did you mean 'drive it.mcap'?"),
    "topic with a typo": (["replay", "{bag}", "--odom", "/odm", "--out", "{out}"], "did you mean '/odom'?"),
    "choice with a typo": (
        ["replay", "{bag}", "--out", "{out}", "--set", "tf.stamp=odometri"],
        "did you mean 'odometry'?",
    ),
    "run with a typo": (["explain", "{bag}s"], "did you mean 'drive it.mcap'?"),
    "first fault with a typo": (
        ["simulate", "warehouse", "--out", "{out}.mcap", "--fault", "wrong_mout", "--fault", "wrong_ids"],
        "did you mean 'wrong_mount'?",
    ),
    "first of two files of a fleet": (
        ["fleet", "replay", "{bag}", "--config", "no.yaml", "--config", "{text}", "--out", "{out}"],
        "no.yaml",
    ),
    "unknown option": (["info", "{bag}", "--fast"], "unrecognized arguments: --fast"),
    "two bags": (
        ["check", "{bag}", "{cut}"],
        "cut.mcap is one recording too many: parts of one drive go into one folder",
    ),
    "no bag": (["replay"], "graph_slam replay: the following arguments are required: BAG"),
    "no out": (["replay", "{bag}"], "replay needs --out DIR"),
    "missing bag": (["replay", "none.mcap", "--out", "{out}"], "none.mcap: no such file or folder"),
    "empty bag": (["replay", "{empty}", "--out", "{out}"], "empty.mcap: the file is empty"),
    "bag cut off too early": (["info", "{cut}"], "cut.mcap: no topic in it that is whole; cut.mcap: cut off after 0"),
    "fifo": (["info", "{fifo}"], "neither a file nor a folder"),
    "no recording": (["info", "{text}"], "text.mcap: not a readable recording"),
    "unknown topic": (
        ["replay", "{bag}", "--out", "{out}", "--odom", "/wheel"],
        "no topic /wheel in the recording; of nav_msgs/msg/Odometry there is /odom",
    ),
    "topic without a slash": (
        ["replay", "{bag}", "--out", "{out}", "--odom", "odom"],
        "no topic odom in the recording; of nav_msgs/msg/Odometry there is /odom",
    ),
    "wrong topic": (
        ["replay", "{bag}", "--out", "{out}", "--landmarks", "/odom"],
        "topic /odom is nav_msgs/msg/Odometry",
    ),
    "unknown parameter": (
        ["replay", "{bag}", "--out", "{out}", "--set", "a.b=1"],
        "unknown parameter 'a.b'; did you mean",
    ),
    "words of a parameter in another order": (
        ["replay", "{bag}", "--out", "{out}", "--set", "base_frame=base_footprint"],
        "unknown parameter 'base_frame'; did you mean 'frames.base'?",
    ),
    "setting without effect": (
        ["replay", "{bag}", "--out", "{out}", "--set", "calibrate.groups=auto"],
        "calibrate.groups' was removed: graph_slam calibrate BAG prints the settings",
    ),
    "no setting": (["replay", "{bag}", "--out", "{out}", "--set", "a.b"], "'a.b' is not key=value"),
    "missing config": (["replay", "{bag}", "--out", "{out}", "--config", "no.yaml"], "no.yaml: No such file"),
    "foreign folder": (
        ["replay", "{bag}", "--out", "{foreign}"],
        "not empty and not an earlier run; nothing was written",
    ),
    "out is a file": (["replay", "{bag}", "--out", "{text}"], "text.mcap: Not a directory"),
    "out is a run": (
        ["recover", "{run}", "--out", "{there}"],
        "holds a run already: choose another folder, or --force",
    ),
    "no parameter": (["params", "warp"], "no parameter matches 'warp'"),
    "no such shell": (["completion", "fish"], "invalid choice: 'fish'"),
    "own source": (["replay", "{run}", "--out", "{run}"], "cannot be read from and written to at once"),
    "rate": (["replay", "{bag}", "--ros", "--rate", "-1"], "argument --rate: -1 is not a positive number"),
    "unknown world": (["simulate", "mars", "--out", "{out}"], "no world 'mars'; there are pythonrobotics"),
    "world with a typo": (["simulate", "warehous", "--out", "{out}"], "did you mean 'warehouse'?"),
    "seed as an option": (["simulate", "manhattan", "--out", "{out}", "--set", "seed=3"], "--set seed: no option of a"),
    "a huge number": (
        ["simulate", "manhattan", "--out", "{out}", "--set", f"poses={10**400}"],
        "is not in [",
    ),
    "negative seed": (["simulate", "manhattan", "--out", "{out}", "--seed", "-1"], "seed -1 is negative"),
    "simulate nowhere": (["simulate", "manhattan", "--out", "/nowhere/a.mcap"], "/nowhere/a.mcap: No such file"),
    "missing graph": (["optimize", "none.g2o"], "none.g2o: no such file"),
    "unknown loss": (["optimize", "{text}", "--loss", "hubr"], "loss 'hubr': choose none, huber, cauchy"),
    "no graph": (["optimize", "{text}"], "no vertex in it of a kind that is known"),
    "truth is a run": (["evaluate", "{run}", "--truth", "{run}"], "a run, not the truth: graph_slam evaluate RUN"),
    "report of a recording": (
        ["report", "{bag}"],
        "not a run's folder, but a file: graph_slam replay BAG --out RUN makes a run of a recording",
    ),
    "evaluate no run": (["evaluate", "none", "--truth", "{bag}"], "none"),
    "no odometry that fits": (
        ["replay", "{bag}", "--out", "{out}", "--set", "frames.odom=world"],
        "no odometry of it could be used",
    ),
}


@each("case", REFUSED)
def test_what_is_refused_is_told_in_one_line_with_code_2_and_nothing_is_touched(case, bag, run, tmp_path, capsys):
    words, complaint = REFUSED[case]
    names = {"bag": bag, "run": run, "out": tmp_path / "out"}
    for name, file, content in (
        ("empty", "empty.mcap", ""),
        ("text", "text.mcap", "hello"),
        ("foreign", "f/notes", "mine"),
    ):
        names[name] = tmp_path / file
        names[name].parent.mkdir(exist_ok=True)
        names[name].write_text(content)
    names["there"] = shutil.copytree(run, tmp_path / "there")
    names |= {"foreign": tmp_path / "f", "cut": tmp_path / "cut.mcap", "fifo": tmp_path / "fifo.mcap"}
    os.mkfifo(names["fifo"])
    names["cut"].write_bytes(bag.read_bytes()[:5000])
    before = results(run)
    code, _, err = told(capsys, *(word.format(**names) for word in words))
    assert code == 2
    assert len(err) == 1, err
    assert err[0].startswith("graph_slam")
    assert complaint in err[0]
    assert results(run) == before
    assert [f.read_text() for f in (tmp_path / "f").iterdir()] == ["mine"]


# -- 3 and 1 --------------------------------------------------------------------------------------------------------


@each("command", ["replay", "info"])
def test_a_loss_is_told_and_ends_with_3_and_the_rest_is_done(long_bag, tmp_path, capsys, command):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(long_bag.read_bytes()[: int(long_bag.stat().st_size * 0.7)])
    words = [cut, "--out", tmp_path / "run"] if command == "replay" else [cut]
    code, _, err = told(capsys, command, *words)
    assert code == 3
    assert len(err) == 1
    assert err[0].startswith("graph_slam: lost: cut.mcap: cut off after ")
    if command == "replay":
        summary = json.loads((tmp_path / "run" / "run.json").read_text())
        assert [f"graph_slam: lost: {loss}" for loss in summary["losses"]] == err


def test_refused_messages_are_counted_and_shown_but_are_no_loss(bag, tmp_path, capsys):
    file = tmp_path / "a.mcap"
    with BagWriter(file) as writer:
        for k, m in enumerate(open_bag(bag).messages({"/odom"})):
            writer.write("/odom", "nav_msgs/msg/Odometry", m.log_ns, m.cdr[:50] if k % 10 == 3 else m.cdr)
    code, out, err = told(capsys, "replay", file, "--out", tmp_path / "run")
    assert (code, len(err)) == (3, 1)
    assert err[0].startswith("graph_slam: this is odometry alone: no landmark, fix or closure is in the result")
    refused = json.loads((tmp_path / "run" / "run.json").read_text())["counters"]["odom"]["undecodable"]
    assert refused > 5
    assert f"undecodable {refused}: the bytes are not a message of this type" in out


def test_a_fault_of_ours_is_one_line_with_code_1(bag, tmp_path, capsys, monkeypatch):
    def broken(*arguments, **options):
        raise ZeroDivisionError("division\nby zero")

    monkeypatch.setattr("graph_slam_ros.runs.replay.replay", broken)
    code, _, err = told(capsys, "replay", bag, "--out", tmp_path / "run")
    assert code == 1
    assert err == [
        "graph_slam: internal error, ZeroDivisionError: division by zero (GRAPH_SLAM_TRACEBACK=1 shows where)"
    ]


# -- as a process ---------------------------------------------------------------------------------------------------


def process(*words, **options):
    # a shell starts what it runs in the background with Ctrl-C ignored, and that is inherited
    heard = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [COMMAND, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
        )
    finally:
        signal.signal(signal.SIGINT, heard)


def test_the_installed_command_passes_its_exit_code_on(tmp_path):
    p = process("info", tmp_path / "none.mcap")
    out, err = p.communicate(timeout=60)
    assert (p.returncode, out) == (2, "")
    assert err == f"graph_slam: {tmp_path}/none.mcap: no such file or folder\n"


def test_ctrl_c_during_a_replay_is_one_line_and_code_130_and_leaves_nothing_behind(bag, long_bag, tmp_path, capsys):
    p = process("replay", long_bag, "--out", tmp_path / "run")
    deadline = time.monotonic() + 60
    while not (tmp_path / "run" / "ingest.mcap").exists():  # there from the first message on
        assert time.monotonic() < deadline
        time.sleep(0.001)
    p.send_signal(signal.SIGINT)
    _, err = p.communicate(timeout=30)
    assert p.returncode == 130
    assert err.splitlines() == ["graph_slam: interrupted: nothing is left half-written"]
    assert not list(tmp_path.iterdir())
    code, _, err = told(capsys, "replay", bag, "--out", tmp_path / "run")
    assert (code, err) == (0, [])


def test_without_ros_the_live_commands_say_so(bag, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli.console, "has_ros", lambda: False)
    code, _, err = told(capsys, "replay", bag, "--ros", "--out", tmp_path / "run")
    assert (code, len(err)) == (2, 1)
    assert "--ros needs ROS 2" in err[0]
    handler = signal.getsignal(signal.SIGINT)
    try:
        assert cli.node_main() == 2
    finally:
        signal.signal(signal.SIGINT, handler)
    assert capsys.readouterr().err == (
        "graph_slam_node: ROS 2 is not installed here (no rclpy); replay works without it\n"
    )


def test_a_reader_that_stops_reading_is_no_fault(bag):
    done = subprocess.run(
        f"{shlex.quote(str(COMMAND))} info {shlex.quote(str(bag))} | head -n 1; exit ${{PIPESTATUS[0]}}",
        shell=True,
        executable=shutil.which("bash"),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0
    assert done.stderr == ""
