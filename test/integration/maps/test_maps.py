"""The commands on saved maps: export, diff, merge, freeze."""

import json
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from driven import drive, seldom
from reliability import times

from graph_slam_ros import cli, read_g2o
from graph_slam_ros.maps.alignment import laid_on
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.folder import run_config
from graph_slam_ros.runs.map_file import read_map
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.restore import map_of, restored
from graph_slam_ros.slam import Config, Control, GraphSlam, Sightings
from graph_slam_ros.tools import simulation
from graph_slam_ros.tools.simulation import simulate

SOAK = pytest.mark.skipif(not times(0, 1), reason="only in make soak")
RECORDED = ("graph.g2o", "ledger.csv", "ledger_changes.csv", "path.tum", "landmarks.csv", "covariances.csv")
ELSEWHERE = Config.from_mapping({"anchor.pose": "30 -20 2"})  # its map lies otherwise
FLIGHT = Config.from_mapping({"world.dimensions": 3})


@cache
def recording(seed, **options):
    return simulate("warehouse", seed, **{"aisles": 2, "laps": 1, "aisle_m": 6.0} | options)


def measurements(recording):
    return list(seldom(simulation.measurements(recording)))


@cache
def drive_past(seed):
    """Two drives past the same landmarks, by seed: 0 and 5."""
    return measurements(recording(seed))


def seeing(world, see):
    """The same with other sightings in each message."""
    for m in world:
        yield replace(m, sightings=tuple(see(m.sightings))) if isinstance(m, Sightings) else m


def ended(folder, world, config=None, source=None):
    """The pipeline of a run that was ended; one that goes on in the map of a source."""
    config = run_config(source) if source else config or Config()
    start = map_of(source, []) if source else None
    recorder = RunRecorder(folder, config, start=start)
    slam = GraphSlam(config, recorder.sink, start=start)
    for m in [*world, Control("end"), Control("optimize")]:
        recorder.record(slam, slam.process(m))
    recorder.save(slam)
    recorder.close()
    return slam


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Runs that are made once, by name: of both drives, merged, frozen, and one that goes on in the frozen map."""
    folder = tmp_path_factory.mktemp("runs")

    def make(name):
        out = folder / name
        match name:
            case "first":
                ended(out, drive_past(0))
            case "second":
                ended(out, drive_past(5), ELSEWHERE)
            case "merged":
                assert run("map", "merge", runs("first"), runs("second"), "--out", out) == 0
            case "frozen":
                assert run("map", "freeze", runs("first"), "--out", out) == 0
            case "in_frozen":
                ended(out, drive_past(5), source=runs("frozen"))
        return out

    runs = cache(make)
    return runs


def run(*words):
    return cli.main([str(word) for word in words])


def told(capsys, *words):
    """(exit code, what is on standard output as JSON)."""
    capsys.readouterr()
    code = run(*words)
    return code, json.loads(capsys.readouterr().out)


def assert_repeated(folder, again):
    assert run("replay", folder, "--out", again) == 0
    for name in RECORDED:
        assert (folder / name).read_bytes() == (again / name).read_bytes(), name


@pytest.fixture(scope="module")
def cut_off(tmp_path_factory):
    """A run that nobody ended, and its pipeline."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    return folder, drive(folder, Config(), drive_past(0))


def test_export_writes_what_the_run_folder_has(made, tmp_path, capsys):
    whole = made("first")
    assert run("map", "export", whole, "--out", tmp_path / "path.tum") == 0
    assert run("map", "export", whole, "--out", tmp_path / "graph.g2o.gz") == 0
    assert "graph_vertices.csv" in capsys.readouterr().out
    assert (tmp_path / "graph_vertices.csv").read_bytes() == (whole / "graph_vertices.csv").read_bytes()
    assert np.loadtxt(tmp_path / "path.tum") == pytest.approx(np.loadtxt(whole / "path.tum"), abs=1e-5)
    ours, theirs = (read_g2o(file).graph for file in (whole / "graph.g2o", tmp_path / "graph.g2o.gz"))
    assert theirs.edge_count == ours.edge_count
    assert theirs.initial.values == pytest.approx(ours.initial.values, abs=1e-5)


