"""The commands on saved maps: export, diff, merge, freeze."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from driven import drive, seldom, with_a_wrong_sighting, without_names

from graph_slam_ros import cli, read_g2o
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.maps.alignment import laid_on
from graph_slam_ros.maps.edit import Plan, edit, source_hash
from graph_slam_ros.measurements.edits import edit_of
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.folder import run_config
from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.restore import map_of, restored
from graph_slam_ros.slam import Config, Control, GraphSlam, Sightings
from graph_slam_ros.tools import simulation
from graph_slam_ros.tools.simulation import simulate, with_closures


def measurements(recording):
    return seldom(simulation.measurements(recording))


@pytest.fixture(scope="module")
def world():
    return list(measurements(simulate("warehouse", 0, aisles=2, laps=1, aisle_m=6.0)))


@pytest.fixture(scope="module")
def cut_off(world, tmp_path_factory):
    """A run that nobody ended, and its pipeline."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    return folder, drive(folder, Config(), world)


@pytest.fixture(scope="module")
def whole(cut_off, tmp_path_factory):
    """The same run, ended."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert cli.main(["recover", str(cut_off[0]), "--out", str(folder)]) == 3
    return folder


def run(*words):
    return cli.main([str(word) for word in words])


# -- export ------------------------------------------------------------------------------------------------------------


def test_export_writes_what_the_run_folder_has(whole, tmp_path, capsys):
    assert run("map", "export", whole, "--out", tmp_path / "path.tum") == 0
    assert run("map", "export", whole, "--out", tmp_path / "graph.g2o") == 0
    assert "graph_vertices.csv" in capsys.readouterr().out
    assert (tmp_path / "graph_vertices.csv").read_bytes() == (whole / "graph_vertices.csv").read_bytes()
    a, b = (np.loadtxt(folder / "path.tum") for folder in (whole, tmp_path))
    assert b == pytest.approx(a, abs=1e-6)
    ours, theirs = (read_g2o(folder / "graph.g2o").graph for folder in (whole, tmp_path))
    assert theirs.edge_count == ours.edge_count
    assert theirs.initial.values == pytest.approx(ours.initial.values, abs=1e-6)


def test_export_of_a_graph_may_be_gzipped(whole, tmp_path):
    assert run("map", "export", whole, "--out", tmp_path / "map.g2o.gz") == 0
    assert (tmp_path / "map_vertices.csv").read_bytes() == (whole / "graph_vertices.csv").read_bytes()
    assert read_g2o(tmp_path / "map.g2o.gz").graph.vertex_count == read_g2o(whole / "graph.g2o").graph.vertex_count


def test_export_as_messages_has_every_pose_at_its_stamp(cut_off, tmp_path):
    folder, slam = cut_off
    assert run("map", "export", folder, "--out", tmp_path / "map.mcap") == 3, "its end is missing"
    bag = open_bag(tmp_path / "map.mcap")
    counts = {name: topic.count for name, topic in bag.topics.items()}
    assert counts == {"/pose": len(slam.keyframes), "/path": 1, "/landmarks": 1, "/landmarks_estimate": 1}
    read = [(m.log_ns, typestore().deserialize_cdr(m.cdr, bag.topics["/pose"].type)) for m in bag.messages({"/pose"})]
    assert [stamp for stamp, _ in read] == slam.keyframes.stamps_ns.tolist()
    at = [(m.pose.pose.position.x, m.pose.pose.position.y) for _, m in read]
    assert np.array(at) == pytest.approx(slam.trajectory()[:, :2], abs=1e-6)
    variance = [m.pose.covariance[35] for _, m in read]
    assert variance == pytest.approx(slam.keyframe_covariances()[:, 2, 2], rel=1e-3)
    assert len(next(iter(bag.messages({"/landmarks_estimate"}))).cdr) > 100 * len(slam.landmarks)


def test_export_of_a_map_that_is_cut_is_of_what_is_left_and_tells(cut_off, tmp_path, capsys):
    folder, slam = cut_off
    shutil.copytree(folder, tmp_path / "run")
    expected = slam.keyframes.stamps_ns.tolist()

    def exported_after_a_cut_of(name):
        whole = (folder / name).read_bytes()
        (tmp_path / "run" / name).write_bytes(whole[: len(whole) // 2])
        assert run("map", "export", tmp_path / "run", "--out", tmp_path / "path.tum", "--force") == 3
        assert f"{name}: cut off" in capsys.readouterr().err
        return [int(line.split()[0].replace(".", "")) for line in (tmp_path / "path.tum").read_text().splitlines()]

    assert exported_after_a_cut_of("map.mcap") == expected, "the rest is made from the journal"
    left = exported_after_a_cut_of("ingest.mcap")
    assert 10 < len(left) < len(expected)
    assert left == expected[: len(left)]


def test_export_refuses_in_one_line(whole, tmp_path, capsys):
    another = tmp_path / "another"
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


# -- diff --------------------------------------------------------------------------------------------------------------


def told(capsys, *words):
    """(exit code, what is on standard output as JSON)."""
    capsys.readouterr()
    code = run(*words)
    return code, json.loads(capsys.readouterr().out)


def moved(world, name, by_m, after_ns=0):
    """A landmark stands elsewhere: what is seen of it is farther ahead of the robot."""
    for m in world:
        if isinstance(m, Sightings) and m.stamp_ns >= after_ns:
            m = replace(m, sightings=tuple(_farther(one, by_m) if one.id == name else one for one in m.sightings))
        yield m


def _farther(one, by_m):
    return replace(one, measured=(one.measured[0] + by_m, *one.measured[1:]))


def ended(folder, world, config=None):
    """The folder of a run that was ended."""
    recorder = RunRecorder(folder, config or Config())
    slam = GraphSlam(config or Config(), recorder.sink)
    for m in [*world, Control("end"), Control("optimize")]:
        recorder.record(slam, slam.process(m))
    recorder.save(slam)
    recorder.close()
    return folder


@pytest.fixture(scope="module")
def first(tmp_path_factory, world):
    return ended(tmp_path_factory.mktemp("runs") / "first", world)


@pytest.fixture(scope="module")
def second(tmp_path_factory):
    """Of another drive, past the same landmarks."""
    world = measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=6.0))
    return ended(tmp_path_factory.mktemp("runs") / "second", world)


def test_diff_of_a_run_and_what_it_repeats_to_is_nothing(first, tmp_path, capsys):
    assert run("replay", first, "--out", tmp_path / "again") == 0
    code, found = told(capsys, "map", "diff", first, tmp_path / "again", "--json")
    assert code == 0
    assert found["same"]
    assert found["keyframes"]["a"] == found["keyframes"]["both"] > 50
    assert found["edges"]["a"] == found["edges"]["both"] > 100
    assert run("map", "diff", first, tmp_path / "again") == 0
    assert capsys.readouterr().out.splitlines()[-2] == "no difference"


def test_diff_finds_the_landmark_that_was_moved_and_what_is_only_in_one(first, world, tmp_path, capsys):
    slam = restored(first, [])
    names = sorted(slam.landmarks, key=lambda name: -slam.landmarks[name].sightings)
    other, gone = names[0], names[1]
    without = [
        replace(m, sightings=tuple(one for one in m.sightings if one.id != gone)) if isinstance(m, Sightings) else m
        for m in moved(world, other, 0.4)
    ]
    code, found = told(capsys, "map", "diff", first, ended(tmp_path / "other", without), "--json")
    assert code == 4
    assert found["only_in_a"] == [gone]
    assert found["only_in_b"] == []
    farthest, *others = found["moved"]
    assert farthest["landmark"] == other
    assert farthest["sigmas"] > 2.0 * max(one["sigmas"] for one in others)
    assert 0.1 < farthest["distance_m"] < 0.8
    assert run("map", "diff", first, tmp_path / "other") == 4
    out = capsys.readouterr().out
    assert f"only in A  landmark {gone}" in out
    assert f"moved      landmark {other}" in out
    assert out.splitlines()[-2] == "they differ"


def test_diff_tells_sigmas_that_are_as_large_as_they_should_be(first, second, capsys):
    code, found = told(capsys, "map", "diff", first, second, "--json")
    assert code == 4
    assert found["aligned_by"].endswith("landmarks")
    sigmas = np.array([one["sigmas"] for one in found["moved"]])
    assert len(sigmas) > 10
    assert 0.5 < np.sqrt(np.mean(sigmas**2)) < 2.0
    assert max(one["distance_m"] for one in found["moved"]) < 0.3


def test_diff_tells_verdicts_on_the_same_measurement(first, world, tmp_path, capsys):
    a = ended(tmp_path / "a", with_a_wrong_sighting(world))
    config = Config.from_mapping({"robust.decide": False})
    b = ended(tmp_path / "b", with_a_wrong_sighting(world), config)
    code, found = told(capsys, "map", "diff", a, b, "--json")
    assert code == 4
    (wrong,) = (one for one in found["verdicts"] if one["verdict_a"] in ("pending", "rejected"))
    assert wrong["about"].startswith("landmarks ")
    assert wrong["verdict_b"] == "accepted"


def test_diff_without_common_landmarks_is_by_stamps(world, first, tmp_path, capsys):
    blind = [m for m in world if not isinstance(m, Sightings)]
    code, found = told(capsys, "map", "diff", first, ended(tmp_path / "blind", blind), "--json")
    assert code == 4
    assert found["aligned_by"] == f"{found['keyframes']['both']} stamps"
    assert found["landmarks"] == {"a": found["landmarks"]["a"], "b": 0, "both": 0}
    assert found["only_in_a"]
    assert found["keyframes_m"][1] > 0.05
    assert " keyframes are of the same drive in " in found["merge_trouble"]
    assert run("map", "diff", first, tmp_path / "blind") == 4
    out, _ = capsys.readouterr()
    assert f"next: nothing: they cannot be merged: {found['merge_trouble']}" in " ".join(out.split())


def test_diff_of_the_plane_and_space_is_refused(first, tmp_path, capsys):
    flight = list(measurements(simulate("flight", 0, laps=1)))[:120]
    other = ended(tmp_path / "flight", flight, Config.from_mapping({"world.dimensions": 3}))
    assert run("map", "diff", first, other) == 2
    assert "world.dimensions" in capsys.readouterr().err
    assert told(capsys, "map", "diff", other, other, "--json")[0] == 0


# -- merge -------------------------------------------------------------------------------------------------------------

RECORDED = ("graph.g2o", "ledger.csv", "ledger_changes.csv", "path.tum", "landmarks.csv", "covariances.csv")
ELSEWHERE = Config.from_mapping({"anchor.pose": "30 -20 2"})  # its map lies otherwise


def rmse(slam, *recordings):
    """Of the positions of keyframes, a segment of each recording, once they are laid on the truth as one."""
    n, truth = slam.space.dimensions, []
    for recording, stamps in zip(recordings, np.split(slam.keyframes.stamps_ns, slam.segments[1:]), strict=True):
        truth.append(recording.T_world_base[np.searchsorted(recording.stamps_ns, stamps), :n])
    truth, at = np.concatenate(truth), slam.trajectory()[:, :n]
    moved = slam.space.group.act(laid_on(slam.space, truth, at), tuple(at.T))
    return np.sqrt(np.mean(np.sum((np.stack(moved, axis=-1) - truth) ** 2, axis=1)))


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """Of another drive, in another map frame."""
    world = measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=6.0))
    return ended(tmp_path_factory.mktemp("runs") / "elsewhere", world, ELSEWHERE)


@pytest.fixture(scope="module")
def merged(first, elsewhere, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "merged"
    assert run("map", "merge", first, elsewhere, "--out", folder) == 0
    return folder


def test_merge_lays_the_second_session_on_the_first(first, elsewhere, merged):
    one, two, both = (restored(folder, []) for folder in (first, elsewhere, merged))
    count = len(one.keyframes)
    assert len(both.keyframes) == count + len(two.keyframes)
    assert both.segments == [*one.segments, *(count + k for k in two.segments)]
    assert both.drives == [0, count]
    assert set(both.landmarks) == set(one.landmarks) | set(two.landmarks)
    assert both.graph.edge_count == one.graph.edge_count + two.graph.edge_count
    for name, mark in both.landmarks.items():
        assert mark.sightings == sum(m.landmarks[name].sightings for m in (one, two) if name in m.landmarks)
    drives = [simulate("warehouse", seed, aisles=2, laps=1, aisle_m=6.0) for seed in (0, 5)]
    assert rmse(both, *drives) < 0.05 + 0.5 * (rmse(one, drives[0]) + rmse(two, drives[1]))
    assert np.median(np.diag(both.landmark_covariances()[0])) < np.median(np.diag(one.landmark_covariances()[0]))


def test_a_merged_run_repeats_recovers_and_is_gone_on_in(merged, world, tmp_path):
    assert run("replay", merged, "--out", tmp_path / "again") == 0
    for name in RECORDED:
        assert (merged / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    assert run("recover", merged, "--out", tmp_path / "recovered") == 0
    assert run("map", "diff", merged, tmp_path / "recovered") == 0
    assert run("explain", merged) == 0
    start = map_of(merged, [])
    known = set(start.landmarks)
    slam = drive(tmp_path / "third", run_config(merged), world, start)
    assert set(slam.landmarks) == known
    drives = [simulate("warehouse", seed, aisles=2, laps=1, aisle_m=6.0) for seed in (0, 5, 0)]
    assert rmse(slam, *drives) < 0.15


def test_merge_leaves_out_what_has_moved_and_tells(first, tmp_path, capsys):
    seen = restored(first, []).landmarks
    name = max(seen, key=lambda name: seen[name].sightings)
    other = moved(measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=6.0)), name, 1.5)
    assert run("map", "merge", first, ended(tmp_path / "other", other, ELSEWHERE), "--out", tmp_path / "out") == 0
    warning = capsys.readouterr().err
    assert f"landmark {name} is 1." in warning
    assert len(warning.splitlines()) == 1
    one, both = restored(first, []), restored(tmp_path / "out", [])
    _, found = told(capsys, "map", "diff", first, tmp_path / "out", "--json")
    (same,) = (one for one in found["moved"] if one["landmark"] == name)
    assert same["distance_m"] < 0.1, "it is where the first session saw it"
    out = [edge for edge in both.ledger.outside.tolist() if edge >= one.graph.edge_count]
    vertex = both.landmarks[name].vertex
    seen = (m for m in measurements(another_drive()) if isinstance(m, Sightings))
    moved_away = [edge for edge in out if vertex in both.graph.edge(edge).vertices]
    assert len(moved_away) == sum(one.id == name for m in seen for one in m.sightings)
    assert len(out) <= len(moved_away) + 2


def test_merge_of_unnamed_landmarks_keeps_them_apart(first, elsewhere, tmp_path):
    config = Config.from_mapping({"landmarks.association": "joint"})

    def half_named(seed):
        world = measurements(simulate("warehouse", seed, aisles=2, laps=1, aisle_m=6.0, sensor="position"))
        for m in world:
            if isinstance(m, Sightings):
                m = replace(m, sightings=tuple(replace(s, id=s.id if hash_of(s.id) % 2 else "") for s in m.sightings))
            yield m

    def hash_of(name):
        return sum(map(ord, name))

    a, b = ended(tmp_path / "a", half_named(0), config), ended(tmp_path / "b", half_named(5), config)
    assert run("map", "merge", a, b, "--out", tmp_path / "out") == 0
    start = read_map(tmp_path / "out", [], start_only=True)
    one, two = (restored(folder, []) for folder in (a, b))
    unnamed = [sum(mark.is_unnamed for mark in slam.touched_landmarks(0).values()) for slam in (one, two)]
    assert min(unnamed) > 3
    assert sum(mark.is_unnamed for mark in start.landmarks.values()) == sum(unnamed)
    for mark in start.landmarks.values():
        for one in mark.seen:
            table, row = start.graph.row(one.edge)
            assert table.vertices.values[row].tolist() == [one.where.vertex, mark.vertex]
            assert start.keyframes[one.where.keyframe].vertex == one.where.vertex
    assert run("replay", tmp_path / "out", "--out", tmp_path / "again") == 0
    assert (tmp_path / "out" / "graph.g2o").read_bytes() == (tmp_path / "again" / "graph.g2o").read_bytes()


@pytest.mark.parametrize("kind", ["flight", "ranges"])
def test_merge_in_space_and_of_what_shares_an_offset(kind, tmp_path):
    options = {"aisles": 2, "laps": 2, "aisle_m": 6.0, "sensor": "range"} if kind == "ranges" else {"laps": 1}
    settings = {"landmarks.range_offset_sigma_m": 0.5} if kind == "ranges" else {"world.dimensions": 3}
    name = "warehouse" if kind == "ranges" else "flight"
    recordings = [simulate(name, seed, **options) for seed in (0, 3)]
    given = simulation.measurements if kind == "ranges" else measurements
    runs = [ended(tmp_path / str(k), given(r), Config.from_mapping(settings)) for k, r in enumerate(recordings)]
    assert run("map", "merge", *runs, "--out", tmp_path / "out") == 0
    one, two, both = (restored(folder, []) for folder in (*runs, tmp_path / "out"))
    assert list(both.range_offsets) == list(one.range_offsets)
    assert both.graph.vertex_count < one.graph.vertex_count + two.graph.vertex_count
    assert len(both.graph.edges_of("range_offset")) == len(one.graph.edges_of("range_offset"))
    assert rmse(both, *recordings) < 0.05 + 0.5 * (rmse(one, recordings[0]) + rmse(two, recordings[1]))


def test_merge_refuses_in_one_line(first, elsewhere, world, tmp_path, capsys):
    few = restored(first, []).landmarks
    keep = next(iter(few))
    later = [replace(m, stamp_ns=m.stamp_ns + 86_400_000_000_000) for m in world]
    alike, one_only = (
        [
            replace(m, sightings=tuple(s for s in m.sightings if s.id == keep)) if isinstance(m, Sightings) else m
            for m in some
        ]
        for some in (world, later)
    )
    swapped = dict(zip(few, reversed(list(few)), strict=True))
    confused = [
        replace(m, sightings=tuple(replace(s, id=swapped.get(s.id, s.id)) for s in m.sightings))
        if isinstance(m, Sightings)
        else m
        for m in later
    ]
    flight = list(measurements(simulate("flight", 0, laps=1)))[:120]
    surveyed = Config.from_mapping({"landmarks.surveyed": f"id,x,y,sigma\n{keep},1,1,0.1"})
    for other, complaint in (
        (ended(tmp_path / "few", one_only), "it takes 2"),
        (ended(tmp_path / "confused", confused), "on how one lies on the other"),
        (ended(tmp_path / "flight", flight, Config.from_mapping({"world.dimensions": 3})), "world.dimensions"),
        (ended(tmp_path / "surveyed", later, surveyed), "merge"),
        (tmp_path / "none", "none"),
        (first, "of the same drive"),
        (ended(tmp_path / "alike", alike), "of the same drive"),  # however few landmarks agree
    ):
        assert run("map", "merge", first, other, "--out", tmp_path / "out") == 2
        told = capsys.readouterr().err
        assert complaint in told
        assert len(told.splitlines()) == 1
    assert run("map", "merge", first, elsewhere, "--out", first) == 2
    assert not (tmp_path / "out").exists()


# -- freeze ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frozen(first, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "frozen"
    assert run("map", "freeze", first, "--out", folder) == 0
    return folder


def gone_on(folder, source, world):
    """The pipeline of a run that goes on in a map, saved whole."""
    start = map_of(source, [])
    recorder = RunRecorder(folder, run_config(source), start=start)
    slam = GraphSlam(run_config(source), recorder.sink, start=start)
    for m in [*world, Control("end"), Control("optimize")]:
        recorder.record(slam, slam.process(m))
    recorder.save(slam)
    recorder.close()
    return slam


def assert_untouched(slam, source):
    """Not a bit of a frozen map has changed, neither value nor verdict."""
    state = read_map(source, [])
    count, edges = len(state.values), state.ledger.final
    assert state.frozen == state.graph.vertex_count > 50
    assert edges == state.graph.edge_count
    assert slam.solver.values[:count].tobytes() == state.values.tobytes()
    for column in ("verdict", "reason", "statistic", "threshold"):
        ours, theirs = (getattr(ledger, column).values[:edges].tolist() for ledger in (slam.ledger, state.ledger))
        assert ours == theirs, column


def another_drive():
    return simulate("warehouse", 5, aisles=2, laps=1, aisle_m=6.0)


def test_freeze_changes_nothing_and_is_a_run_like_any_other(first, frozen, tmp_path):
    assert run("map", "diff", first, frozen) == 0
    assert run("explain", frozen) == 0
    of_first, of_frozen = (restored(folder, []).solver.degrees_of_freedom for folder in (first, frozen))
    assert of_first == of_frozen > 0, "what is held was estimated before"
    assert not np.genfromtxt(frozen / "covariances.csv", delimiter=",", skip_header=1)[:, 1:].any(), "it is held"
    assert run("replay", frozen, "--out", tmp_path / "again") == 0
    for name in RECORDED:
        assert (frozen / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


def test_in_a_frozen_map_the_robot_is_located_as_well_as_in_one_that_goes_on(first, frozen, tmp_path):
    world = list(measurements(another_drive()))
    slam = gone_on(tmp_path / "run", frozen, world)
    assert_untouched(slam, frozen)
    assert len(slam.keyframes) > 1.5 * slam.segments[1], "the drive is in the graph"
    drives = [simulate("warehouse", 0, aisles=2, laps=1, aisle_m=6.0), another_drive()]
    open_map = gone_on(tmp_path / "open", first, world)
    assert rmse(slam, *drives) < 1.5 * rmse(open_map, *drives) + 0.02
    assert run("replay", tmp_path / "run", "--out", tmp_path / "again") == 0
    for name in RECORDED:
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    assert_untouched(restored(tmp_path / "run", []), frozen)


def test_what_is_asked_of_a_run_in_a_frozen_map_leaves_that_where_it_is(frozen, world, tmp_path):
    slam = gone_on(tmp_path / "run", frozen, world)
    saved = SavedGraph(tmp_path / "run", [])
    first_new = len(read_map(frozen, []).keyframes)
    judged = [e for e in saved.entries if e.is_in and e.verdict]
    edges = [e for e in judged if (saved.keyframe(e.vertices[0]) or 0) >= first_new][:20]
    after = saved.solve([e.edge for e in edges])
    moved = np.abs(after.estimate(saved.keyframes) - saved.solve().estimate(saved.keyframes)).max(axis=1)
    assert moved[:first_new].max() == 0.0 < moved[first_new:].max()
    assert saved.solve().estimate(saved.keyframes) == pytest.approx(slam.trajectory(), abs=1e-4)
    assert run("explain", tmp_path / "run", "--influence") == run("explain", tmp_path / "run", edges[0].edge) == 0


def test_new_landmarks_are_added_to_a_frozen_map(world, tmp_path):
    names = sorted({s.id for m in world if isinstance(m, Sightings) for s in m.sightings})
    known = set(names[::2])
    half = [
        replace(m, sightings=tuple(s for s in m.sightings if s.id in known)) if isinstance(m, Sightings) else m
        for m in world
    ]
    assert run("map", "freeze", ended(tmp_path / "half", half), "--out", tmp_path / "frozen") == 0
    slam = gone_on(tmp_path / "run", tmp_path / "frozen", measurements(another_drive()))
    assert_untouched(slam, tmp_path / "frozen")
    assert set(slam.landmarks) == set(names)
    truth = another_drive().landmarks
    at = np.array([slam.solver.estimate([slam.landmarks[name].vertex])[0][:2] for name in names])
    true = np.array([truth[name][:2] for name in names])
    moved = np.stack(slam.space.group.act(laid_on(slam.space, true, at), tuple(at.T)), axis=-1)
    assert np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))) < 0.2
    new = [name for name in names if name not in known]
    assert all(np.trace(slam.solver.marginal([slam.landmarks[name].vertex])[0]) > 0.0 for name in new)


def test_what_is_wrong_moves_neither_a_frozen_map_nor_the_robot_in_it(frozen, tmp_path):
    world = list(measurements(another_drive()))
    right = gone_on(tmp_path / "right", frozen, world)
    slam = gone_on(tmp_path / "wrong", frozen, with_a_wrong_sighting(world, len(world) // 2))
    assert_untouched(slam, frozen)
    assert slam.ledger.outside_count == right.ledger.outside_count + 1
    _, k, m = np.intersect1d(
        *(one.keyframes.stamps_ns[one.segments[1] :] for one in (slam, right)), return_indices=True
    )
    there, here = (one.trajectory()[one.segments[1] :][i] for one, i in ((slam, k), (right, m)))
    assert len(k) > 100
    assert there[:, :2] == pytest.approx(here[:, :2], abs=0.05)


def test_a_run_in_a_frozen_map_that_was_cut_off_is_taken_up_with_it_frozen(frozen, tmp_path):
    world = list(measurements(another_drive()))
    drive(tmp_path / "run", run_config(frozen), world[: len(world) // 2], map_of(frozen, []))
    start = read_map(tmp_path / "run", [])
    assert start.frozen < start.graph.vertex_count
    slam = gone_on(tmp_path / "more", tmp_path / "run", world[len(world) // 2 :])
    assert_untouched(slam, frozen)
    other = ended(tmp_path / "other", world)
    assert run("map", "merge", frozen, other, "--out", tmp_path / "merged") == 0
    assert_untouched(restored(tmp_path / "merged", []), frozen)


def test_without_names_and_with_closures_a_frozen_map_stays(tmp_path):
    config = Config.from_mapping({"landmarks.association": "joint"})
    recording = with_closures(simulate("warehouse", 0, aisles=2, laps=2, aisle_m=6.0, sensor="position"), 60, 0)
    source = ended(tmp_path / "run", without_names(measurements(recording)), config)
    assert run("map", "freeze", source, "--out", tmp_path / "frozen") == 0
    again = with_closures(simulate("warehouse", 5, aisles=2, laps=2, aisle_m=6.0, sensor="position"), 60, 1)
    world = [*without_names(measurements(again)), Control("clear_closures")]
    slam = gone_on(tmp_path / "more", tmp_path / "frozen", world)
    assert_untouched(slam, tmp_path / "frozen")
    closures = slam.graph.edges_of("closures")
    is_ours = closures < slam.ledger.final
    assert is_ours.any()
    assert not is_ours.all()
    assert not any(slam.ledger.is_withdrawn(edge) for edge in closures[is_ours].tolist())
    assert all(slam.ledger.is_withdrawn(edge) for edge in closures[~is_ours].tolist())
    assert not any(mark.is_tentative for mark in read_map(tmp_path / "frozen", []).landmarks.values())


def with_features(measured):
    """Sightings without names, which say whether a tag is on a rack or a wall, and how large it is."""
    for m in measured:
        if isinstance(m, Sightings):
            sorts = [s.id.rstrip("0123456789ewns") for s in m.sightings]
            known = zip(m.sightings, sorts, strict=True)
            m = replace(m, sightings=tuple(replace(s, id="", sort=k, size=0.1 + 0.2 * (k == "wall")) for s, k in known))
        yield m


def test_class_and_size_are_the_same_bytes_after_freezing_and_a_restart(tmp_path):
    config = Config.from_mapping({"landmarks.association": "joint", "landmarks.size_sigma_m": 0.03})
    first, second = (simulate("warehouse", seed, aisles=2, laps=1, aisle_m=6.0, sensor="position") for seed in (0, 5))
    source = ended(tmp_path / "run", with_features(measurements(first)), config)
    assert run("map", "freeze", source, "--out", tmp_path / "frozen") == 0

    def features(folder):
        return {name: (m.sort, m.size, m.sized) for name, m in read_map(folder, []).landmarks.items()}

    saved = features(tmp_path / "frozen")
    assert saved.items() <= features(source).items(), "one that is not believed is not frozen"
    assert {sort for sort, _, _ in saved.values()} == {"rack", "wall"}
    assert all(size == pytest.approx(0.3 if sort == "wall" else 0.1) for sort, size, _ in saved.values())
    again = list(with_features(measurements(second)))
    slam = gone_on(tmp_path / "once", tmp_path / "frozen", again)
    gone_on(tmp_path / "twice", tmp_path / "frozen", again)
    assert_untouched(slam, tmp_path / "frozen")
    for name in RECORDED:
        assert (tmp_path / "once" / name).read_bytes() == (tmp_path / "twice" / name).read_bytes(), name
    later = features(tmp_path / "once")
    assert {name: later[name][0] for name in saved} == {name: sort for name, (sort, _, _) in saved.items()}
    assert sum(later[name][2] for name in saved) > sum(sized for _, _, sized in saved.values()), "they are seen again"


def test_merge_keeps_the_edits_of_both_with_the_ids_of_their_edges(first, second, tmp_path):
    edited = []
    for number, folder in enumerate((first, second)):
        edge = next(e.edge for e in SavedGraph(folder, []).entries if e.label == "landmarks" and e.is_in)
        values = {"name": "a", "who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "w", "do": "let_in_edge"}
        plan = Plan(source_hash(folder), (edit_of(values | {"edge": edge}),))
        edited.append(tmp_path / f"edited_{number}")
        edit(folder, plan, edited[-1])
    assert run("map", "merge", *edited, "--out", tmp_path / "both") == 0
    merged = SavedGraph(tmp_path / "both", [])
    assert [one.edit.name for one in merged.edits] == ["a", "a-2"]
    for one in merged.edits:
        (out,), (added,) = one.edges, one.added
        assert one.edit.arguments["edge"] == out
        assert (merged.entries[out].is_in, merged.entries[added].is_in) == (False, True)
        assert merged.entries[out].measured == merged.entries[added].measured
