"""Faults that are planted into a recording are found under their names; ``planted_faults.py`` has all of them."""

import numpy as np
import pytest
from planted_faults import FAULTS, of, planted
from reliability import times

from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.cli import main
from graph_slam_ros.findings.table import CHECKED
from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.runs.check import check
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import Drive, Fault, put_faults, simulate, write_bag, write_faulty_bag
from graph_slam_ros.tools.simulation.drive import Sightings

SOAK = pytest.mark.skipif(not times(0, 1), reason="only in make soak")
RANGES = ("warehouse", 2, {"aisles": 3, "laps": 2, "sensor": "range_bearing"})
SELECTED = (
    *("landmark clock +400 ms", "landmarks by uptime", "clock set back by 30 s", "odometry out of order by 0.2 s"),
    *("turn rate mirrored", "twist in degrees", "odometry in millimetres", "optical frame called base_link"),
    *("mount turned 180 degrees", "sensor frame without TF", "sensor frame with two parents"),
    *("twist in the odom frame", "twist sigma 1e-6", "twist variance 1000", "negative variance"),
    *("identities of tracks", "odometry stands", "NaN in odometry", "file cut off", "no landmarks", "no odometry"),
    *("landmarks of another definition", "an id twice in a message", "landmark sigma 1e-6"),
    *("an id for each sighting", "position of odometry mirrored, turns right", "pose in feet, twist in metres"),
)


def half_unnamed(drive):
    for m in drive.landmarks:
        seen = Sightings(m)
        seen.ids = ["" if k % 2 else name for k, name in enumerate(seen.ids)]
        seen.store()


def ramp(drive):
    poses = drive.poses
    poses[:, 2] += np.linspace(0.0, 5.0, len(poses))
    drive.poses = poses


def shaken(drive):
    rng = np.random.default_rng(1)
    for m in drive.odometry:
        m.content.twist.twist.linear.x, m.content.twist.twist.angular.z = map(float, rng.normal(size=2))


def unturned(drive):
    poses = drive.poses
    poses[:, 3:] = 0.0, 0.0, 0.0, 1.0
    drive.poses = poses


def at(mount):
    return {"detections.frame": "camera", "detections.mount": mount}


PLANTED = {name: (FAULTS[name][0], FAULTS[name][1].split(), {}) for name in SELECTED} | {
    "half of the landmarks without identity": (half_unnamed, ["no_id"], {}),
    "a ramp": (ramp, ["out_of_plane"], {"world.dimensions": 2}),
    "odometry without orientation": (unturned, ["no_orientation_of_odometry"], {}),
    "a twist of noise": (shaken, ["twist_unrelated"], {}),
    "a transform inverted": (of("wrong_mount:yaw_deg=68.755,x_m=0.5"), ["axes"], at("-0.181 0.466 0 0 0 -1.2")),
    "an optical transform, the robot's axes": (of(), ["axes"], at("0 0 0 -1.5708 0 -1.5708")),
}
QUICK = (
    *("landmark clock +400 ms", "turn rate mirrored", "twist in degrees", "mount turned 180 degrees"),
    *("sensor frame with two parents", "negative variance", "identities of tracks", "file cut off", "a twist of noise"),
    *("pose in feet, twist in metres", "a transform inverted", "position of odometry mirrored, turns right"),
)
"""In every ``make test``; all of them in ``make soak``."""


def recorded(folder, *, aisle_m=4.0, laps=1, sensor="pose"):
    write_bag(simulate("warehouse", 3, aisles=2, aisle_m=aisle_m, laps=laps, sensor=sensor), folder / "drive.mcap")
    return folder / "drive.mcap"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("planted"))


def test_a_drive_without_a_fault_has_no_finding(drive):
    assert check(drive, quick=True).findings == []


@pytest.mark.parametrize("name", times(QUICK, PLANTED))
def test_a_planted_fault_is_found_and_its_settings_mend_it(drive, tmp_path, name):
    put, codes, settings = PLANTED[name]
    faulty, bag = Drive(drive), tmp_path / "faulty.mcap"
    put(faulty)
    faulty.write(bag)
    found = [one for one in check(bag, settings, quick=True).findings if one.code in codes]
    assert found
    for one in found:
        if one.settings:
            mended = check(bag, settings | dict(parse_setting(text) for text in one.settings), quick=True).findings
            assert one.code not in {other.code for other in mended}


@pytest.mark.parametrize(
    ("sensor", "fault", "code"),
    [
        ("range", "wrong_units:factor=3.28084", "units"),
        *times([], [("range", "wrong_units", "units"), ("bearing", "wrong_axes:how=mirrored", "mirrored")]),
        *times([], [("bearing", "wrong_units:of=bearings,factor=57.29578", "bearing_out_of_range")]),
    ],
)
def test_other_units_of_ranges_or_bearings_alone_are_found_and_no_replay_is_offered(
    tmp_path, capsys, sensor, fault, code
):
    bag = recorded(tmp_path, sensor=sensor)
    assert not [one for one in check(bag, quick=True).findings if one.severity != "note"]
    assert main(["simulate", str(bag), "--out", str(tmp_path / "wrong.mcap"), "--fault", fault]) == 0
    capsys.readouterr()
    assert main(["check", str(tmp_path / "wrong.mcap")]) == 4
    said = capsys.readouterr().out
    assert f"[error] {code}: " in said
    assert "next: correct what is an error, then check again" in said