def test_export_as_messages_has_every_pose_at_its_stamp(cut_off, tmp_path):
    folder, slam = cut_off
    assert run("map", "export", folder, "--out", tmp_path / "map.mcap") == 3, "its end is missing"
    bag = open_bag(tmp_path / "map.mcap")
    counts = {name: topic.count for name, topic in bag.topics.items()}
    assert counts == {"/pose": len(slam.view.keyframes), "/path": 1, "/landmarks": 1, "/landmarks_estimate": 1}
    read = [(m.log_ns, typestore().deserialize_cdr(m.cdr, bag.topics["/pose"].type)) for m in bag.messages({"/pose"})]
    assert [stamp for stamp, _ in read] == slam.view.keyframes.stamps_ns.tolist()
    at = [(m.pose.pose.position.x, m.pose.pose.position.y) for _, m in read]
    assert np.array(at) == pytest.approx(slam.view.trajectory()[:, :2], abs=1e-6)
    variance = [m.pose.covariance[35] for _, m in read]
    assert variance == pytest.approx(slam.view.keyframe_covariances()[:, 2, 2], rel=1e-3)
    assert len(next(iter(bag.messages({"/landmarks_estimate"}))).cdr) > 100 * len(slam.view.landmarks)


def test_export_refuses_in_one_line(made, tmp_path, capsys):
    whole, another = made("first"), tmp_path / "another"
    shutil.copytree(whole, another)
    before = (whole / "path.tum").read_bytes()
    for words in (
        (whole, "--out", whole / "path.tum"),
        (tmp_path, "--out", tmp_path / "path.tum"),
        (whole, "--out", tmp_path / "none" / "map.mcap"),
        (whole, "--out", tmp_path / "map.bag"),
        (whole, "--out", another / "graph.g2o"),
    ):
        assert run("map", "export", *words) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert (whole / "path.tum").read_bytes() == before


def farther(name, by_m):
    """Sightings of a landmark that stands elsewhere: farther ahead of the robot."""
    return lambda several: [
        replace(s, measured=(s.measured[0] + by_m * (s.id == name), *s.measured[1:])) for s in several
    ]


def test_diff_of_a_run_and_what_it_repeats_to_is_nothing(made, tmp_path, capsys):
    assert_repeated(made("first"), tmp_path / "again")
    code, found = told(capsys, "map", "diff", made("first"), tmp_path / "again", "--json")
    assert code == 0
    assert found["same"]
    assert found["keyframes"]["a"] == found["keyframes"]["both"] > 50
    assert found["edges"]["a"] == found["edges"]["both"] > 100
    assert run("map", "diff", made("first"), tmp_path / "again") == 0
    assert capsys.readouterr().out.splitlines()[-2] == "no difference"


def test_diff_finds_the_landmark_that_was_moved_and_what_is_only_in_one(made, tmp_path, capsys):
    landmarks = restored(made("first"), []).view.landmarks
    other, gone, *_ = sorted(landmarks, key=lambda name: -landmarks[name].sightings)
    without = seeing(seeing(drive_past(0), farther(other, 0.4)), lambda several: [s for s in several if s.id != gone])
    ended(tmp_path / "other", without)
    code, found = told(capsys, "map", "diff", made("first"), tmp_path / "other", "--json")
    assert code == 4
    assert (found["only_in_a"], found["only_in_b"]) == ([gone], [])
    farthest, *others = found["moved"]
    assert farthest["landmark"] == other
    assert farthest["sigmas"] > 2.0 * max(one["sigmas"] for one in others)
    assert 0.1 < farthest["distance_m"] < 0.8
    assert run("map", "diff", made("first"), tmp_path / "other") == 4
    out = capsys.readouterr().out
    assert f"only in A  landmark {gone}" in out
    assert f"moved      landmark {other}" in out
    assert out.splitlines()[-2] == "they differ"


def rmse(view, *recordings):
    """Of the positions of keyframes, a segment of each recording, once they are laid on the truth as one."""
    n, truth = view.space.dimensions, []
    for one, stamps in zip(recordings, np.split(view.keyframes.stamps_ns, view.segments[1:]), strict=True):
        truth.append(one.T_world_base[np.searchsorted(one.stamps_ns, stamps), :n])
    truth, at = np.concatenate(truth), view.trajectory()[:, :n]
    moved = view.space.group.act(laid_on(view.space, truth, at), tuple(at.T))
    return np.sqrt(np.mean(np.sum((np.stack(moved, axis=-1) - truth) ** 2, axis=1)))


