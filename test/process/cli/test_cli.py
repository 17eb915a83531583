"""The command line: every exit code, one line for what is refused, never a traceback."""

import json
import re
import shlex
import shutil
import signal
import subprocess
import time

import pytest
from places import executable
from rows import each

from graph_slam_ros import __version__, cli
from graph_slam_ros.cli.parser import COMMANDS, parser
from graph_slam_ros.config.config import parameters

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


def test_replay_says_what_happened_and_repeats_and_a_setting_changes_it(bag, run, tmp_path, capsys):
    code, out, err = told(capsys, "replay", run, "--out", tmp_path / "same")
    assert (code, err) == (0, [])
    summary = json.loads((tmp_path / "same" / "run.json").read_text())
    for number in (summary["keyframes"], summary["landmarks"], summary["edges"], f"{summary['chi2']:.3f}"):
        assert f" {number}" in out
    assert f"results in {tmp_path / 'same'}" in out
    assert results(tmp_path / "same") == results(run)
    (tmp_path / "mine.yaml").write_text("keyframes:\n  min_distance_m: 0.7\nsolve:\n  every_keyframes: 7\n")
    options = ("--config", tmp_path / "mine.yaml", "--set", "solve.every_keyframes=9")
    assert told(capsys, "replay", run, "--out", tmp_path / "other", *options)[0] == 0
    used = (tmp_path / "other" / "config.yaml").read_text()
    assert "min_distance_m: 0.7" in used and "every_keyframes: 9" in used
    assert results(tmp_path / "other") != results(run)


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


TYPED = [
    (("repl",), {"replay"}),
    (("completion", ""), {"bash", "zsh"}),
    (("optimize", "--init", "c"), {"chordal"}),
    (("replay", "bag", "--fo"), {"--force"}),
    (("map", "e"), {"edit", "export"}),
    (("map", "export", "run", "--la"), {"--last-drive"}),
    (("info", "dr"), {"drive.mcap"}),
]


def test_a_shell_completes_commands_options_choices_and_files(tmp_path, capsys):
    (tmp_path / "drive.mcap").touch()
    options = {"capture_output": True, "text": True, "timeout": 60, "cwd": tmp_path}
    if shutil.which("zsh"):  # whose completion runs in its line editor alone: it loads without a complaint
        done = subprocess.run(["zsh", "-f", "-c", told(capsys, "completion", "zsh")[1]], **options)
        assert (done.returncode, done.stderr) == (0, "")
    script = told(capsys, "completion", "bash")[1]
    for typed, _ in TYPED:
        words = " ".join(shlex.quote(word) for word in ("graph_slam", *typed))
        script += (
            f'\nCOMP_WORDS=({words}); COMP_CWORD={len(typed)}; COMPREPLY=(); _graph_slam; echo "${{COMPREPLY[*]}}"'
        )
        script += f'; [ -n "${{COMPREPLY[*]}}" ] || compgen -f -- {shlex.quote(typed[-1])}'  # -o default
    done = subprocess.run(["bash", "-c", script], **options)
    assert done.stderr == ""
    assert [set(line.split()) for line in done.stdout.splitlines() if line] == [offered for _, offered in TYPED]