@pytest.mark.parametrize(
    ("sensor", "setting"), [("range", "ranges.sigma_m=0.5"), *times([], [("bearing", "points.sigma_rad=0.02")])]
)
def test_ranges_or_bearings_alone_whose_covariance_is_nearly_zero_are_found_and_mended(tmp_path, sensor, setting):
    bag = recorded(tmp_path, sensor=sensor)
    faulty = planted(bag, tmp_path / "wrong.mcap", "landmark sigma 1e-6")
    (one,) = check(faulty, quick=True).findings
    assert one.code == "noise_zero"
    assert setting in one.settings
    assert check(faulty, dict(parse_setting(text) for text in one.settings), quick=True).findings == []


def test_faults_can_be_put_into_a_recording_of_a_user_but_not_those_that_need_the_truth(drive, tmp_path, capsys):
    out = tmp_path / "bad.mcap"
    assert main(["simulate", str(drive), "--out", str(out), "--fault", "wrong_units:factor=1000.0"]) == 0
    assert main(["check", str(out), "--quick"]) == 4
    assert "[error] units" in capsys.readouterr().out
    for words, why in (
        (["--fault", "slip"], "needs the truth of a world"),
        (["--fault", "wrong_units:of=bearings"], "the landmarks of this recording have no bearings"),
        ([], "no --fault"),
        (["--fault", "missing", "--poses", "5"], "no use for --poses"),
    ):
        assert main(["simulate", str(drive), "--out", str(tmp_path / "b.mcap"), *words]) == 2
        assert why in capsys.readouterr().err
    assert main(["simulate", str(drive), "--out", str(drive), "--fault", "missing", "--force"]) == 2
    assert main(["simulate", "city", "--out", str(tmp_path / "c.g2o"), "--fault", "missing"]) == 2
    assert "a graph has no messages" in capsys.readouterr().err


FITTED = (
    ("landmark clock +100 ms", "clock_offset", -0.1, 0.02),
    ("knocked by 10 degrees half-way", "mount_moved", 0.14, 0.05),
    ("mount turned 5 degrees", "mount_yaw", 0.0873, 0.01),
    ("sensor 0.3 m to the left of its mount", "mount_place", 0.3, 0.04),
    ("sensor 0.4 m behind its mount", "mount_place", -0.4, 0.04),
    ("odometry scaled 0.9", "odometry_scale", 0.111, 0.02),
    ("two landmarks share an identity", "id_reused", None, None),
    ("track width 8 % wrong", "turn_scale", -0.074, 0.02),
    ("noise 8 times its covariance", "over_confident", None, None),
    ("a tenth of the drive", "not_observable", None, None),
    ("wheels slip for a twentieth", "odometry_slips", 1.0, 0.5),
    ("carried for a tenth", "odometry_slips", None, None),
    ("six landmarks moved by 2 m", "map_breaks", None, None),
    ("5 % of sightings too far", "outliers", 0.05, 0.015),
)


def error_m(bag, settings, run):
    replay(bag, bag.with_name(run), Config.from_mapping(settings))
    return evaluate(bag.with_name(run), bag).estimate.position_m["rmse"]


def found_and_mended(bag, code, settings):
    """The finding, and the errors and warnings with the settings that it prints, with which the path is no worse."""
    found = {one.code: one for one in check(bag, settings).findings}
    assert code in found
    printed = dict(parse_setting(text) for text in found[code].settings)
    mended = check(bag, settings | printed).findings if printed else []
    if printed:
        assert error_m(bag, settings | printed, "mended") < 1.02 * error_m(bag, settings, "as_it_is") + 0.002
    return found[code], {one.code for one in mended if one.severity != "note"}


@pytest.mark.parametrize("name, code, value, within", times([FITTED[k] for k in (0, 1, 7, 9)], FITTED))
def test_the_fit_finds_what_needs_an_estimate_and_its_settings_mend_it(laps, tmp_path, name, code, value, within):
    found, mended = found_and_mended(planted(laps, tmp_path / "faulty.mcap", name), code, {})
    assert value is None or found.value == pytest.approx(value, abs=within)
    assert code not in mended


@pytest.mark.parametrize("seed", [1, 2, 5])
@SOAK
def test_a_fit_of_ranges_of_which_many_are_too_long_is_not_trusted(tmp_path, seed):
    """It may shrink the map to a twelfth: then few ranges do not fit."""
    bag = tmp_path / "ranges.mcap"
    world = simulate("warehouse", seed, aisles=2, laps=2, sensor="range")
    write_faulty_bag(world, bag, [Fault.named("outliers", rate=0.4, most_m=2.0)], seed)
    found = {one.code: one for one in check(bag).findings}
    assert found["fit_unsure"].severity == "warning"
    assert {"clock_offset", "mount_yaw", "odometry_scale", "turn_scale"} & found.keys() == set()


