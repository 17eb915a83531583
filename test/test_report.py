import subprocess
import sys

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import imread

from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.lie import se3
from graph_slam_ros.report import draw_graph, draw_run
from graph_slam_ros.simulation import simulate, write_bag
from graph_slam_ros.slam import Config

COLUMNS = "id,kind,x,y,theta,sightings,cov_xx,cov_xy,cov_yy"


@pytest.fixture
def figures(monkeypatch):
    """The figures that were saved, in order."""
    saved, savefig = [], Figure.savefig

    def save(figure, *args, **kwargs):
        saved.append(figure)
        savefig(figure, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", save)
    return saved


def lines(axes):
    """Points (n, 2) of each line by label."""
    return {line.get_label(): line.get_xydata() for line in axes.get_lines()}


def marks(axes):
    """Points (n, 2) of each set of marks by label."""
    return {marks.get_label(): np.asarray(marks.get_offsets()) for marks in axes.collections}


def tum(stamps_s, poses):
    theta = poses[:, 2]
    columns = [stamps_s, poses[:, :2], np.zeros((len(poses), 3)), np.sin(0.5 * theta), np.cos(0.5 * theta)]
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in np.column_stack(columns))


@pytest.fixture
def recording():
    return simulate("pythonrobotics", 2)


@pytest.fixture
def run(tmp_path, recording):
    """A run whose estimate is the truth in a frame that is 40 m away."""
    stamps_s, truth = recording.stamps_ns / 1e9, recording.T_world_base
    for name in ("path.tum", "sightings.tum"):
        (tmp_path / name).write_text(tum(stamps_s, np.add(truth, (40.0, 0.0, 0.0))))
    (tmp_path / "odometry.tum").write_text(tum(stamps_s, recording.T_odom_base))
    rows = [f"{name},point,{40.0 + x},{y},,5,1,0,1" for name, (x, y) in recording.landmarks.items() if name != "4"]
    (tmp_path / "landmarks.csv").write_text("\n".join([COLUMNS, *rows]) + "\n")
    write_bag(recording, tmp_path / "bag.mcap")
    return tmp_path


def test_with_truth_everything_is_drawn_in_the_frame_of_the_truth(run, recording, figures):
    draw_run(run, run / "bag.mcap", run / "run.png")
    (axes,) = figures[0].axes
    truth = recording.T_world_base[:, :2]
    drawn = lines(axes)
    assert drawn["truth"] == pytest.approx(truth, abs=1e-6)
    assert drawn["estimate"] == pytest.approx(truth, abs=1e-6)
    assert drawn["start"] == pytest.approx(truth[:1], abs=1e-6)
    # dead reckoning is aligned by itself: about the same place
    assert drawn["dead reckoning"].mean(axis=0) == pytest.approx(truth.mean(axis=0), abs=1e-6)
    known = np.array([recording.landmarks[name][:2] for name in "0123"])
    assert marks(axes)["landmarks"] == pytest.approx(known, abs=1e-6)
    assert marks(axes)["true landmarks"] == pytest.approx(known, abs=1e-6)  # the one that was not seen is left out


def test_paths_have_their_colors_and_axes_their_units_and_one_scale(run, figures):
    draw_run(run, run / "bag.mcap", run / "run.png")
    (axes,) = figures[0].axes
    colors = {line.get_label(): to_hex(line.get_color()) for line in axes.get_lines()}
    assert (colors["truth"], colors["dead reckoning"], colors["estimate"]) == ("#1f6fd6", "#1a1a1a", "#d62728")
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_aspect()) == ("x [m]", "y [m]", 1.0)
    legend = axes.get_legend()
    assert {text.get_text() for text in legend.get_texts()} == set(colors) | {"landmarks", "true landmarks"}
    image = imread(run / "run.png")
    assert min(image.shape[:2]) > 1000
    assert image[:, :, :3].std() > 0.05


def test_without_truth_or_landmarks_the_run_is_drawn_in_its_own_frame(run, recording, figures):
    (run / "landmarks.csv").unlink()
    (run / "odometry.tum").unlink()
    draw_run(run, None, run / "run.png")
    (axes,) = figures[0].axes
    assert set(lines(axes)) == {"estimate", "start"}
    assert lines(axes)["estimate"] == pytest.approx(np.add(recording.T_world_base[:, :2], (40.0, 0.0)), abs=1e-6)


@pytest.mark.parametrize("left", [None, ""])
def test_a_run_that_saw_nothing_is_aligned_by_its_keyframes(run, recording, figures, left):
    (run / "sightings.tum").unlink()
    if left is not None:
        (run / "sightings.tum").write_text(left)
    draw_run(run, run / "bag.mcap", run / "run.png")
    assert lines(figures[0].axes[0])["estimate"] == pytest.approx(recording.T_world_base[:, :2], abs=1e-6)


