"""What a Python program meets: results of a run, short words for objects, and the table of edge types."""

import numpy as np
import pytest
import small_drive
from messages import record_drive
from places import ROOT
from rows import each

import graph_slam_ros
from graph_slam_ros import GraphSlam, Odometry, Sighting, Sightings, load_run
from graph_slam_ros import graph as edge_module
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.edge_tags import EDGE_TAGS
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import EdgeType
from graph_slam_ros.measurements import Closure
from graph_slam_ros.runs.restore import map_of, record_run
from graph_slam_ros.tools.report.places import keyframe_paths


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("library")
    replayed = graph_slam_ros.replay(str(record_drive(folder / "bag.mcap", 8)), str(folder / "run"))
    return replayed.slam, folder / "run"


def test_replay_takes_texts_and_a_run_is_loaded_with_stamps_names_and_covariances(done):
    slam, folder = done
    run = load_run(str(folder))
    path = run.trajectory()
    assert path.stamps_s == pytest.approx(slam.view.keyframes.stamps_ns / 1e9, abs=1e-6)
    assert path.poses[:, :2] == pytest.approx(slam.view.trajectory()[:, :2])
    assert run.odometry().poses[:, :2] == pytest.approx(slam.view.keyframes.poses[:, :2])
    assert run.covariances == pytest.approx(slam.view.keyframe_covariances(), nan_ok=True)
    assert run.landmarks.names == tuple(slam.view.landmarks)
    for name, landmark in slam.view.landmarks.items():
        at = slam.view.solver.estimate([landmark.vertex])[0]
        assert run.landmarks[name] == pytest.approx([*at[:2], 0.0])
    assert (run.config, run.summary["recording"], run.warnings) == (slam.view.config, "bag.mcap", [])
    assert len(run.edges) == slam.view.graph.edge_count
    with pytest.raises(AttributeError, match=r"GraphSlam\.view\.trajectory"):
        slam.trajectory()  # as scripts had it before


def test_an_older_drive_in_a_newer_map_is_read_by_keyframe(tmp_path):
    start = map_of(small_drive.run(tmp_path / "map", start_s=9000), [])
    slam, _ = record_run(tmp_path / "run", small_drive.config(), small_drive.drive(seed=1), [], start)
    stamps_s = slam.view.keyframes.stamps_ns / 1e9
    assert np.diff(stamps_s).min() < -3000.0
    run = load_run(tmp_path / "run")
    pages = keyframe_paths(SavedGraph(tmp_path / "run", []))
    for path in (run.trajectory(), pages[0]):
        assert path.stamps_s == pytest.approx(stamps_s, abs=1e-6)
        assert path.poses[:, :2] == pytest.approx(slam.view.trajectory()[:, :2], abs=1e-6)
    for path in (run.odometry(), pages[1]):
        assert path.poses[:, :2] == pytest.approx(slam.view.keyframes.poses[:, :2])


def test_what_is_no_run_or_has_no_results_is_refused(done, tmp_path):
    with pytest.raises(GraphSlamError, match="not a run's folder"):
        load_run(tmp_path)
    for name in ("config.yaml", "ingest.mcap"):
        (tmp_path / name).write_bytes((done[1] / name).read_bytes())
    with pytest.raises(GraphSlamError, match="graph_slam recover"):
        load_run(tmp_path)
    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(GraphSlamError, match=r"run\.json"):
        load_run(tmp_path)


@each(
    "make, words",
    [
        (lambda: Odometry(0, None), "3 or 7 finite numbers"),
        (lambda: Odometry(0.5, (0, 0, 0)), "stamp_ns 0.5: it must be whole nanoseconds"),
        (lambda: Closure(0, 10**25, "scan", (0, 0, 0), np.eye(3)), "from_stamp_ns 10000000000000000000000000: it must"),
        (lambda: Odometry(0, (0, 0, 0, 0, 0, 0, 2)), "of length 1"),
        (lambda: Sighting("a", "position", (1, 2), -np.eye(2)), "no variance negative"),
        (lambda: Sightings(0, "tags", [("a", 1, 2)]), "a tuple, not a Sighting"),
        (lambda: GraphSlam().process(Sighting(7, "position", (1, 2), np.eye(2))), "Sighting is not one of Odometry"),
    ],
)
def test_a_measurement_is_checked_where_it_is_made_and_may_be_of_arrays_lists_and_numbers(make, words):
    with pytest.raises(GraphSlamError, match=words):
        make()
    several = Sightings(np.int64(0), "tags", [Sighting(np.int64(0), "position", np.ones(2), np.eye(2))])
    assert (hash(several) != 0, several.sightings[0].id) == (True, "0")


def documented():
    """Rows of docs/edges.md by the name of the edge type."""
    for line in (ROOT / "docs/edges.md").read_text().splitlines():
        if line.startswith("| `"):
            name, tag, *cells = (cell.strip(" `") for cell in line.strip("|").split("|")[:6])
            yield name, tag, *([word.strip(" `") for word in cell.split(",") if cell] for cell in cells)


def edge_types():
    for name, value in vars(edge_module).items():
        if isinstance(value, EdgeType):
            yield name, value
        elif isinstance(value, dict) and name in ("POINT_PRIOR", "DIFFERENCE"):
            yield from ((f"{name}[{kind.name}]", edge) for kind, edge in value.items())


def test_the_page_of_edge_types_is_the_table_of_edge_types():
    known, tags = dict(edge_types()), {id(edge): tag for tag, edge in EDGE_TAGS.items()}
    rows = {name: rest for name, *rest in documented()}
    assert set(rows) == set(known)
    for name, (tag, vertices, measured, residual, sensor) in rows.items():
        edge = known[name]
        assert tag == tags.get(id(edge), ""), name
        assert [vertex.split()[0] for vertex in vertices] == [kinds[0].name for kinds in edge.accepts], name
        assert (len(measured) + len(sensor), len(sensor)) == (edge.measured_size, len(edge.tail)), name
        assert len(residual) == edge.residual_size and set(residual) <= {"m", "rad"}, name