def test_merge_lays_the_second_session_on_the_first(made):
    one, two, both = (restored(made(name), []).view for name in ("first", "second", "merged"))
    count = len(one.keyframes)
    assert len(both.keyframes) == count + len(two.keyframes)
    assert both.segments == [*one.segments, *(count + k for k in two.segments)]
    assert both.drives == [0, count]
    assert set(both.landmarks) == set(one.landmarks) | set(two.landmarks)
    assert both.graph.edge_count == one.graph.edge_count + two.graph.edge_count
    for name, mark in both.landmarks.items():
        assert mark.sightings == sum(m.landmarks[name].sightings for m in (one, two) if name in m.landmarks)
    drives = recording(0), recording(5)
    assert rmse(both, *drives) < 0.05 + 0.5 * (rmse(one, drives[0]) + rmse(two, drives[1]))
    assert np.median(np.diag(both.landmark_covariances()[0])) < np.median(np.diag(one.landmark_covariances()[0]))


def test_a_merged_run_repeats_recovers_and_is_gone_on_in(made, tmp_path):
    merged = made("merged")
    assert_repeated(merged, tmp_path / "again")
    assert run("recover", merged, "--out", tmp_path / "recovered") == 0
    assert run("map", "diff", merged, tmp_path / "recovered") == run("explain", merged) == 0
    slam = ended(tmp_path / "third", drive_past(0), source=merged)
    assert set(slam.view.landmarks) == set(map_of(merged, []).landmarks)
    assert rmse(slam.view, recording(0), recording(5), recording(0)) < 0.15


def test_merge_leaves_out_what_has_moved_and_tells(made, tmp_path, capsys):
    one = restored(made("first"), []).view
    name = max(one.landmarks, key=lambda name: one.landmarks[name].sightings)
    ended(tmp_path / "other", seeing(drive_past(5), farther(name, 1.5)), ELSEWHERE)
    assert run("map", "merge", made("first"), tmp_path / "other", "--out", tmp_path / "out") == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert f"landmark {name} is 1." in warning
    both = restored(tmp_path / "out", []).view
    _, found = told(capsys, "map", "diff", made("first"), tmp_path / "out", "--json")
    (same,) = (mark for mark in found["moved"] if mark["landmark"] == name)
    assert same["distance_m"] < 0.1, "it is where the first session saw it"
    out = [edge for edge in both.ledger.outside.tolist() if edge >= one.graph.edge_count]
    away = [edge for edge in out if both.landmarks[name].vertex in both.graph.edge(edge).vertices]
    seen = [s.id for m in drive_past(5) if isinstance(m, Sightings) for s in m.sightings]
    assert len(away) == seen.count(name)
    assert len(out) <= len(away) + 2


@SOAK
def test_merge_in_space(tmp_path):
    flights, runs = [simulate("flight", seed, laps=1) for seed in (0, 3)], (tmp_path / "0", tmp_path / "1")
    one, two = (ended(out, measurements(flight), FLIGHT) for out, flight in zip(runs, flights, strict=True))
    assert run("map", "merge", *runs, "--out", tmp_path / "out") == 0
    both = restored(tmp_path / "out", []).view
    assert both.graph.vertex_count < one.view.graph.vertex_count + two.view.graph.vertex_count
    assert rmse(both, *flights) < 0.05 + 0.5 * (rmse(one.view, flights[0]) + rmse(two.view, flights[1]))


def test_merge_and_diff_refuse_in_one_line(made, tmp_path, capsys):
    first, world = made("first"), drive_past(0)
    names = [*restored(first, []).view.landmarks]
    later = [replace(m, stamp_ns=m.stamp_ns + 86_400_000_000_000) for m in world]
    swapped = dict(zip(names, reversed(names), strict=True))

    def one_only(several):
        return [s for s in several if s.id == names[0]]

    def confused(several):
        return [replace(s, id=swapped.get(s.id, s.id)) for s in several]

    ended(tmp_path / "few", seeing(later, one_only))
    ended(tmp_path / "confused", seeing(later, confused))
    ended(tmp_path / "flight", measurements(simulate("flight", 0, laps=1))[:120], FLIGHT)
    for other, complaint in (
        (tmp_path / "few", "it takes 2"),
        (tmp_path / "confused", "on how one lies on the other"),
        (tmp_path / "flight", "world.dimensions"),
        (tmp_path / "none", "none"),
        (first, "of the same drive"),
    ):
        assert run("map", "merge", first, other, "--out", tmp_path / "out") == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert complaint in line
    assert run("map", "merge", first, made("second"), "--out", first) == 2
    assert not (tmp_path / "out").exists()
    capsys.readouterr()
    assert run("map", "diff", first, tmp_path / "flight") == 2
    assert "world.dimensions" in capsys.readouterr().err
    assert run("map", "diff", tmp_path / "flight", tmp_path / "flight") == 0


