"""The pipeline with ``map.condense``: a map whose size follows its area, live, replayed, killed and taken up again."""

from itertools import pairwise

import numpy as np
import pytest
from condensed_run import SEED, WINDOW, bounded, condensed_run
from reliability import times

from benchmarks.hall import config, hall, measurements, rms
from graph_slam_ros.analysis.explain import explain_edge, explain_run
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError, SingularError
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.graph.place import LABEL
from graph_slam_ros.maps.diff import diff
from graph_slam_ros.runs.condensed_map import read_left, read_left_edges
from graph_slam_ros.runs.folder import changed_since
from graph_slam_ros.runs.journal import MAP, parts_of, read_measurements
from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.outcome import text
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.runs.trajectory import read_tum
from graph_slam_ros.runs.whole_path import removed_path
from graph_slam_ros.slam import Closure, Config, Control, Fix, GraphSlam, Odometry, bounded_map
from graph_slam_ros.slam.lifelong.condenser import Condenser
from graph_slam_ros.slam.lifelong.state import Left
from graph_slam_ros.slam.lifelong.surroundings import CHAIN
from graph_slam_ros.slam.robust.ledger import Verdict
from graph_slam_ros.solver import Solver

KEYFRAMES = 700
LOOPS = {"inputs_names": "odom marks loops", "loops_use": "closure", "loops_topic": "/loops"}


def driven(world, settings, until=None):
    """The pipeline after a drive, and what has left its map."""
    slam, left = GraphSlam(settings), []
    for m in list(measurements(world))[:until]:
        update = slam.process(m)
        left += [update.condensed] if update.condensed is not None else []
    return slam, left


def true_path(world, count):
    return np.array([pose[: world.space.dimensions] for pose in world.poses[:count]])


def whole_path(slam, left):
    before = Left.joined(slam.space, [one.left for one in left])
    return np.concatenate((removed_path(slam, before), slam.trajectory()))[:, : slam.space.dimensions]


def landmarks(world, slam):
    vertices = [mark.vertex for mark in slam.landmarks.values()]
    return slam.solver.estimate(vertices)[:, : slam.space.dimensions], world.points[
        [int(name[1:]) for name in slam.landmarks]
    ]


@pytest.fixture(scope="module", params=times(["plane"], ["plane", "space with tags"]))
def both(request):
    """A world, and its drives with all keyframes and condensed: the pipeline, and what left its map."""
    name, _, tags = request.param.partition(" ")
    world = hall(2, KEYFRAMES, {"plane": PLANAR, "space": SPATIAL}[name], tags=bool(tags))
    return world, driven(world, config(world.space)), driven(world, bounded(world.space))


def test_the_map_is_small_as_good_and_hardly_surer_and_the_whole_path_is_there(both):
    """docs/lifelong.md has the limits."""
    world, (whole, _), (small, left) = both
    assert small.first_keyframe > 0.6 * KEYFRAMES
    assert len(small.solver.vertices) < 0.4 * len(whole.solver.vertices)
    waiting = whole.graph.edge_count - len(whole.ledger)
    assert small.graph.edge_count == len(small.ledger) + waiting < 0.35 * whole.graph.edge_count
    path = whole_path(small, left)
    assert len(path) == len(whole.keyframes) == len(small.keyframes)
    true = true_path(world, len(path))
    assert rms(path, true) < 1.4 * rms(whole.trajectory()[:, : world.space.dimensions], true)
    assert rms(*landmarks(world, small)) < 1.25 * rms(*landmarks(world, whole))
    names = sorted(whole.landmarks)
    known = [[slam.keyframes[-1].vertex, *(slam.landmarks[name].vertex for name in names)] for slam in (whole, small)]
    before, after = (slam.solver.joint_marginal(at) for slam, at in zip((whole, small), known, strict=True))
    root = np.linalg.inv(np.linalg.cholesky(before))
    variances = np.linalg.eigvalsh(root @ after @ root.T)
    assert 0.5 < variances[0] <= variances[-1] < 4.0


def test_records_of_what_left_have_no_gap_and_each_base_is_there(both):
    _, (whole, _), (small, left) = both
    for before, after in pairwise(left):
        assert after.first == before.first + len(before.left.keyframes)
        assert after.sightings_before == before.sightings_before + len(before.left.sightings)
    records = np.concatenate([one.left.keyframes for one in left])
    assert records["stamp_ns"].tolist() == whole.keyframes.stamps_ns[: len(records)].tolist()
    assert records["T_odom"] == pytest.approx(whole.keyframes.poses[: len(records)])
    sightings = sum(len(one.left.sightings) for one in left) + len(small.sighting_poses)
    assert sightings == len(whole.sighting_poses)


