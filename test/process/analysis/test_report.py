import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from graph_slam_ros.analysis.path_error import path_error
from graph_slam_ros.analysis.plots import draw_graph, draw_run
from graph_slam_ros.cli import main
from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.graph import R2, RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.trajectory import Trajectory, read_tum
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag

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


def test_with_truth_everything_is_drawn_in_the_frame_of_the_map_with_the_error_that_is_scored(run, recording, figures):
    (run / "run.json").write_text('{"recording": "yard.mcap"}')
    draw_run(run, run / "bag.mcap", run / "run.png")
    axes, below = figures[0].axes
    truth = np.add(recording.T_world_base[:, :2], (40.0, 0.0))
    drawn = lines(axes)
    assert drawn["truth"] == pytest.approx(truth, abs=1e-6)
    assert drawn["estimate"] == pytest.approx(truth, abs=1e-6)
    assert drawn["start"] == pytest.approx(truth[:1], abs=1e-6)
    assert drawn["end"] == pytest.approx(truth[-1:], abs=1e-6)
    assert drawn["dead reckoning"][0] == pytest.approx(truth[0], abs=1e-6)
    known = np.array([np.add(recording.landmarks[name][:2], (40.0, 0.0)) for name in "0123"])
    assert marks(axes)["landmarks"] == pytest.approx(known, abs=1e-6)
    assert marks(axes)["true landmarks"] == pytest.approx(known, abs=1e-6)  # the one that was not seen is left out
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_aspect()) == ("x [m]", "y [m]", 1.0)
    error = path_error(
        read_tum(run / "odometry.tum"), Trajectory(recording.stamps_ns / 1e9, se3.in_space(recording.T_world_base))
    )
    values = lines(below)["dead reckoning"][:, 1]
    assert (np.sqrt(np.mean(values**2)), values.max()) == pytest.approx(
        (rmse := error.position_m["rmse"], error.position_m["max"])
    )
    title = (
        f"yard.mcap  ·  {len(recording.stamps_ns)} keyframes  ·  4 landmarks  ·  position error 0.000 m RMSE, aligned"
    )
    assert figures[0].get_suptitle() == f"{title}, dead reckoning {rmse:.3f} m"
    for name in ("landmarks.csv", "odometry.tum", "sightings.tum"):
        (run / name).unlink()
    draw_run(run, None, run / "run.png")
    assert set(lines(figures[1].axes[0])) == {"estimate", "start", "end"}
    assert lines(figures[1].axes[0])["estimate"] == pytest.approx(truth, abs=1e-6)


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
    above, side, _ = figures[0].axes
    assert (above.get_xlabel(), above.get_ylabel(), side.get_ylabel()) == ("x [m]", "y [m]", "z [m]")
    assert lines(above)["truth"] == pytest.approx(turned[:, [0, 1]], abs=1e-5)
    assert lines(side)["truth"] == pytest.approx(turned[:, [0, 2]], abs=1e-5)


def ellipses(axes):
    """Of the only collection of them: centres (n, 2), and half axes (n, 2) with the angle of the first."""
    (found,) = [one for one in axes.collections if type(one).__name__ == "EllipseCollection"]
    size = 0.5 * np.column_stack([found.get_widths(), found.get_heights()])
    return np.asarray(found.get_offsets()), size, np.asarray(found.get_angles())


def test_ellipses_are_two_sigma_and_turn_with_the_robot(run, recording, figures):
    poses = np.add(recording.T_world_base, (40.0, 0.0, 0.0))
    rows = [f"{stamp},0.04,0,0,0.01,0,1" for stamp in recording.stamps_ns]  # 0.2 m along the robot, 0.1 m across
    (run / "covariances.csv").write_text("\n".join(["stamp_ns,xx,xy,xt,yy,yt,tt", *rows]) + "\n")
    (run / "landmarks.csv").write_text(f"{COLUMNS}\na,point,3,4,,5,0.09,0,0.01\nb,point,5,5,,1,nan,nan,nan\n")
    draw_run(run, None, run / "run.png")
    centres, half, angles = ellipses(figures[-1].axes[0])
    assert len(centres) == 31, "of thirty poses, and of the landmark whose covariance is known"
    assert half[:-1] == pytest.approx(np.tile([0.4, 0.2], (30, 1)))
    assert half[-1] == pytest.approx([0.6, 0.2])
    assert np.hypot(*(centres[0] - lines(figures[-1].axes[0])["estimate"][0])) < 1e-9
    off = angles[[0, -2, -1]] - [*np.degrees(poses[[0, -1], 2]), 0.0]
    assert (off + 90.0) % 180.0 - 90.0 == pytest.approx(np.zeros(3), abs=1e-4), "an ellipse has two ends"