def assert_untouched(view, source):
    """Not a bit of a frozen map has changed, neither value nor verdict."""
    state = read_map(source)
    count, edges = len(state.values), state.ledger.final
    assert state.frozen == state.graph.vertex_count > 50
    assert edges == state.graph.edge_count
    assert view.solver.values[:count].tobytes() == state.values.tobytes()
    for column in ("verdict", "reason", "statistic", "threshold"):
        ours, theirs = (getattr(ledger, column).values[:edges].tolist() for ledger in (view.ledger, state.ledger))
        assert ours == theirs, column


def test_freeze_changes_nothing_and_is_a_run_like_any_other(made, tmp_path):
    first, frozen = made("first"), made("frozen")
    assert run("map", "diff", first, frozen) == run("explain", frozen) == 0
    of_first, of_frozen = (restored(folder, []).view.solver.degrees_of_freedom for folder in (first, frozen))
    assert of_first == of_frozen > 0, "what is held was estimated before"
    assert not np.genfromtxt(frozen / "covariances.csv", delimiter=",", skip_header=1)[:, 1:].any(), "it is held"
    assert_repeated(frozen, tmp_path / "again")


def test_in_a_frozen_map_the_robot_is_located_as_well_as_in_one_that_goes_on(made, tmp_path):
    view = restored(made("in_frozen"), []).view
    assert_untouched(view, made("frozen"))
    assert len(view.keyframes) > 1.5 * view.segments[1], "the drive is in the graph"
    open_map = ended(tmp_path / "open", drive_past(5), source=made("first"))
    assert rmse(view, recording(0), recording(5)) < 1.5 * rmse(open_map.view, recording(0), recording(5)) + 0.02
    assert_repeated(made("in_frozen"), tmp_path / "again")


def test_new_landmarks_are_added_to_a_frozen_map(tmp_path):
    names = sorted({s.id for m in drive_past(0) if isinstance(m, Sightings) for s in m.sightings})
    known = set(names[::2])
    ended(tmp_path / "half", seeing(drive_past(0), lambda several: [s for s in several if s.id in known]))
    assert run("map", "freeze", tmp_path / "half", "--out", tmp_path / "frozen") == 0
    slam = ended(tmp_path / "run", drive_past(5), source=tmp_path / "frozen")
    assert_untouched(slam.view, tmp_path / "frozen")
    assert set(slam.view.landmarks) == set(names)
    truth = recording(5).landmarks
    at = np.array([slam.view.solver.estimate([slam.view.landmarks[name].vertex])[0][:2] for name in names])
    true = np.array([truth[name][:2] for name in names])
    moved = np.stack(slam.view.space.group.act(laid_on(slam.view.space, true, at), tuple(at.T)), axis=-1)
    assert np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))) < 0.2
    new = [name for name in names if name not in known]
    assert all(np.trace(slam.view.solver.marginal([slam.view.landmarks[name].vertex])[0]) > 0.0 for name in new)


def test_a_run_in_a_frozen_map_that_was_cut_off_is_taken_up_with_it_frozen(made, tmp_path):
    frozen, world = made("frozen"), drive_past(5)
    drive(tmp_path / "run", run_config(frozen), world[: len(world) // 2], map_of(frozen, []))
    start = map_of(tmp_path / "run", [])
    assert start.frozen < start.graph.vertex_count
    slam = ended(tmp_path / "more", world[len(world) // 2 :], source=tmp_path / "run")
    assert_untouched(slam.view, frozen)
    assert run("map", "merge", frozen, made("second"), "--out", tmp_path / "merged") == 0
    assert_untouched(restored(tmp_path / "merged", []).view, frozen)