def test_no_line_crosses_a_gap_in_the_truth_and_none_of_it_outside_the_run_is_drawn(run, recording, figures):
    stamps_s = recording.stamps_ns / 1e9
    keep = [k for k in range(51) if k <= 10 or k >= 25]
    before = np.add(stamps_s[:5], -100.0)
    poses = np.vstack([np.add(recording.T_world_base[:5], (500.0, 0.0, 0.0)), recording.T_world_base[keep]])
    (run / "truth.tum").write_text(tum(np.concatenate([before, stamps_s[keep]]), poses))
    draw_run(run, run / "truth.tum", run / "run.png")
    drawn = lines(figures[0].axes[0])["truth"]
    assert np.isnan(drawn).all(axis=1).nonzero()[0].tolist() == [11]
    assert len(drawn) == len(keep) + 1
    assert np.nanmax(np.abs(drawn)) < 50.0


def test_a_run_in_space_is_drawn_from_above_and_from_the_side(tmp_path, figures):
    flight = simulate("flight", 1, laps=1)
    write_bag(flight, tmp_path / "bag.mcap")
    stamps, truth = flight.stamps_ns.tolist(), flight.T_world_base
    turned = np.stack(se3.compose(se3.exp((9.0, 2.0, 5.0, 0.4, 0.1, 2.0)), tuple(truth.T)), axis=1)
    for name in ("path.tum", "sightings.tum"):
        (tmp_path / name).write_text(tum_text(stamps, turned))
    (tmp_path / "config.yaml").write_text(parameters_text(Config.from_mapping({"world.dimensions": 3}).as_mapping()))
    (tmp_path / "ingest.mcap").write_bytes(b"")
    draw_run(tmp_path, tmp_path / "bag.mcap", tmp_path / "run.png")
    above, side = figures[0].axes
    assert (above.get_xlabel(), above.get_ylabel(), side.get_ylabel()) == ("x [m]", "y [m]", "z [m]")
    assert lines(above)["estimate"] == pytest.approx(truth[:, [0, 1]], abs=1e-6)
    assert lines(side)["estimate"] == pytest.approx(truth[:, [0, 2]], abs=1e-6)


def test_a_graph_is_drawn_before_and_after_with_closures_unlike_odometry(tmp_path, figures):
    final = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]])
    initial = final * (1.0, 0.5, 1.0)
    edges = {"odometry": np.array([[0, 1], [1, 2], [2, 3]]), "closures": np.array([[0, 2]])}
    draw_graph(tmp_path / "graph.png", initial, final, edges)
    for axes, values in zip(figures[0].axes, (initial, final), strict=True):
        drawn = {c.get_label(): c for c in axes.collections}
        assert np.array_equal(drawn["odometry"].get_segments(), values[edges["odometry"], :2])
        assert np.array_equal(drawn["closures"].get_segments(), values[edges["closures"], :2])
        assert to_hex(drawn["odometry"].get_color()[0]) != to_hex(drawn["closures"].get_color()[0])
        low, high = axes.get_xlim()
        assert low < 0.0 < 10.0 < high
    legend = figures[0].axes[1].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["odometry", "closures"]


def test_landmarks_of_a_graph_are_marked_before_and_after(tmp_path, figures):
    initial, final = np.array([[0.0, 0, 0], [10, 0, 0], [5, 7, 0]]), np.array([[0.0, 0, 0], [10, 0, 0], [5, 8, 0]])
    edges = {"odometry": np.array([[0, 1]]), "landmarks": np.array([[0, 2], [1, 2]])}
    draw_graph(tmp_path / "graph.png", initial, final, edges, landmarks=np.array([2]))
    assert [marks(axes)["landmarks"].tolist() for axes in figures[0].axes] == [[[5.0, 7.0]], [[5.0, 8.0]]]


def test_a_graph_without_edges_is_drawn_too(tmp_path, figures):
    draw_graph(tmp_path / "graph.png", np.zeros((1, 3)), np.zeros((1, 3)), {})
    assert (tmp_path / "graph.png").stat().st_size > 0
    assert len(figures[0].axes) == 2


def test_matplotlib_is_imported_when_something_is_drawn_and_pyplot_never(tmp_path):
    script = f"""
import sys
import numpy as np
from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.lie import se3
from graph_slam_ros.report import draw_graph
assert "matplotlib" not in sys.modules
draw_graph({str(tmp_path / "graph.png")!r}, np.zeros((2, 3)), np.eye(2, 3), {{"odometry": np.array([[0, 1]])}})
assert "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