def test_random_identities_are_no_wrong_axes(laps, tmp_path):
    """In the plane, a sensor whose axes were turned upwards would see everything near itself."""
    drive = Drive(laps)
    put_faults(drive, [Fault.named("random_ids", rate=0.6)], seed=1)
    drive.write(tmp_path / "faulty.mcap")
    errors = [one.code for one in check(tmp_path / "faulty.mcap", quick=True).findings if one.severity == "error"]
    assert errors == ["unrelated"]


def test_a_replay_says_before_the_work_what_makes_its_result_meaningless(drive, tmp_path, monkeypatch):
    monkeypatch.setattr("graph_slam_ros.runs.replay._READ_AHEAD", 1_500)
    bag, run, said = planted(drive, tmp_path / "mirrored.mcap", "bearings mirrored"), tmp_path / "run", []

    def warn(text):
        assert not run.exists()
        said.append(text)

    done = replay(bag, run, Config(), warn=warn)
    (one,) = said
    assert one.startswith("the result will mean nothing: mirrored: ")
    assert done.summary["check"]["code"] == "mirrored"


@pytest.mark.parametrize(("read_ahead", "says"), [(20_000, True), (1_500, False)])
def test_of_a_part_only_is_said_what_the_rest_does_not_make_right(drive, tmp_path, monkeypatch, read_ahead, says):
    """A transform may still come."""
    monkeypatch.setattr("graph_slam_ros.runs.replay._READ_AHEAD", read_ahead)
    bag, said = planted(drive, tmp_path / "unlinked.mcap", "sensor frame without TF"), []
    replay(bag, tmp_path / "run", Config(), warn=said.append)
    assert ["frame_unlinked" in text for text in said] == [True] * says


def test_each_finding_is_planted():
    elsewhere = {"gyro_scale", "gyro_bias", "gyro_unrelated"}  # test_gyro_findings.py
    elsewhere |= {"range_scale", "fit_unsure", ROUGH}  # test_recordings.py, and above
    elsewhere |= {"constant_stamps", "coarse_stamps", "rounded_stamps"}  # test_input_check.py, test_recordings.py
    of_others = "wrong_stamps pose_stands fix_mirrored fix_frozen fix_jumps heading_clockwise heading_offset"
    elsewhere |= {*of_others.split()}  # test_recordings_of_others.py
    elsewhere |= {"landmark_moves", "odometry_short"}  # test_moving_landmarks.py
    tested = {code for _, codes, _ in PLANTED.values() for code in codes}
    assert CHECKED.keys() - {code for _, codes in FAULTS.values() for code in codes.split()} - tested == elsewhere


@pytest.mark.parametrize("seconds", times([0.2], [0.2, -0.2]))
def test_a_clock_that_is_set_on_the_way_is_found_by_the_fit_and_by_the_times_of_recording(laps, tmp_path, seconds):
    faulty = Drive(laps)
    put_faults(faulty, [Fault.named("clock_offset", seconds=seconds, begin=0.5)], seed=1)
    faulty.write(tmp_path / "faulty.mcap")
    by = {one.severity: one for one in check(tmp_path / "faulty.mcap").findings if one.code == "clock_jump"}
    assert by["warning"].value == pytest.approx(-seconds, abs=0.08)


ROUGH = "odometry_over_confident"


@SOAK
def test_odometry_that_is_rougher_than_it_says_is_found_and_its_setting_mends_it(tmp_path):
    bag = recorded(tmp_path, aisle_m=6.0, laps=5)
    drive = Drive(bag)
    poses = drive.poses
    poses[:, :2] += np.random.default_rng(1).normal(0.0, 0.015, (len(poses), 2)).cumsum(axis=0)
    drive.poses = poses
    drive.write(bag)
    configured = {"odometry.doubt": False, "robust.noise_scale": "configured"}
    found, mended = found_and_mended(bag, ROUGH, configured)
    assert (found.severity, found.settings) == ("warning", ("robust.noise_scale=estimated",))
    assert ROUGH not in mended
    allowed, _ = found_and_mended(bag, ROUGH, {"odometry.doubt": False})
    assert (allowed.severity, allowed.settings) == ("note", ()) and "a run allows for it" in allowed.text


@pytest.mark.parametrize(
    ("world", "dimensions", "how"), times([RANGES], [RANGES, ("warehouse", 2, {}), ("flight", 3, {})])
)
def test_what_a_robot_sees_while_it_is_carried_is_no_second_landmark(tmp_path, world, dimensions, how):
    write_bag(simulate(world, 3, **how), tmp_path / "right.mcap")
    file = planted(tmp_path / "right.mcap", tmp_path / "carried.mcap", "carried for a tenth")
    found = check(file, {"world.dimensions": dimensions}).findings
    assert [one.code for one in found if one.severity != "note"] == ["odometry_slips"]
