"""One run after another in a folder: what one leaves is what the next finds, and nothing is lost on the way."""

import errno
import fcntl
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from graph_slam_ros.maps.merge import merge
from graph_slam_ros.measurements.types import Fix, Odometry
from graph_slam_ros.node.session import Session
from graph_slam_ros.runs.folder import RunError, changed_since, is_cut_off, is_run, run_config
from graph_slam_ros.runs.map_file import read_map
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import complete, map_of, recover
from graph_slam_ros.slam import Config, Control, Counters
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.tools.simulation import measurements, simulate, write_bag

WORLD = tuple(measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0)))
MUNICH, OSLO = (48.0, 11.0, 500.0), (60.0, 11.0, 100.0)


def session(folder, border=None, told=None, **config):
    values = {"output.folder": str(folder)} | {name.replace("__", "."): value for name, value in config.items()}
    tell = (lambda *_: None) if told is None else (lambda *said: told.append(said))
    return Session(Config.from_mapping(values), border or Counters(), lambda *_: None, tell)


def with_fixes(datum):
    for m in WORLD[:60]:
        yield m
        yield Fix(m.stamp_ns, "gps", "position", (0.0, 0.0), (1.0, 0.0, 0.0, 1.0), (), datum)


def test_fixes_from_another_datum_are_refused_also_in_a_map_that_was_taken_up(tmp_path):
    first = session(tmp_path / "run")
    first.ingest(list(with_fixes(MUNICH)))
    first.abandon()
    again = session(tmp_path / "run")
    again.load("")
    assert again.slam.view.datum == MUNICH
    fixes = len(again.slam.view.graph.edges_of("fixes"))
    later = WORLD[60:90]
    for m in later:
        again.ingest([m, Fix(m.stamp_ns, "gps", "position", (0.0, 0.0), (1.0, 0.0, 0.0, 1.0), (), OSLO)])
    again.finish()
    assert again.slam.counters["gps", "other_datum"] > 20
    assert len(again.slam.view.graph.edges_of("fixes")) == fixes > 3


def test_maps_whose_fixes_are_from_other_datums_are_not_merged(tmp_path):
    for name, datum in (("a", MUNICH), ("b", OSLO)):
        one = session(tmp_path / name)
        one.ingest(list(with_fixes(datum)))
        one.finish()
    with pytest.raises(Exception, match="configure one datum"):
        merge(tmp_path / "a", tmp_path / "b", tmp_path / "out")


def test_what_was_set_on_the_way_is_in_effect_in_what_is_made_of_the_map(tmp_path):
    one = session(tmp_path / "run")
    one.ingest([*WORLD[:50], Control("set", (("robust.gate", 0.5),)), *WORLD[50:90]])
    one.abandon()
    assert run_config(tmp_path / "run").robust.gate != 0.5
    assert map_of(tmp_path / "run", []).settings == {"robust.gate": 0.5}
    recover(tmp_path / "run", tmp_path / "out")
    assert run_config(tmp_path / "out").robust.gate == 0.5


def test_a_folder_that_is_being_recorded_into_is_left_alone_by_everybody_else(tmp_path):
    one = session(tmp_path / "run")
    one.ingest(WORLD[:60])
    bag = tmp_path / "drive.mcap"
    write_bag(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0), bag)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    for other in (
        lambda: session(tmp_path / "run"),
        lambda: replay(bag, tmp_path / "run"),
        lambda: RunRecorder(tmp_path / "run", Config()),
    ):
        with pytest.raises(RunError, match="another process records there"):
            other()
    assert sorted(path.name for path in tmp_path.rglob("*")) == before
    one.ingest(WORLD[60:90])
    one.finish()
    assert len(read_map(tmp_path / "run").keyframes) == len(one.slam.view.keyframes)
    session(tmp_path / "run").finish()
    assert is_run(tmp_path / "run-1")


def test_where_the_file_system_has_no_locks_it_is_recorded_all_the_same(tmp_path, monkeypatch):
    for number in (errno.EOPNOTSUPP, errno.ENOLCK, errno.EBADF):

        def refuse(fd, how, number=number):
            raise OSError(number, "no locks")

        monkeypatch.setattr(fcntl, "flock", refuse)
        one = session(tmp_path / f"run_{number}")
        one.ingest(WORLD[:20])
        assert one.finish() == str(tmp_path / f"run_{number}")


def in_a_map(tmp_path):
    """A run that begins in the map of an earlier one, saved twice on its way."""
    first = session(tmp_path / "run")
    first.ingest(WORLD[:60])
    first.finish()
    one = session(tmp_path / "run")
    one.load("run-1")
    for some in (WORLD[60:90], WORLD[90:120]):
        one.ingest(some)
        one.save()
    one.finish()
    return tmp_path / "run"


@pytest.fixture(scope="module")
def in_a_map_once(tmp_path_factory):
    return in_a_map(tmp_path_factory.mktemp("in_a_map"))


