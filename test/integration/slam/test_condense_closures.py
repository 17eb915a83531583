"""A map that is known by closures alone follows its area, and closures may begin at keyframes that have left it."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.city import City, config
from benchmarks.hall import rms
from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import FormatError
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.runs.condensed_map import LEFT, read_left
from graph_slam_ros.runs.journal import RecordWriter, read_measurements, read_records
from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.runs.tables import account
from graph_slam_ros.runs.whole_path import removed_path
from graph_slam_ros.slam import Closure, Control, GraphSlam
from graph_slam_ros.slam.lifelong.removed import Left
from graph_slam_ros.slam.robust.ledger import Verdict

KEYFRAMES, BLOCKS, WINDOW = 1000, 4, 100
SPACES = {"plane": PLANAR, "space": SPATIAL}


def bounded(space=PLANAR, **values):
    return config(space, map_window_keyframes=WINDOW, **values)


def driven(city, settings, changed=None):
    """The pipeline after a drive, what has left its map, errors of the newest pose by its covariance, and vertices."""
    slam, left, nees, sizes, group = GraphSlam(settings), [], [], [], city.space.group
    for k, given in enumerate(city.measurements()):
        for m in given:
            update = slam.process(m)
            left += [update.condensed.left] if update.condensed is not None else []
        if changed is not None:
            changed(slam)
        if k > 400 and k % 20 == 0:
            newest = slam.keyframes[-1].vertex
            (pose,), (covariance,) = slam.solver.estimate([newest]), slam.solver.marginal([newest])
            off = np.array(group.log(group.between(tuple(pose), city.in_map(len(slam.keyframes) - 1))))
            nees.append(off @ np.linalg.solve(covariance, off) / len(off))
            sizes.append(len(slam.solver.vertices))
    slam.process(Control("end"))
    return slam, left, float(np.mean(nees)), sizes


def error(city, slam, left):
    path = slam.trajectory()
    if left:
        path = np.concatenate((removed_path(slam, Left.joined(slam.space, left)), path))
    true = np.zeros((len(path), city.space.dimensions))
    true[:, :2] = city.where[: len(path)]
    return rms(path[:, : city.space.dimensions], true)


@pytest.fixture(scope="module", params=SPACES)
def both(request):
    space = SPACES[request.param]
    whole = driven(City(3, KEYFRAMES, space, BLOCKS), config(space, map_condense=False))
    return City(3, KEYFRAMES, space, BLOCKS), whole, driven(City(3, KEYFRAMES, space, BLOCKS), bounded(space))


def test_the_map_follows_the_area_and_is_nearly_as_good_and_no_surer(both):
    city, whole, small = both
    assert small[0].first_keyframe > 0.8 * KEYFRAMES
    assert error(city, *small[:2]) < 1.3 * error(city, *whole[:2])
    assert small[2] < max(1.5 * whole[2], 1.5)
    sizes = small[3]
    assert sizes[-1] < 1.25 * sizes[len(sizes) // 2] < 0.6 * KEYFRAMES
    assert set(small[0].counters.as_dict()) == {"map"}  # no closure was refused
    assert set(small[0].counters.as_dict()["map"]) == {"not_condensed", "visit_condensed"}


def test_false_closures_that_were_condensed_are_outvoted(both):
    city, _, clean = both
    planted = []

    def falsify(slam):
        """Five closures between old keyframes were false, and nobody had noticed until they were condensed."""
        if planted or slam.first_keyframe < 450:
            return
        old = {one.vertex for one in slam.bounded.old}
        among = [e for e in slam.graph.edges_of("closures").tolist() if old.issuperset(slam.graph.edge(e).vertices)]
        for edge in among[:: len(among) // 5][:5]:
            table, row = slam.graph.row(edge)
            table.measured.values[row, 0] += 2.0
            planted.append(slam.graph.edge_ids.of(edge))
        slam.solver.rebuild()

    slam, left, *_ = driven(City(3, KEYFRAMES, city.space, BLOCKS), bounded(city.space), falsify)
    assert len(planted) == 5
    rows = [slam.graph.edge_ids.find(one) for one in planted]
    doubted = {slam.ledger.verdict_of(row) for row in rows if row is not None}
    assert doubted <= {Verdict.DOWN_WEIGHTED, Verdict.REJECTED}
    assert error(city, slam, left) < 1.1 * error(city, *clean[:2])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    city, folder = City(5, 620, PLANAR, 3), tmp_path_factory.mktemp("city") / "run"
    drive = [m for given in city.measurements() for m in given]
    slam, _ = record_run(folder, bounded(), [*drive, Control("end"), Control("optimize")], [])
    return folder, slam, drive


def test_an_input_of_any_name_is_accounted_for(recorded):
    """Also one that is called as the label of its edges."""
    inputs = {"inputs_names": "odom closures", "closures_use": "closure", "closures_topic": "/loops"}
    drive = [replace(m, topic="closures") if isinstance(m, Closure) else m for m in recorded[2]]
    settings = Config.from_mapping(
        {name: value for name, value in flat(bounded()) if not name.startswith(("loops.", "inputs."))}
        | {name.replace("_", ".", 1): value for name, value in inputs.items()}
    )
    slam = GraphSlam(settings)
    for m in [*drive, Control("end")]:
        slam.process(m)
    assert slam.first_keyframe > 300
    counts = account(slam, slam.counters)["inputs"]
    assert set(counts) == {"odom", "closures"}
    assert counts["closures"]["used"] == sum(isinstance(m, Closure) for m in drive)
    assert 0.99 * counts["closures"]["used"] <= counts["closures"]["believed"] <= counts["closures"]["used"]


def flat(settings):
    return ((f"{a}.{b}", value) for a, of in settings.as_mapping().items() for b, value in of.items())


def test_a_replay_gives_the_same_bytes(recorded, tmp_path):
    folder, slam, _ = recorded
    again, _ = record_run(tmp_path / "again", bounded(), read_measurements(folder, []), [])
    assert again.first_keyframe == slam.first_keyframe > 300
    for name in ("path.tum", "ledger.csv", "graph.g2o"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name
    ours, theirs = (read_left(at, PLANAR, slam.bounded) for at in (folder, tmp_path / "again"))
    assert ours.keyframes.tobytes() == theirs.keyframes.tobytes()


def test_closures_to_keyframes_that_left_before_a_restart_are_used(recorded, tmp_path):
    folder, slam, _ = recorded
    start = read_map(folder, [])
    assert start.bounded.skeleton.positions == slam.bounded.skeleton.positions
    rows = range(slam.bounded.attached.first, slam.bounded.attached.end)
    assert len(rows) == slam.first_keyframe
    assert all(start.bounded.attached.read(k).tobytes() == slam.bounded.attached.read(k).tobytes() for k in rows)
    start.continues_with = "odom"
    longer = [m for given in City(5, 900, PLANAR, 3).measurements() for m in given]
    rest = [m for m in longer if m.stamp_ns > slam.keyframes[-1].stamp_ns]
    more, _ = record_run(tmp_path / "more", bounded(), [*rest, Control("end")], [], start)
    assert more.first_keyframe > slam.first_keyframe
    assert set(more.counters.as_dict()) == {"map"}
    again = read_map(tmp_path / "more", [])
    assert again.bounded.attached.end == more.first_keyframe


def test_a_restart_without_what_left_says_so(recorded, tmp_path):
    folder, *_ = recorded
    copy = tmp_path / "copy"
    copy.mkdir()
    for file in folder.iterdir():
        if file.name != "condensed.mcap":
            (copy / file.name).write_bytes(file.read_bytes())
    with pytest.raises(Exception, match=r"condensed\.mcap has 0 keyframes"):
        read_map(copy, [])


@pytest.mark.parametrize("damage", ["", "AAAA", "not base64!", 7])
def test_rows_that_cannot_be_read_are_said_in_a_line(recorded, tmp_path, damage):
    folder, *_ = recorded
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    records = list(read_records(folder, "condensed", []))
    (copy / "condensed.mcap").unlink()
    writer = RecordWriter(copy / "condensed.mcap", LEFT)
    for k, record in enumerate(records):
        writer.write([record | ({"attached": damage} if k == 0 else {})])
    writer.close()
    with pytest.raises(FormatError, match=r"condensed\.mcap has 0 keyframes"):
        read_map(copy, [])