def test_ids_last_and_are_never_used_twice(both):
    _, (whole, _), (small, left) = both
    graph = small.graph
    for ids, count in ((graph.edge_ids, graph.edge_count), (graph.vertex_ids, graph.vertex_count)):
        lasting = ids.of_all(np.arange(count))
        assert (np.diff(lasting) > 0).all()
        assert [ids.find(one) for one in lasting.tolist()] == list(range(count))
    gone = [edge.edge for one in left for edge in one.edges]
    assert len(set(gone)) == len(gone)
    assert not set(gone) & set(graph.edge_ids.of_all(np.arange(graph.edge_count)).tolist())
    kept = [e for e in range(graph.edge_count) if graph.label_of(e) not in (LABEL, CHAIN)]
    assert len(gone) + len(kept) == whole.graph.edge_count  # each measurement once, there or gone
    assert {one.became for part in left for one in part.edges} <= {"condensed", "expired"}
    assert all(e.landmark for one in left for e in one.edges if e.label == "landmarks")


def test_places_hold_their_landmarks_and_verdicts_go_on(both):
    _, _, (slam, _) = both
    places = [one for several in slam.bounded.places.values() for one in several]
    assert len(places) == len(slam.graph.edges_of(LABEL)) > 3
    for one in places:
        edge = slam.graph.edge(one.edge)
        assert edge.weight == 1.0
        assert edge.vertices == (one.base, *one.place.members)
    sightings = slam.graph.edges_of("landmarks")
    verdicts = slam.ledger.verdict.values[sightings[sightings < len(slam.ledger)]]  # the newest wait for odometry
    assert (verdicts != Verdict.NOT_EVALUATED).all()
    assert not slam.alarms


def test_a_drive_within_the_window_gives_the_same_bytes_as_without():
    world = hall(4, WINDOW + 90)
    (one, left), (other, _) = driven(world, bounded()), driven(world, config(PLANAR))
    assert not left
    assert one.solver.values.tobytes() == other.solver.values.tobytes()
    assert one.ledger.statistic.values.tobytes() == other.ledger.statistic.values.tobytes()


@pytest.mark.parametrize(
    ("home", "name", "input_"), [(Condenser, "rescale", "map"), (bounded_map, "compact", "solver")]
)
def test_a_solve_that_fails_before_or_after_the_compaction_is_counted_and_the_drive_goes_on(
    monkeypatch, home, name, input_
):
    """Before, nothing has changed, and it is tried again; after, the estimate stays until the next solve."""
    world, step, solve, state = hall(SEED, 600), getattr(home, name), Solver.update, {"fails": False}

    def step_then_fail(*args):
        state["fails"] = "failed" not in state
        return step(*args)

    def update(solver):
        if state["fails"]:
            state.update(fails=False, failed=True)
            raise SingularError("planted", 5)
        return solve(solver)

    monkeypatch.setattr(home, name, step_then_fail)
    monkeypatch.setattr(Solver, "update", update)
    slam, left = driven(world, bounded())
    assert slam.counters[input_, "SingularError"] == 1
    assert left
    assert rms(slam.trajectory()[:, :2], true_path(world, len(slam.keyframes))[slam.keyframes.first :]) < 0.05


@pytest.fixture(scope="module")
def recorded():
    return condensed_run()