def test_plot_draws_with_and_without_truth_and_replay_always(tmp_path, recording, figures, capsys):
    write_bag(recording, tmp_path / "yard.mcap")
    bag, out = str(tmp_path / "yard.mcap"), str(tmp_path / "run")
    assert main(["replay", bag, "--out", out]) == 0
    assert f"picture in {out}/path.png" in capsys.readouterr().out
    assert (tmp_path / "run/path.png").stat().st_size > 10_000
    assert figures[0].get_suptitle().startswith("yard.mcap  ·  51 keyframes")
    assert main(["map", "export", out, "--out", str(tmp_path / "a.png")]) == 0
    assert (
        main(["map", "export", out, "--truth", bag, "--topic", "/ground_truth", "--out", str(tmp_path / "b.png")]) == 0
    )
    assert [len(figure.axes) for figure in figures] == [1, 1, 2]
    assert main(["map", "export", out, "--topic", "/odom", "--out", str(tmp_path / "c.png")]) == 2
    assert main(["map", "export", str(tmp_path / "none"), "--out", str(tmp_path / "c.png")]) == 2
    assert main(["map", "export", out, "--out", str(tmp_path / "c.bmp")]) == 2
    assert "its ending is none of .tum, .g2o, .geojson, .mcap, .png" in capsys.readouterr().err


def test_the_animation_repeats_the_drive_and_ends_with_the_solved_path(tmp_path, monkeypatch, capsys):
    write_bag(simulate("pythonrobotics", 2, poses=25), tmp_path / "world.mcap")
    run, gif = tmp_path / "run", tmp_path / "drive.gif"
    assert main(["replay", str(tmp_path / "world.mcap"), "--out", str(run)]) == 0
    assert main(["map", "export", str(run), "--out", str(gif), "--truth", str(tmp_path / "world.mcap")]) == 0
    with Image.open(gif) as image:
        assert image.n_frames > 5
        assert image.size == (480, 480)
        image.seek(image.n_frames - 1)
        assert b"\x1f\x6f\xd6" in image.convert("RGB").tobytes(), "truth is blue"
    capsys.readouterr()
    assert main(["map", "export", str(run), "--out", str(gif)]) == 2, "it is there"
    journal = (run / "ingest.mcap").read_bytes()
    (run / "ingest.mcap").write_bytes(journal[: len(journal) * 9 // 10])
    assert main(["map", "export", str(run), "--out", str(gif), "--force"]) == 3, "a part of the drive is lost"
    (run / "ingest.mcap").unlink()
    assert main(["map", "export", str(run), "--out", str(gif), "--force"]) == 2
    assert capsys.readouterr().err.count("ingest.mcap") > 1


def test_a_graph_is_drawn_before_and_after_with_closures_unlike_odometry(tmp_path, figures):
    final = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [5, 7, 0]])
    initial = final * (1.0, 0.5, 1.0)
    edges = {"odometry": np.array([[0, 1], [1, 2], [2, 3]]), "closures": np.array([[0, 2]])}
    graph = Graph()
    graph.add_vertices(SE2, final[:4])
    graph.add_vertex(R2, final[4, :2])
    for label, ends in edges.items():
        graph.add_edges(RELATIVE_POSE, ends, np.zeros((len(ends), 3)), Gaussian.from_sigmas(1.0, 1.0, 1.0), label)
    draw_graph(tmp_path / "graph.png", graph, initial, final)
    for axes, values in zip(figures[0].axes, (initial, final), strict=True):
        drawn = {c.get_label(): c for c in axes.collections}
        for kind, ends in edges.items():
            assert np.array_equal(drawn[kind].get_segments(), values[ends, :2])
        assert to_hex(drawn["odometry"].get_color()[0]) != to_hex(drawn["closures"].get_color()[0])
        assert marks(axes)["landmarks"].tolist() == [values[4, :2].tolist()]
