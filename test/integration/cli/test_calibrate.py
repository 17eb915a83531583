"""The command ``calibrate``: settings that are wrong come back right, and applied they leave nothing to correct."""

import json
import re
import shlex

import pytest
from places import ROOT
from reliability import times
from rows import each

from graph_slam_ros.cli import main
from graph_slam_ros.formats.parameters import read_parameters
from graph_slam_ros.runs import calibrate as calibrate_module
from graph_slam_ros.runs.calibrate import calibrate
from graph_slam_ros.slam.calibration.parameters import QUANTITIES
from graph_slam_ros.slam.frontend.corrections import Corrections
from graph_slam_ros.tools.simulation import simulate, write_bag

SOAK = pytest.mark.skipif(not times(0, 1), reason="only in make soak")
DEMO = str(ROOT / "data" / "demo.mcap")
WRONG = ("--set", "detections.mount_correction=0 0 0 0 0 0.1", "--set", "odometry.distance_factor=1.08")


def test_wrong_settings_of_a_recording_come_back_right(laps, tmp_path, capsys):
    file = tmp_path / "found.yaml"
    assert main(["calibrate", str(laps), *WRONG, "--json", "--out", str(file)]) == 4
    found = json.loads(capsys.readouterr().out)
    assert found["settings"]["odometry.distance_factor"] == pytest.approx(1.0, abs=0.01)
    assert float(found["settings"]["detections.mount_correction"].split()[5]) == pytest.approx(0.0, abs=0.01)
    assert {one["verdict"] for one in found["parameters"]} == {"nothing_to_correct"}, "applied, they leave nothing"
    left = {one["name"] for one in found["parameters"] if re.search(": corrected, .* is left", one["text"])}
    assert left == {"distance", "yaw"}
    assert found["rounds"] > 1
    written = read_parameters(file)
    assert written["odometry"]["distance_factor"] == found["settings"]["odometry.distance_factor"]
    assert main(["calibrate", str(laps), "--out", str(file)]) != 0, "a file of somebody's is not replaced"
    assert read_parameters(file) == written


def test_a_recording_without_landmarks_determines_nothing_and_says_so(tmp_path, capsys):
    bag = str(tmp_path / "drive.mcap")
    assert main(["simulate", "manhattan", "--out", bag, "--poses", "60", "--set", "landmarks=false"]) == 0
    capsys.readouterr()
    assert main(["calibrate", bag]) == 3
    out, err = capsys.readouterr()
    said = " ".join(out.split())
    assert "distance of odom: not determined: 0 landmarks were seen, 3 are needed: drive 10 m and back in sight" in said
    assert "nothing to correct" not in out
    assert err == "graph_slam: this recording determines none of these parameters\n"
    assert main(["check", bag]) == 4, "what a replay calls odometry alone is no clean recording"
    assert "[warning] no_landmarks" in capsys.readouterr().out


@SOAK
def test_settings_with_which_less_is_believed_are_not_printed(tmp_path, monkeypatch, capsys):
    """A second replay with what was found shows that it does harm: here a sensor that looks the wrong way."""
    monkeypatch.setattr(calibrate_module, "FIRST_DUE", 10**6)
    monkeypatch.setattr(Corrections, "lines", lambda self: {"detections.mount_correction": "0 0 0 0 0 2.0"})
    bag = str(tmp_path / "drive.mcap")
    write_bag(simulate("warehouse", 3, aisles=2, aisle_m=4.0, laps=1), bag)
    assert main(["calibrate", bag]) == 3
    out, err = capsys.readouterr()
    assert "mount_correction" not in out
    assert "not used: detections.mount_correction=0 0 0 0 0 2.0: with it " in err