def test_a_replay_condenses_as_the_live_run_did(recorded, tmp_path):
    folder, slam, _ = recorded
    again, _ = record_run(tmp_path / "again", bounded(), read_measurements(folder, []), [])
    assert again.first_keyframe == slam.first_keyframe > 0
    assert again.solver.values.tobytes() == slam.solver.values.tobytes()
    for name in ("path.tum", "landmarks.csv", "ledger.csv", "sightings.tum", "graph.g2o", "graph_vertices.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name
    ours, theirs = (read_left(at, PLANAR, slam.bounded) for at in (folder, tmp_path / "again"))
    assert ours.keyframes.tobytes() == theirs.keyframes.tobytes()
    assert ours.sightings.tobytes() == theirs.sightings.tobytes()


def test_the_run_folder_has_the_whole_path(recorded):
    folder, _, summary = recorded
    assert summary["keyframes"] == 500
    path = read_tum(folder / "path.tum")
    assert len(path.stamps_s) == len(read_tum(folder / "path_odometry.tum").stamps_s) == 500
    assert rms(path.poses[:, :2], true_path(hall(SEED, 500), 500)) < 0.1
    assert len(read_tum(folder / "sightings.tum").stamps_s) == len(read_tum(folder / "odometry.tum").stamps_s)
    assert changed_since(folder) == []
    assert {row["became"] for row in read_left_edges(folder)} == {"condensed"}


def test_the_map_on_disk_is_the_map_in_memory_and_one_part(recorded):
    folder, slam, _ = recorded
    losses = []
    state = read_map(folder, losses)
    assert losses == []
    assert [file.name for file in parts_of(folder, MAP)] == ["map.mcap"]
    assert state.first_keyframe == slam.first_keyframe
    assert [one.vertex for one in state.keyframes] == slam.keyframes.ids.tolist()
    assert (state.bounded.old, state.bounded.sightings) == (slam.bounded.old, slam.bounded.sightings)
    assert list(state.bounded.places) == list(slam.bounded.places)
    for mine, theirs in zip(state.graph.tables.values(), slam.graph.tables.values(), strict=True):
        assert mine.type is theirs.type
        for name in ("id", "vertices", "measured", "sqrt_information", "weight"):
            assert getattr(mine, name).values.tobytes() == getattr(theirs, name).values.tobytes()
    assert state.ledger.verdict.values.tolist() == slam.ledger.verdict.values.tolist()
    for one, other in zip(*(flat(of) for of in (state.bounded, slam.bounded)), strict=True):
        assert one.place.information.tobytes() == other.place.information.tobytes()


def flat(state):
    return [one for several in state.places.values() for one in several]


def test_a_map_that_is_taken_up_again_goes_on_condensing(recorded, tmp_path):
    folder, slam, _ = recorded
    losses = []
    start = read_map(folder, losses)
    start.continues_with = "odom"
    longer = list(measurements(hall(SEED, 900)))
    at_ns = slam.keyframes[-1].stamp_ns
    rest = [m for m in longer if m.stamp_ns > at_ns]
    gone_on, summary = record_run(tmp_path / "more", bounded(), [*rest, Control("end")], losses, start)
    assert losses == []
    assert gone_on.first_keyframe > slam.first_keyframe
    assert len(read_tum(tmp_path / "more" / "path.tum").stamps_s) == summary["keyframes"] > 850
    again = read_map(tmp_path / "more", losses, start_only=True)
    assert again is not None and again.first_keyframe == slam.first_keyframe
    assert read_map(tmp_path / "more", losses).first_keyframe == gone_on.first_keyframe
    assert losses == []


def test_with_closures_all_is_kept_and_the_end_says_why():
    assert Config().condenses
    assert bounded(**LOOPS).not_condensed == "loops.use=closure"
    slam, left = driven(hall(4, WINDOW + 300), bounded(**LOOPS))
    assert not left and not slam.first_keyframe
    assert "condensed  nothing: not with loops.use=closure yet" in "\n".join(text(summarize(slam)))


def test_a_condensed_map_goes_on_with_closures_and_one_to_a_keyframe_that_has_left_is_refused_by_name(recorded):
    folder, slam, _ = recorded
    more, covariance = GraphSlam(bounded(**LOOPS), start=read_map(folder, [])), tuple((0.01 * np.eye(3)).ravel())
    drive = [m for m in measurements(hall(SEED, 650)) if m.stamp_ns > slam.keyframes[-1].stamp_ns]
    at_ns, old_ns, new_ns = drive[-1].stamp_ns, slam.bounded.old[5].stamp_ns, drive[40].stamp_ns
    loops = [Closure(at_ns, one_ns, "loops", (1.0, 0.0, 0.0), covariance) for one_ns in (old_ns, new_ns)]
    for m in [*drive, *loops, Control("end")]:
        more.process(m)
    assert more.first_keyframe == slam.first_keyframe
    assert len(more.keyframes) > len(slam.keyframes) + 100
    assert more.counters.as_dict()["loops"] == {"from_condensed_keyframe": 1}


def with_fixes(world, keyframes):
    """Positions at some keyframes, in the frame of the first."""
    begin, rng, k = world.space.group.inverse(world.poses[0]), np.random.default_rng(1), -1
    for m in measurements(world):
        yield m
        k += isinstance(m, Odometry)
        if isinstance(m, Odometry) and k in keyframes:
            at = np.array(world.space.group.act(begin, world.poses[k][:2])) + 0.2 * rng.standard_normal(2)
            yield Fix(m.stamp_ns, "gnss", "position", tuple(at.tolist()), tuple((0.04 * np.eye(2)).ravel().tolist()))


@pytest.mark.parametrize("some", [range(0), range(300, 330, 5)], ids=["blind", "fixes"])
def test_a_stretch_without_a_place_stays_if_it_has_fixes_else_its_odometry_does(some):
    """The keyframes after it are joined to what is before."""
    world = hall(1, KEYFRAMES)
    for k in range(250, 350):
        world.sightings[k] = []
    whole, slam = GraphSlam(config(PLANAR)), GraphSlam(bounded())
    for m in [*with_fixes(world, some), Control("end")]:
        whole.process(m)
        slam.process(m)
    old = {one.number for one in slam.bounded.old}
    assert slam.first_keyframe > 500
    assert set(some) <= old
    assert len(old & set(range(260, 340))) >= 70 if some else len(old & set(range(260, 340))) < 5
    assert len(slam.graph.edges_of("fixes")) == len(some)
    assert slam.counters["map", "visit_lost"] == slam.counters["solver", "SingularError"] == 0
    for one, other in zip(landmarks(world, slam), landmarks(world, whole), strict=True):
        assert one == pytest.approx(other, abs=0.05)
    assert slam.trajectory()[-1] == pytest.approx(whole.trajectory()[-1], abs=0.05)


@pytest.fixture(scope="module")
def saved(recorded):
    return SavedGraph(recorded[0], [])


def test_each_edge_is_explained_by_its_lasting_id(recorded, saved):
    folder, slam, _ = recorded
    assert [saved.edge(e.edge).edge for e in saved.entries] == slam.graph.edge_ids.of_all(
        np.arange(slam.graph.edge_count)
    ).tolist()
    left = list(read_left_edges(folder))
    for row in left[:: len(left) // 10]:
        text = "\n".join(explain_edge(saved, row["edge"]))
        assert text.startswith(f"edge {row['edge']}")
        assert row["label"] in text
        assert f"graph_slam replay {folder} --out WHOLE --set map.condense=false" in " ".join(text.split())
    place = next(e for e in saved.entries if e.label == LABEL)
    text = "\n".join(explain_edge(saved, str(place.edge)))
    assert all(f"{saved.landmark_of(vertex)} (" in text for vertex in place.vertices[1:])


def test_the_whole_says_how_much_is_condensed(recorded, saved):
    folder, slam, _ = recorded
    text = "\n".join(explain_run(saved))
    assert f"condensed: keyframes 0 to {slam.first_keyframe - 1}, into {len(flat(slam.bounded))} places" in text
    assert f"{len(list(read_left_edges(folder)))} condensed (believed" in text
    seen = next(row["landmark"] for row in read_left_edges(folder) if row["landmark"])
    assert "edges are not in the map any more" in "\n".join(explain_edge(saved, seen))


def test_what_if_takes_out_the_edge_of_that_id(recorded, saved):
    _, slam, _ = recorded
    last = saved.entries[-1]
    assert last.edge > len(saved.entries)
    row = slam.graph.edge_ids.find(last.edge)
    solver = saved.solve([last.edge])
    assert row in saved.solver.edges
    assert row not in solver.edges
    assert saved.moved(solver).after.chi2_final < saved.moved(solver).before.chi2_final
    assert {one.edge for one in saved.influences(3)} <= {e.edge for e in saved.entries if e.verdict}
    gone = next(read_left_edges(recorded[0]))["edge"]
    with pytest.raises(GraphSlamError, match=rf"edge {gone} is not in the map any more.*map\.condense=false"):
        saved.solve([int(gone)])
    with pytest.raises(GraphSlamError, match="no edge 99999: their ids are below"):
        saved.solve([99999])


def test_diff_compares_the_whole_paths(recorded, tmp_path):
    folder, slam, _ = recorded
    record_run(tmp_path / "whole", config(PLANAR), read_measurements(folder, []), [])
    found = diff(tmp_path / "whole", folder, [])
    assert (found.keyframes.a, found.keyframes.b, found.keyframes.both) == (500, 500, 500)
    assert found.condensed == (0, slam.first_keyframe)
    assert 0.0 < found.keyframes_m[0] < found.keyframes_m[1] < 0.2
    assert f"{slam.first_keyframe}  keyframes, whose edges are in places" in str(found)
    same = diff(folder, folder, [])
    assert same.is_same
    assert same.edges.a == same.edges.both
