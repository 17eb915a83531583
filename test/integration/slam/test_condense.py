"""The pipeline with ``map.condense``: a map whose size follows its area, live, replayed, killed and taken up again."""

import numpy as np
import pytest
from condensed_run import SEED, WINDOW, bounded, condensed_run
from reliability import times

from benchmarks.hall import STEP_S, config, hall, measurements, without_ids
from benchmarks.judge import rms
from graph_slam_ros.analysis.explain import explain_edge, explain_run
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.graph.place import LABEL
from graph_slam_ros.maps.diff import diff
from graph_slam_ros.runs.condensed_map import WholePath, read_left_edges
from graph_slam_ros.runs.folder import changed_since
from graph_slam_ros.runs.journal import read_measurements
from graph_slam_ros.runs.map_file import read_map, read_start
from graph_slam_ros.runs.outcome import text
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.runs.trajectory import read_tum
from graph_slam_ros.slam import Closure, Config, Control, Fix, GraphSlam, Odometry, Sightings
from graph_slam_ros.slam.association import hindsight
from graph_slam_ros.slam.association.hindsight import FrozenScans, explained
from graph_slam_ros.slam.association.presence_check import Presence
from graph_slam_ros.slam.doubt.record import Doubt
from graph_slam_ros.slam.landmarks.rotations import aligned
from graph_slam_ros.slam.lifelong.state import Left

KEYFRAMES, MORE = 700, times(800, 900)
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


def whole_path(view, left):
    before = Left.joined(view.space, [one.left for one in left])
    return WholePath(view, before).poses()[:, : view.space.dimensions]


def landmarks(world, view):
    vertices = [mark.vertex for mark in view.landmarks.values()]
    return view.solver.estimate(vertices)[:, : view.space.dimensions], world.points[
        [int(name[1:]) for name in view.landmarks]
    ]


@pytest.fixture(scope="module", params=times(["plane"], ["plane", "space with tags"]))
def both(request):
    """A world, and its drives with all keyframes and condensed: the map, and what left its map."""
    name, _, tags = request.param.partition(" ")
    world = hall(2, KEYFRAMES, {"plane": PLANAR, "space": SPATIAL}[name], tags=bool(tags))
    drives = (driven(world, settings) for settings in (config(world.space), bounded(world.space)))
    return world, *((slam.view, left) for slam, left in drives)


def test_the_map_is_small_as_good_and_hardly_surer_and_the_whole_path_is_there(both):
    """docs/lifelong.md has the limits."""
    world, (whole, _), (small, left) = both
    assert small.keyframes.first > 0.6 * KEYFRAMES
    assert len(small.solver.vertices) < 0.4 * len(whole.solver.vertices)
    waiting = whole.graph.edge_count - len(whole.ledger)
    assert small.graph.edge_count == len(small.ledger) + waiting < 0.35 * whole.graph.edge_count
    path = whole_path(small, left)
    assert len(path) == len(whole.keyframes) == len(small.keyframes)
    true = true_path(world, len(path))
    assert rms(path, true) < 1.4 * rms(whole.trajectory()[:, : world.space.dimensions], true)
    assert rms(*landmarks(world, small)) < 1.25 * rms(*landmarks(world, whole))
    names = sorted(whole.landmarks)
    known = [[one.keyframes[-1].vertex, *(one.landmarks[name].vertex for name in names)] for one in (whole, small)]
    before, after = (one.solver.joint_marginal(at) for one, at in zip((whole, small), known, strict=True))
    root = np.linalg.inv(np.linalg.cholesky(before))
    variances = np.linalg.eigvalsh(root @ after @ root.T)
    assert 0.5 < variances[0] <= variances[-1] < 4.0


@pytest.fixture(scope="module")
def recorded():
    return condensed_run()


