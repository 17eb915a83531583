"""``fleet tune`` and ``fleet simulate`` with real workers."""

import json
import subprocess
import sys

import pytest

pytest.importorskip("distributed", reason="the extra fleet is not installed")

from graph_slam_ros import cli
from graph_slam_ros.config.config import flatten
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.tools.fleet.table import read_table

ADDED = "landmarks.added_sigma_m"


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Two drives whose sightings have some 0.4 m more noise than they say, and one with next to no sightings."""
    folder = tmp_path_factory.mktemp("drives")
    for name, seed, fault in (("a", 1, "noisy:factor=2"), ("b", 2, "noisy:factor=2"), ("blind", 3, "blind:after=0.05")):
        words = ["simulate", "pythonrobotics", "--out", str(folder / f"{name}.mcap"), "--seed", str(seed)]
        assert cli.main([*words, "--fault", fault, "--set", "poses=25"]) == 0
    return folder


def fleet(*arguments):
    command = [sys.executable, "-m", "graph_slam_ros.cli", "fleet", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def stamps(out):
    return {file: file.stat().st_mtime_ns for file in out.glob("jobs/*/row.json")}


def test_a_noise_that_is_too_small_is_found_and_nothing_runs_twice(drives, tmp_path):
    out = tmp_path / "out"
    options = ("--parameters", f"{ADDED},odometry.tilt_density", "--set", f"{ADDED}=0.15", "--trials", 2)
    words = ("tune", drives, *options, "--truth", "{path}", "--out", out, "--workers")
    done = fleet(*words, 2)
    assert done.returncode == 3, done
    assert "not tuned on: blind.mcap: no held-out likelihood" in done.stderr
    found = dict(flatten(read_parameters(out / "tuned.yaml")))
    assert list(found) == [ADDED]
    assert 0.3 < found[ADDED] < 0.6
    assert "odometry.tilt_density: left at 0.02: it changes no result" in done.stdout
    assert "each with the values of the others" in done.stdout
    assert "rmse_m" in done.stdout
    assert not list(out.glob("jobs/*/run")), "of a tuning the rows are enough"
    refused = fleet(*words, 2)
    assert refused.returncode == 2
    assert "tuned.yaml: exists already, and is not replaced" in refused.stderr
    text = (out / "tuned.yaml").read_text()
    (out / "tuned.yaml").rename(out / "first.yaml")
    before = stamps(out)
    assert fleet(*words, 1).returncode == 3
    assert (out / "tuned.yaml").read_text() == text
    assert stamps(out) == before, "every run was there"


def test_mistakes_of_a_tuning_are_refused_in_one_line(drives, tmp_path, capsys):
    out, bags = str(tmp_path / "o"), str(drives)
    for words, says in (
        (("--parameters", "landmarks.added"), "--parameters landmarks.added: no parameter has this name"),
        (("--parameters", "odometry.noise"), "is 'twist': only a number above 0 is tuned"),
        (("--parameters", ADDED, "--objective", "rmse"), "--objective rmse: needs the truth"),
        (("--parameters", ADDED, "--set", f"{ADDED}=0.1,0.2"), "begins at one configuration"),
    ):
        assert cli.main(["fleet", "tune", bags, *words, "--out", out]) == 2
        said = capsys.readouterr().err
        assert says in said
        assert len(said.splitlines()) == 1
    assert not (tmp_path / "o").exists(), "nothing was begun"
    blind = str(drives / "blind.mcap")
    assert cli.main(["fleet", "tune", blind, "--parameters", ADDED, "--workers", "1", "--out", out]) == 2
    assert "no trial finished: no recording has a score, as blind.mcap: no held-out" in capsys.readouterr().err


def test_worlds_are_simulated_where_they_are_replayed_and_scored_by_their_truth(tmp_path):
    out = tmp_path / "out"
    words = ("simulate", "pythonrobotics", "--seeds", 2, "--fault", "wrong_ids:rate=0.05", "wrong_gyro")
    options = ("--set", "poses=30", "--set", "robust.decide=true", "--workers", 1, "--out", out)
    done = fleet(*words, *options)
    assert done.returncode == 3, done
    assert "failed: pythonrobotics poses=30 wrong_gyro seed 0 (robust.decide=true): wrong_gyro: needs" in done.stderr
    rows = read_table(out, where="state = 'done'")
    assert {(row["world"], row["fault"], row["seed"]) for row in rows} == {
        ("pythonrobotics poses=30", fault, seed) for fault in ("none", "wrong_ids:rate=0.05") for seed in (0, 1)
    }
    assert all(row["rmse_m"] > 0.0 and row["nees"] > 0.0 for row in rows)
    by_seed = {(row["fault"], row["seed"]): row for row in rows}
    bag = tmp_path / "alone.mcap"
    assert cli.main(["simulate", "pythonrobotics", "--out", str(bag), "--seed", "1", "--set", "poses=30"]) == 0
    assert cli.main(["replay", str(bag), "--out", str(tmp_path / "alone")]) == 0
    own = out / "jobs" / by_seed["none", 1]["key"] / "run"
    assert (own / "path.tum").read_bytes() == (tmp_path / "alone/path.tum").read_bytes()
    line = next(line for line in done.stdout.splitlines() if line.startswith("pythonrobotics poses=30 none"))
    mean = sum(by_seed["none", seed]["rmse_m"] for seed in (0, 1)) / 2
    assert f"{mean:.4g}" in line
    assert json.loads((own.parent / "row.json").read_text())["fault"] == "none"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("warehous",), "no world 'warehous'; there are"),
        (("warehouse", "--set", "aisle=3"), "aisle"),
        (("warehouse", "--set", "robust.decid=true"), "unknown parameter"),
        (("warehouse", "--fault", "wrong_id"), "no fault 'wrong_id'; there are"),
    ],
)
def test_a_sweep_of_what_does_not_exist_is_refused(tmp_path, capsys, words, says):
    assert cli.main(["fleet", "simulate", *words, "--out", str(tmp_path / "o")]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