def test_where_the_map_that_a_run_began_in_or_the_last_part_of_a_recording_is_gone_it_is_told(in_a_map_once, tmp_path):
    assert replay(in_a_map_once, tmp_path / "again").losses == []
    without = Path(shutil.copytree(in_a_map_once, tmp_path / "without"))
    for name in ("start.mcap", "map.mcap"):
        (without / name).unlink()
    told = replay(without, tmp_path / "replayed").losses
    assert "start.mcap: not there, though the run began in a map: what follows is without it" in told
    with pytest.raises(RunError, match=r"it began in a map, and start\.mcap, .* graph_slam replay"):
        recover(without, tmp_path / "recovered")
    run = Path(shutil.copytree(in_a_map_once, tmp_path / "fewer"))
    parts = sorted(run.glob("ingest*.mcap"))
    assert len(parts) > 1
    parts[-1].unlink()
    losses = recover(run, tmp_path / "of_fewer")["losses"]
    assert f"{parts[-1].name} is missing, with which run.json was saved" in losses


def test_a_summary_that_tells_nonsense_hurts_nobody_and_of_what_was_refused_it_is_a_loss(in_a_map_once, tmp_path):
    run = Path(shutil.copytree(in_a_map_once, tmp_path / "run"))
    told, summary = json.loads((run / "run.json").read_text()), run / "run.json"
    for marks in (3, {"ingest.mcap": 3}, {"map": None, "more": 7}, [], {"ingest": 10**30}):
        summary.write_text(json.dumps(told | {"recorded": marks}))
        changed_since(run)
    assert recover(run, tmp_path / "out")["keyframes"] == told["keyframes"]
    for k, wrong in enumerate(({"counters": {"a": {"b": "c"}}}, {"counters": 3}, {"inputs": {"odom": {"used": "x"}}})):
        summary.write_text(json.dumps(told | wrong))
        done = recover(run, tmp_path / f"out{k}")
        assert any("what it had counted" in loss for loss in done["losses"]), wrong


def test_the_run_whose_map_is_gone_on_in_stays_however_few_are_kept(tmp_path):
    run = in_a_map(tmp_path)
    for _ in range(2):
        one = session(run, output__keep_earlier=1, output__load="run-1")
        one.load("run-1")
        one.ingest(WORLD[60:90])
        one.finish()
    assert is_run(tmp_path / "run-1")
    assert len(list(tmp_path.glob("run-*"))) == 2


def refused(run):
    """What the summary of a run tells of its inputs."""
    told = json.loads((run / "run.json").read_text())
    return told["counters"], {name: (of["received"], of["used"]) for name, of in told["inputs"].items()}


@pytest.mark.parametrize("make", ["left", "repeated", "cut off"])
def test_what_was_refused_is_told_by_the_results_that_are_made_later(tmp_path, make):
    """Of a run that was saved, stopped with a backlog, that has no map, or that was cut off after it was saved."""
    run, border, source = tmp_path / "run", Counters(), next(m.source for m in WORLD if isinstance(m, Odometry))
    one = session(run, border)
    border.count("odom", "nonfinite", 7)
    border.received["odom"] += len(WORLD)
    far = Fix(WORLD[20].stamp_ns, "gps", "position", (0.0, 0.0), (1.0, 0.0, 0.0, 1.0), (), OSLO)
    one.ingest([*with_fixes(MUNICH), far, *WORLD[60:100]])
    if make == "left":
        later = list(WORLD[100:140])
        one.accept(later)
        one.leave()
    elif make == "cut off":
        one.save()
        one.ingest(WORLD[100:140])
        one.abandon()
    else:
        one.finish()
    counters, inputs = refused(run)
    assert counters["odom"]["nonfinite"] == 7
    assert counters["gps"]["other_datum"] == 1
    if make == "repeated":
        (run / "map.mcap").unlink()
    recover(run, tmp_path / "out")
    (run / "map.mcap").exists() and complete(run)
    for made in (tmp_path / "out", run):
        found, of = refused(made)
        assert found["odom"]["nonfinite"] == 7, made
        assert found["gps"]["other_datum"] == 1, made
        assert of["odom"][0] == inputs["odom"][0] == len(WORLD), made
        assert of[source][1] >= inputs[source][1] > 30, made
    recover(tmp_path / "out", tmp_path / "again")
    assert refused(tmp_path / "again") == refused(tmp_path / "out")


def test_of_a_run_that_went_on_its_results_are_told_to_be_older(tmp_path):
    one = session(tmp_path / "run")
    one.ingest(WORLD[:60])
    one.save()
    assert changed_since(tmp_path / "run") == []
    one.ingest(WORLD[60:120])
    one.abandon()
    (warning,) = changed_since(tmp_path / "run")
    assert "went on after its results were saved" in warning
    assert is_cut_off(tmp_path / "run")


def test_a_replay_in_other_dimensions_is_refused_before_anything_is_replaced(tmp_path):
    for name in ("run", "out"):
        one = session(tmp_path / name)
        one.ingest(WORLD[:60])
        one.finish()
    before = (tmp_path / "out" / "path.tum").read_bytes()
    with pytest.raises(RunError, match=r"world\.dimensions is 2 there"):
        replay(tmp_path / "run", tmp_path / "out", Config.from_mapping({"world.dimensions": 3}), force=True)
    assert (tmp_path / "out" / "path.tum").read_bytes() == before