def test_a_replay_condenses_as_the_live_run_did(recorded, tmp_path):
    folder, slam, _ = recorded
    again, _ = record_run(tmp_path / "again", bounded(), read_measurements(folder, []), [])
    assert again.view.keyframes.first == slam.view.keyframes.first > 0
    assert again.view.solver.values.tobytes() == slam.view.solver.values.tobytes()
    for name in ("path.tum", "landmarks.csv", "ledger.csv", "sightings.tum", "graph.g2o", "graph_vertices.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name
    ours, theirs = (WholePath.of(slam.view, at).left for at in (folder, tmp_path / "again"))
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


def test_a_map_that_is_taken_up_again_goes_on_condensing(recorded, tmp_path):
    folder, slam, _ = recorded
    start = read_map(folder)
    start.continues = True
    longer = list(measurements(hall(SEED, MORE)))
    at_ns = slam.view.keyframes[-1].stamp_ns
    rest = [m for m in longer if m.stamp_ns > at_ns]
    gone_on, summary = record_run(tmp_path / "more", bounded(), [*rest, Control("end")], [], start)
    assert gone_on.view.keyframes.first > slam.view.keyframes.first
    assert len(read_tum(tmp_path / "more" / "path.tum").stamps_s) == summary["keyframes"] > MORE - 50
    again = read_start(tmp_path / "more")
    assert again is not None and again.keyframes.first == slam.view.keyframes.first
    assert read_map(tmp_path / "more").keyframes.first == gone_on.view.keyframes.first


GOES_ON = {
    "nothing": (lambda slam: None, True),
    "a trial fit": (lambda slam: slam.view.trials._background.begin(lambda: lambda _: None, 0), True),
    "a search": (lambda slam: slam.view.backend._background.begin(lambda: lambda _: None, 0), False),
    "an alarm": (lambda slam: setattr(slam.view.backend, "holds_back", True), False),
    "a slip": (lambda slam: slam._doubt.doubts.append(Doubt(0, 20.0, kind="rotation")), False),
    "an edge that is held back": (lambda slam: slam.view.backend._pending.append(7), False),
    "a solve that failed": (lambda slam: slam.restart(), False),
}


@pytest.fixture(scope="module")
def due():
    """The measurement before which a drive is condensed first."""
    slam = GraphSlam(bounded())
    return next(k for k, m in enumerate(measurements(hall(SEED, 500))) if slam.process(m).condensed is not None)


@pytest.mark.parametrize("what", GOES_ON)
def test_it_waits_for_what_could_change_a_verdict_and_for_nothing_else(what, due):
    begin, is_condensed = GOES_ON[what]
    *before, m = list(measurements(hall(SEED, 500)))[: due + 1]
    slam = GraphSlam(bounded())
    for one in before:
        slam.process(one)
    begin(slam)
    assert (slam.process(m).condensed is not None) == is_condensed


def test_with_closures_all_is_kept_and_the_end_says_why():
    assert Config().condenses
    assert bounded(**LOOPS).not_condensed == "loops.use=closure"
    slam, left = driven(hall(4, WINDOW + 300), bounded(**LOOPS))
    assert not left and not slam.view.keyframes.first
    assert "condensed  nothing: not with loops.use=closure yet" in "\n".join(text(summarize(slam)))


def test_a_condensed_map_goes_on_with_closures_and_one_to_a_keyframe_that_has_left_is_refused_by_name(recorded):
    folder, slam, _ = recorded
    more, covariance = GraphSlam(bounded(**LOOPS), start=read_map(folder)), tuple((0.01 * np.eye(3)).ravel())
    drive = [m for m in measurements(hall(SEED, 600)) if m.stamp_ns > slam.view.keyframes[-1].stamp_ns]
    at_ns, old_ns, new_ns = drive[-1].stamp_ns, [*slam.view.bounded.old.values()][5].stamp_ns, drive[40].stamp_ns
    loops = [Closure(at_ns, one_ns, "loops", (1.0, 0.0, 0.0), covariance) for one_ns in (old_ns, new_ns)]
    for m in [*drive, *loops, Control("end")]:
        more.process(m)
    assert more.view.keyframes.first == slam.view.keyframes.first
    assert len(more.view.keyframes) > len(slam.view.keyframes) + 80
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
    old = {*slam.view.bounded.old}
    assert slam.view.keyframes.first > KEYFRAMES - 200
    assert set(some) <= old
    assert len(old & set(range(260, 340))) >= 70 if some else len(old & set(range(260, 340))) < 5
    assert len(slam.view.graph.edges_of("fixes")) == len(some)
    assert slam.counters["map", "visit_lost"] == slam.counters["solver", "unsolved"] == 0
    for one, other in zip(landmarks(world, slam.view), landmarks(world, whole.view), strict=True):
        assert one == pytest.approx(other, abs=0.05)
    assert slam.view.trajectory()[-1] == pytest.approx(whole.view.trajectory()[-1], abs=0.05)


@pytest.fixture(scope="module")
def saved(recorded):
    return SavedGraph(recorded[0], [])


def test_each_edge_is_explained_by_its_lasting_id_and_the_whole_says_how_much_is_condensed(recorded, saved):
    folder, slam, _ = recorded
    assert [saved.edge(e.edge).edge for e in saved.entries] == slam.view.graph.edge_ids.of_all(
        np.arange(slam.view.graph.edge_count)
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
    text, places = "\n".join(explain_run(saved)), sum(map(len, slam.view.bounded.places.values()))
    assert f"condensed: keyframes 0 to {slam.view.keyframes.first - 1}, into {places} places" in text
    assert f"{len(left)} condensed (believed" in text
    seen = next(row["landmark"] for row in left if row["landmark"])
    assert "edges are not in the map any more" in "\n".join(explain_edge(saved, seen))


def test_diff_compares_the_whole_paths(recorded, tmp_path):
    folder, slam, _ = recorded
    record_run(tmp_path / "whole", config(PLANAR), read_measurements(folder, []), [])
    found = diff(tmp_path / "whole", folder, [])
    assert (found.keyframes.a, found.keyframes.b, found.keyframes.both) == (500, 500, 500)
    assert found.condensed == (0, slam.view.keyframes.first)
    assert 0.0 < found.keyframes_m[0] < found.keyframes_m[1] < 0.2
    assert f"{slam.view.keyframes.first}  keyframes, whose edges are in places" in "\n".join(found.lines())
    same = diff(folder, folder, [])
    assert same.is_same
    assert same.edges.a == same.edges.both


FIRST, LATER = times(400, 900), 400
SOAKED = pytest.mark.skipif(not times(0, 1), reason="only in make soak")


def drive(world, begin=0, end=FIRST):
    """What is measured at some keyframes."""
    begin_ns, end_ns = (round((k + 4.5) * STEP_S * 1e9) for k in (begin, end))
    some = (m for m in measurements(world) if begin_ns <= m.stamp_ns < end_ns)
    return [without_ids(m) if isinstance(m, Sightings) else m for m in some]


def unnamed(**values):
    return config(PLANAR, landmarks_association="joint", map_window_keyframes=WINDOW, **values)


@pytest.fixture(scope="module")
def world():
    return hall(2, 900 + LATER)


@pytest.fixture(scope="module")
def without_names(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unnamed") / "run"
    slam, _ = record_run(folder, unnamed(), [*drive(world), Control("end")], [])
    return slam, folder


def assert_each_landmark_is_there_once(view, world, least):
    """Confirmed landmarks, laid on the true ones."""
    there = view.solver.estimate([mark.vertex for mark in view.landmarks.values() if not mark.is_tentative])
    space = world.space
    true = np.stack(space.group.act(space.group.inverse(world.poses[0]), tuple(world.points.T)), axis=-1)
    turn, shift = aligned(there, true[np.linalg.norm(there[:, None] - true[None], axis=2).argmin(axis=1)])
    apart = np.linalg.norm((there @ turn.T + shift)[:, None] - true[None], axis=2)
    assert apart.min(axis=1).max() < 0.5
    assert len(set(apart.argmin(axis=1).tolist())) == len(there) >= least


def test_the_map_is_small_and_each_landmark_is_there_once(world, without_names):
    slam, folder = without_names
    assert slam.view.keyframes.first > times(2 * WINDOW, 540)
    assert len(slam.view.solver.vertices) < times(0.8, 0.4) * (FIRST + 40)
    assert_each_landmark_is_there_once(slam.view, world, least=times(28, 38))
    assert rms(WholePath.of(slam.view, folder).poses()[:, :2], true_path(world, FIRST)) < times(0.25, 0.1)


@SOAKED
def test_a_map_without_names_that_is_taken_up_again_goes_on_condensing(world, without_names, tmp_path):
    slam, folder = without_names
    start = read_map(folder)
    start.continues = True
    rest = drive(world, FIRST, FIRST + LATER)
    more, _ = record_run(tmp_path / "more", unnamed(), [*rest, Control("end")], [], start)
    assert more.view.keyframes.first > slam.view.keyframes.first + 200
    assert_each_landmark_is_there_once(more.view, world, least=38)


@SOAKED
def test_a_stretch_at_a_wrong_place_is_laid_on_the_map(without_names):
    """Two thirds of the window are assigned to copies of the landmarks, 2 m away: the explanation takes that back."""
    slam, _ = without_names
    anonymous = slam._landmarks.anonymous
    frozen = anonymous._frozen()
    count, first = frozen.clusters_of_map, frozen.of_map
    assert count and first == 3
    cut = first + frozen.count // 3
    of_scan = np.repeat(np.arange(len(frozen.scans)), [len(one.clusters) for one in frozen.scans])
    wrong = frozen.given.copy()
    wrong[of_scan >= cut] += np.where(wrong[of_scan >= cut] != -2, 100_000, 0)
    poses = frozen.poses.copy()
    poses[cut:, :2] += (1.5, -1.2)
    moved = FrozenScans(
        *(frozen.scans, frozen.motions, frozen.nearby, poses, frozen.scales, wrong),
        of_map=first,
        clusters_of_map=count,
        times=frozen.times,
    )
    found = explained(slam.view.space, moved, anonymous.hindsight._settings, anonymous.hindsight._costs)
    numbers = found.numbers(dict(enumerate(wrong[count:].tolist())), iter(range(-20_000, -30_000, -1)).__next__)
    now = np.where(found.estimate.which >= 0, numbers[found.estimate.which], -2)[count:]
    is_used = (now != -2) & (frozen.given[count:] != -2)
    assert np.count_nonzero(is_used) > 0.9 * len(now)
    assert np.mean(now[is_used] == frozen.given[count:][is_used]) > 0.97


def test_a_doubtful_map_is_not_condensed_and_the_end_says_so(world, monkeypatch):
    monkeypatch.setattr(hindsight, "presence", lambda *_: Presence(100, 50, 100, 1))
    slam = GraphSlam(unnamed())
    for m in [*drive(world, 0, 300), Control("end")]:
        slam.process(m)
    assert slam.view.keyframes.first == 0
    assert "condensed  nothing: not with a doubtful map of landmarks without ids yet" in "\n".join(
        text(summarize(slam))
    )