def test_each_command_ends_with_a_line_of_what_to_do_next(bag, run, tmp_path, capsys):
    for words in (
        ("recover", run, "--out", tmp_path / "a_run"),
        ("map", "export", run, "--out", tmp_path / "a.g2o"),
        ("optimize", tmp_path / "a.g2o"),
        ("optimize", tmp_path / "a.g2o", "--out", tmp_path / "a.tum"),
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


REFUSED = [
    ("", "graph_slam: the following arguments are required: COMMAND"),
    ("fly", "invalid choice: 'fly'"),
    ("merge a b", "; graph_slam map merge (--help"),
    ("replya {bag}", "did you mean 'replay'?"),
    ("replay {bag} --frce", "arguments: --frce; did you mean '--force'?"),
    ("check {bag} --set odom.use none", "--set odom.use: a setting is KEY=VALUE, no spaces around ="),
    ("info {bag}x", "no such file or folder; did you mean 'drive it.mcap'?"),
    ("replay {bag} --odom /odm --out {out}", "did you mean '/odom'?"),
    ("replay {bag} --out {out} --set tf.stamp=odometri", "did you mean 'odometry'?"),
    ("simulate warehouse --out {out}.mcap --fault wrong_mout --fault wrong_ids", "did you mean 'wrong_mount'?"),
    ("fleet replay {bag} --config no.yaml --config {text} --out {out}", "no.yaml"),
    ("check {bag} {cut}", "cut.mcap is one recording too many: put the parts of one drive into a folder"),
    ("replay", "graph_slam replay: the following arguments are required: BAG"),
    ("replay {bag}", "replay needs --out DIR"),
    ("replay none.mcap --out {out}", "none.mcap: no such file or folder"),
    ("info {cut}", "cut.mcap: no topic in it that is whole; cut.mcap: cut off after 0"),
    ("replay {bag} --out {out} --odom odom", "no topic odom in the recording; of nav_msgs/msg/Odometry there is /odom"),
    ("replay {bag} --out {out} --landmarks /odom", "topic /odom is nav_msgs/msg/Odometry"),
    ("replay {bag} --out {out} --set calibrate.groups=auto", "calibrate.groups' was removed: graph_slam calibrate BAG"),
    ("replay {bag} --out {out} --config no.yaml", "no.yaml: No such file"),
    ("replay {bag} --out {foreign}", "not empty and not an earlier run; nothing was written"),
    ("replay {bag} --out {text}", "text.mcap: Not a directory"),
    ("recover {run} --out {there}", "holds a run already: choose another folder, or --force"),
    ("params warp", "no parameter matches 'warp'"),
    ("replay {run} --out {run}", "cannot be read from and written to at once"),
    ("replay {bag} --ros --rate -1", "argument --rate: -1 is not a positive number"),
    ("simulate mars --out {out}", "no world 'mars'; there are pythonrobotics"),
    ("simulate manhattan --out {out} --set seed=3", "--set seed: no option of a"),
    (f"simulate manhattan --out {{out}} --set poses={10**400}", "is not in ["),
    ("simulate manhattan --out {out} --seed -1", "seed -1 is negative"),
    ("simulate manhattan --out /nowhere/a.mcap", "/nowhere/a.mcap: No such file"),
    ("optimize none.g2o", "none.g2o: no such file"),
    ("optimize {text}", "no vertex in it of a kind that is known"),
    ("evaluate {run} --truth {run}", "a run, not the truth: graph_slam evaluate RUN"),
    ("report {bag}", "not a run's folder, but a file: graph_slam replay BAG --out RUN makes a run of a recording"),
    ("replay {bag} --out {out} --set frames.odom=world", "no odometry of it could be used"),
]


@pytest.fixture(scope="module")
def files(bag, run, tmp_path_factory):
    """What the rows name."""
    there = tmp_path_factory.mktemp("files")
    names = {"bag": bag, "run": run, "out": there / "out", "there": shutil.copytree(run, there / "there")}
    names |= {name: there / f"{name}.mcap" for name in ("text", "cut")} | {"foreign": there / "f"}
    names["text"].write_text("hello")
    names["foreign"].mkdir()
    (names["foreign"] / "notes").write_text("mine")
    names["cut"].write_bytes(bag.read_bytes()[:5000])
    return names


@each("words, complaint", REFUSED)
def test_what_is_refused_is_told_in_one_line_with_code_2_and_nothing_is_touched(words, complaint, files, capsys):
    before = results(files["run"])
    code, _, err = told(capsys, *(word.format(**files) for word in words.split()))
    assert (code, len(err)) == (2, 1), err
    assert err[0].startswith("graph_slam")
    assert complaint in err[0]
    assert results(files["run"]) == before
    assert [f.read_text() for f in files["foreign"].iterdir()] == ["mine"]


def test_a_loss_is_told_and_ends_with_3_and_the_rest_is_done(long_bag, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(long_bag.read_bytes()[: int(long_bag.stat().st_size * 0.7)])
    for words in (["replay", cut, "--out", tmp_path / "run"], ["info", cut]):
        code, _, err = told(capsys, *words)
        assert (code, len(err)) == (3, 1)
        assert err[0].startswith("graph_slam: lost: cut.mcap: cut off after ")
        summary = json.loads((tmp_path / "run" / "run.json").read_text())
        assert [f"graph_slam: lost: {loss}" for loss in summary["losses"]] == err


def test_a_fault_of_ours_is_one_line_with_code_1(bag, tmp_path, capsys, monkeypatch):
    def broken(*arguments, **options):
        raise ZeroDivisionError("division\nby zero")

    monkeypatch.setattr("graph_slam_ros.runs.replay.replay", broken)
    code, _, err = told(capsys, "replay", bag, "--out", tmp_path / "run")
    assert code == 1
    told_as = "internal error, ZeroDivisionError: division by zero (GRAPH_SLAM_TRACEBACK=1 shows where)"
    assert err == [f"graph_slam: {told_as}"]


def test_the_installed_command_passes_its_exit_code_on(tmp_path):
    done = subprocess.run([COMMAND, "info", tmp_path / "none.mcap"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"graph_slam: {tmp_path}/none.mcap: no such file or folder\n"


def test_ctrl_c_during_a_replay_is_one_line_and_code_130_and_leaves_nothing_behind(long_bag, tmp_path):
    # a shell starts what it runs in the background with Ctrl-C ignored, and that is inherited
    heard = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        command = [COMMAND, "replay", str(long_bag), "--out", str(tmp_path / "run")]
        p = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, heard)
    deadline = time.monotonic() + 60
    while not (tmp_path / "run" / "ingest.mcap").exists():  # there from the first message on
        assert time.monotonic() < deadline
        time.sleep(0.001)
    p.send_signal(signal.SIGINT)
    _, err = p.communicate(timeout=30)
    assert p.returncode == 130
    assert err.splitlines() == ["graph_slam: interrupted: nothing is left half-written"]
    assert not list(tmp_path.iterdir())


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
    node = "graph_slam_node: ROS 2 is not installed here (no rclpy); replay works without it\n"
    assert capsys.readouterr().err == node


def test_a_reader_that_stops_reading_is_no_fault(bag):
    asked = f"{shlex.quote(str(COMMAND))} info {shlex.quote(str(bag))} | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