@SOAK
def test_a_sensor_that_is_elsewhere_is_said_instead_of_what_would_hide_it(laps, capsys):
    """A camera 0.3 m to the side makes odometry seem to be of another scale."""
    assert main(["calibrate", str(laps), "--set", "detections.mount_correction=0 0.3 0 0 0 0.1", "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert (found["settings"], found["parameters"]) == ({}, [])
    assert "mount_place: detections: its sensor is 0." in found["refused"]
    mount = re.search("--set detections.mount_correction='(.*)'", found["refused"])[1].split()
    assert float(mount[1]) == pytest.approx(0.0, abs=0.05)
    assert float(mount[5]) == 0.1, "which is calibrated next"
    assert main(["calibrate", str(laps), "--set", f"detections.mount_correction={' '.join(mount)}", "--json"]) == 4
    found = json.loads(capsys.readouterr().out)
    assert float(found["settings"]["detections.mount_correction"].split()[5]) == pytest.approx(0.0, abs=0.02)


@SOAK
def test_an_offset_of_ranges_is_said_instead_of_the_scale_that_would_hide_it(tmp_path, capsys):
    """The scale that passes for it makes the map, and the errors, larger."""
    bag, given = str(tmp_path / "drive.mcap"), ("--set", "ranges.range_offset_m=0.3")
    write_bag(simulate("warehouse", 3, aisles=3, laps=2, sensor="range_bearing"), bag)
    assert main(["calibrate", bag, *given]) == 3
    out, err = capsys.readouterr()
    assert "distance_factor" not in out
    found = re.search(r"ranges are 0\.\d+ m too long .*--set ranges.range_offset_m=(\S+)$", err, re.MULTILINE)
    assert float(found[1]) == pytest.approx(0.0, abs=0.04)
    command = out.splitlines()[-1].removeprefix("next: ")
    assert command.startswith("graph_slam calibrate ") and f"ranges.range_offset_m={found[1]}" in command
    assert main(shlex.split(command)[1:]) in (0, 4)
    assert " replay " in capsys.readouterr().out.splitlines()[-1]
    assert main(["check", bag, *given]) == 4
    out = capsys.readouterr().out
    assert "[warning] range_scale" in out
    assert "odometry_scale" not in out


@pytest.mark.parametrize(("how", "code"), [("mirrored", "mirrored"), *times([], [("backwards", "axes")])])
def test_a_recording_that_is_wrong_in_itself_is_not_calibrated_and_says_what_is_wrong(tmp_path, told, how, code):
    bag, faulty = str(tmp_path / "drive.mcap"), str(tmp_path / "faulty.mcap")
    write_bag(simulate("warehouse", 1, aisles=2, aisle_m=4.0, laps=1), bag)
    assert main(["simulate", bag, "--out", faulty, "--fault", f"wrong_axes:how={how}"]) == 0
    ended, out, err = told("calibrate", faulty)
    assert ended == 3
    assert out.startswith(f"[error] {code}: /landmarks: ")
    assert "nothing to correct" not in out
    assert out.endswith(f"next: graph_slam check {faulty}\n")
    assert err == f"graph_slam: nothing is calibrated: mend {code} first\n"


def test_a_robot_that_stood_says_for_each_parameter_what_to_drive(tmp_path, told):
    bag, still = str(tmp_path / "drive.mcap"), str(tmp_path / "still.mcap")
    write_bag(simulate("warehouse", 1, aisles=2, aisle_m=4.0, laps=1), bag)
    assert main(["simulate", bag, "--out", still, "--fault", "wrong_scale:distance=0,turn=0"]) == 0
    code, out, _ = told("calibrate", still, "--json")
    assert code == 3
    found = json.loads(out)["parameters"]
    assert [one["name"] for one in found] == ["distance", "turn", "clock", "yaw"]
    for one in found:
        assert QUANTITIES[one["name"]].manoeuvre in one["text"]


@each(
    "groups, why",
    [
        ("factors range_factor", "factors and range_factor are one scale"),
        ("auto range_factor", "factors and range_factor are one scale"),
        ("wheels", "--groups: 'wheels' is not auto or some of factors, turn_bias, clock"),
    ],
)
def test_what_cannot_be_told_apart_is_refused(capsys, groups, why):
    assert main(["calibrate", DEMO, "--groups", groups]) == 2
    assert why in capsys.readouterr().err


@SOAK
def test_a_fit_on_the_way_that_finds_something_begins_anew(laps):
    """A large error is found before the drive to its end makes it look like noise, slips or wrong identities."""
    read = []

    def counted(items, total):
        read.append(0)
        for one in items:
            read[-1] += 1
            yield one

    done = calibrate(laps, {"detections.offset_s": 0.2}, groups="clock", progress=counted)
    assert abs(float(done.settings["detections.offset_s"])) < 0.01
    assert done.is_complete
    assert {one["name"] for one in done.parameters} == {"clock"}
    assert done.rounds == len(read) > 1
    assert read[0] < 0.7 * read[-1]