def straight(first, last, *, from_x=0.0, since_ns=0, source="odom"):
    """Odometry along x, half a metre in half a second."""
    return [Odometry(since_ns + k * 5 * 10**8, (from_x + 0.5 * k, 0.0, 0.0), None, source) for k in range(first, last)]


def resumed(folder, *later, **config):
    """Of a session that resumes after a drive of 20 m and is given these: whether the robot is located, and why."""
    again, first = session(folder, **config), later[0]
    now = Step(first.stamp_ns, first.T_odom_base, first.T_odom_base), first.source
    at_once, _ = again.T_map_odom(*now), again.resume()  # before the map is loaded
    assert not again.estimate.is_located and again.T_map_odom(*now) == at_once
    again.ingest(list(later))
    assert again.estimate.is_located <= (again.T_map_odom(*now) == pytest.approx(at_once, abs=1e-6))
    return again, (again.estimate.is_confirmed, again.estimate.is_resumed)


LATER = {  # what comes after a drive of 20 m that was cut off, and whether that goes on
    "goes on": (straight(41, 43), True),
    "after a minute": (straight(41, 43, since_ns=59 * 10**9), True),
    "other publisher": (straight(41, 43, source="odom#1"), True),
    "too late": (straight(41, 43, since_ns=61 * 10**9), False),
    "other odometry": (straight(41, 43, source="wheels"), False),
    "time before": (straight(39, 41), False),
    "anew at zero": (straight(0, 2, since_ns=30 * 10**9), False),
    "anew and driven since": (straight(0, 2, from_x=5.0, since_ns=30 * 10**9), False),
    "on the way home": (
        [replace(m, T_odom_base=(3.0 - 0.5 * k, 0.0, 0.0)) for k, m in enumerate(straight(81, 83))],
        True,
    ),
    "faster than robots": (straight(41, 43, from_x=60.0), False),
    "jumps later": ([*straight(41, 43), *straight(43, 45, from_x=60.0)], False),
}


def test_P12_a_drive_that_was_cut_off_is_resumed_where_its_odometry_goes_on(tmp_path):
    for name, (later, goes_on) in LATER.items():
        run = tmp_path / name.replace(" ", "_") / "run"
        (one := session(run)).ingest(straight(36, 41))
        before = one.slam.view.T_map_odom
        one.abandon()
        again, located = resumed(run, *later)
        assert located == (False, goes_on), name
        if goes_on:
            assert again.estimate.T_map_odom == pytest.approx(before, abs=1e-6), name


def test_after_a_jump_of_odometry_it_is_doubted_where_the_robot_is_until_something_is_recognised(tmp_path):
    one, lost, half = session(tmp_path / "run"), [], len(WORLD) // 2
    for k, m in enumerate(WORLD):
        if k > half and isinstance(m, Odometry):
            m = replace(m, T_odom_base=(m.T_odom_base[0] + 99.0, *m.T_odom_base[1:]))
        one.ingest([m])
        lost.append(one.estimate is not None and one.estimate.is_lost)
    assert (any(lost[:half]), any(lost[half:]), lost[-1]) == (False, True, False)


def test_P12_a_drive_whose_place_was_not_known_is_not_resumed(tmp_path):
    (one := session(tmp_path / "run")).ingest(straight(0, 41))
    one.abandon()
    lost, _ = resumed(tmp_path / "run", *straight(0, 41, since_ns=100 * 10**9))
    lost.abandon()
    assert resumed(tmp_path / "run", *straight(41, 43, since_ns=100 * 10**9))[1] == (False, False)


def test_P12_what_is_resumed_is_the_run_that_was_cut_off_also_where_another_is_named_to_be_loaded(tmp_path):
    (site := session(tmp_path / "site")).ingest(straight(0, 10))
    site.finish()
    one = session(tmp_path / "run", output__load="site", output__load_at_start=True)
    one.ingest(straight(0, 41))
    one.abandon()
    again, located = resumed(tmp_path / "run", *straight(41, 43), output__load="site", output__load_at_start=True)
    assert located == (False, True)
    assert again.slam.view.keyframes.stamps_ns[-1] > 10 * 10**9
    again.finish()
    shutil.rmtree(tmp_path / "run-1")
    last = session(tmp_path / "run", output__load="site", output__load_at_start=True)
    for run in tmp_path.glob("run-*"):
        shutil.rmtree(run)
    last.resume()
    assert len(last.slam.view.keyframes) == len(site.slam.view.keyframes), "where there is nothing to resume"


def test_a_run_folder_that_is_removed_while_driving_is_made_again_and_nothing_of_the_map_is_lost(tmp_path):
    one = session(tmp_path / "run", told=(told := []))
    one.ingest(WORLD[:300])
    shutil.rmtree(tmp_path / "run")
    one.evaluate()
    one.ingest(WORLD[300:500])
    one.abandon()
    (again := session(tmp_path / "run")).resume()
    assert [what for what, _ in told] == ["output.folder"]
    before = one.slam.view.trajectory()
    assert again.slam.view.trajectory()[: len(before)] == pytest.approx(before, abs=0.05)
