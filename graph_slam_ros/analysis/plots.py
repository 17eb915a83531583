"""Pictures of runs and of graphs, drawn into PNG files without a display."""

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from graph_slam_ros.analysis.evaluation import Drive, dimensions_of, input_topics, scored_drive
from graph_slam_ros.analysis.path_error import matched
from graph_slam_ros.analysis.trajectories import Truth, read_truth
from graph_slam_ros.colours import LIGHT, QUIET
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.graph import Graph
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.folder import COVARIANCES, recording_of
from graph_slam_ros.runs.trajectory import Trajectory, read_covariances, read_landmarks, read_rows
from graph_slam_ros.typing import Array, Index

_TRUTH, _ODOMETRY, _ESTIMATE = (LIGHT[name] for name in ("truth", "odometry", "estimate"))
_LANDMARK, _CLOSURE = LIGHT["landmarks"], LIGHT["closures"]
_TRUTH_STYLE = {"label": "truth", "color": _TRUTH, "linewidth": 2.4, "zorder": 2}
_ODOMETRY_STYLE = {"label": "dead reckoning", "color": _ODOMETRY, "linewidth": 1.0, "linestyle": "--", "zorder": 3}
_ESTIMATE_STYLE = {"label": "estimate", "color": _ESTIMATE, "linewidth": 1.3, "zorder": 4}
_INCHES, _DPI = 8.0, 150
_SIGMAS, _ELLIPSES = 2.0, 30  # how large ellipses are drawn, and about how many of the poses
_GAP_S, _LONG_STEPS = 1.0, 5.0  # truth was not recorded where stamps are farther apart and this many times the usual


def draw_run(
    run: Path, truth: Truth | str | Path | None, out_png: Path, topic: str = "", *, align: bool = True
) -> None:
    """Draw a run: dead reckoning black, estimate red, landmarks as stars; truth blue, true landmarks as circles.

    Start and end are marked, 2-sigma ellipses are drawn about landmarks and some of the poses. Everything is in the
    frame map, as in the report: the truth is laid on the estimate, and dead reckoning begins where the estimate does.
    With truth, the position's error over time is below. In space it is drawn from above and from the side.

    Parameters
    ----------
    run : folder of a run, of which ``path.tum`` is there at least
    truth, topic : as ``truth.read_truth`` takes them, or what it has read; None: there is none
    align : lay the truth on the run; False: it is in the frame map already

    Raises GraphSlamError: a file that is missing or unreadable, or a truth that has nothing in common with the run.
    """
    dimensions = dimensions_of(run)
    known = truth if isinstance(truth, Truth) or truth is None else read_truth(truth, topic, input_topics(run))
    drive = scored_drive(run, known.trajectory if known else None)
    whole = read_rows(run / "path.tum")
    found = _placed(drive, whole.at(drive.keyframes), known, dimensions, align=align)
    landmarks = read_landmarks(run / "landmarks.csv")
    points, names = landmarks.positions, set(landmarks.names)
    ellipses = [*_pose_spread(run, drive, found), *zip(points, landmarks.covariances, strict=True)]
    figure, panels, below = _run_figure(found, points, dimensions)
    views = ([0, 1], [0, 2])
    for axes, shown in zip(panels, views, strict=False):
        axes.set_ylabel("xyz"[shown[1]] + " [m]")
        _draw_paths(axes, found, whole, drive, shown)
        _draw_ellipses(axes, ellipses, shown)
        if len(points):
            _draw_stars(axes, points[:, shown])
        if known:
            true_points = np.array([at for name, at in known.landmarks.items() if name in names]).reshape(-1, 3)
            true_points = np.stack(se3.act(found.T_map_truth, tuple(true_points.T)), axis=1)
            if len(true_points):
                circles = {"s": 90, "facecolors": "none", "edgecolors": _TRUTH, "linewidths": 1.0, "zorder": 5}
                axes.scatter(*true_points[:, shown].T, label="true landmarks", **circles)
        for at, (label, mark) in ((0, ("start", "o")), (-1, ("end", "s"))):
            style = {"color": "white", "markeredgecolor": _ESTIMATE, "markeredgewidth": 2.0, "markersize": 8}
            axes.plot(*found.path.poses[at, shown], mark, label=label, zorder=8, **style)
        _limit(axes, found, points, shown)
    if below is not None:
        _draw_errors(below, found)
    _legend(panels[0], at=0.0, side="left")
    title = _title(run, drive, found, len(points), "aligned" if align else "not aligned")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, color="#333333")
    _save(figure, out_png)


@dataclass(frozen=True, slots=True)
class _Placed:
    """A run where it is drawn, in map; errors are stamps [s] and position errors [m], where there is a truth."""

    path: Trajectory
    odometry: Trajectory | None
    truth: Trajectory | None
    T_map_truth: se3.Pose
    errors: tuple[Array, Array] | None = None
    odometry_errors: tuple[Array, Array] | None = None


def _placed(drive: Drive, path: Trajectory, known: Truth | None, dimensions: int, *, align: bool) -> _Placed:
    odometry = moved = drive.odometry if drive.odometry is not None and len(drive.odometry.stamps_s) else None
    if odometry is not None:
        at = int(np.argmin(np.abs(path.stamps_s - odometry.stamps_s[0])))
        first = se3.inverse(tuple(odometry.poses[0].tolist()))
        moved = odometry.moved(se3.compose(tuple(path.poses[at].tolist()), first))
    if not known:
        return _Placed(path, moved, None, se3.IDENTITY)
    one = matched(drive.estimate, known.trajectory, dimensions, align=align)
    errors, odometry_errors = (one.path.stamps_s, one.position_errors_m), None
    if odometry is not None:
        other = matched(odometry, known.trajectory, dimensions)
        odometry_errors = (other.path.stamps_s, other.position_errors_m)
    T_map_truth = se3.inverse(one.T_truth_path)
    true = _with_gaps(_within(known.trajectory, path).moved(T_map_truth))
    return _Placed(path, moved, true, T_map_truth, errors, odometry_errors)


def _title(run: Path, drive: Drive, found: _Placed, landmarks: int, frame: str) -> str:
    name = recording_of(run) or run.resolve().name
    parts = [name, f"{len(found.path.stamps_s)} keyframes", f"{landmarks} landmarks"]
    if drive.count > 1:
        parts.insert(1, f"drive {drive.number} of {drive.count}")
    if found.errors is not None:
        score = f"position error {np.sqrt(np.mean(found.errors[1] ** 2)):.3f} m RMSE, {frame}"
        if found.odometry_errors is not None:
            score += f", dead reckoning {np.sqrt(np.mean(found.odometry_errors[1] ** 2)):.3f} m"
        parts.append(score)
    return "  ·  ".join(parts)


def _draw_paths(axes: Any, found: _Placed, whole: Trajectory, drive: Drive, shown: list[int]) -> None:
    if drive.count > 1:
        others = whole.poses.copy()
        others[drive.keyframes] = np.nan
        axes.plot(*others[:, shown].T, color=QUIET, linewidth=0.8, zorder=1, label="drives before")
    paths = ((found.truth, _TRUTH_STYLE), (found.odometry, _ODOMETRY_STYLE), (found.path, _ESTIMATE_STYLE))
    for drawn, style in paths:
        if drawn is not None:
            axes.plot(*drawn.poses[:, shown].T, solid_joinstyle="round", **style)


def _pose_spread(run: Path, drive: Drive, found: _Placed) -> list[tuple[Array, Array]]:
    """Position and covariance (3, 3) of some of the poses, in the axes that are drawn."""
    if not os.path.lexists(run / COVARIANCES):
        return []
    covariances = read_covariances(run / COVARIANCES)[drive.keyframes]
    if len(covariances) != len(found.path.poses):
        return []
    n = 2 if covariances.shape[1] == 3 else 3
    some = np.unique(np.linspace(0, len(covariances) - 1, _ELLIPSES).astype(int))
    out = []
    for pose, covariance in zip(found.path.poses[some], covariances[some], strict=True):
        turn, spread = Rotation.from_quat(pose[3:]).as_matrix(), np.zeros((3, 3))
        spread[:n, :n] = covariance[:n, :n]
        out.append((pose[:3], turn @ spread @ turn.T))
    return out


def _draw_ellipses(axes: Any, spreads: list[tuple[Array, Array]], shown: list[int]) -> None:
    from matplotlib.collections import EllipseCollection

    known = [(at[shown], c[np.ix_(shown, shown)]) for at, c in spreads if np.isfinite(c).all()]
    if not known:
        return
    values, vectors = np.linalg.eigh(np.array([c for _, c in known]))
    lengths = 2.0 * _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    style: dict[str, Any] = {"facecolors": _ESTIMATE, "edgecolors": _ESTIMATE, "linewidths": 0.6, "alpha": 0.25}
    style |= {"zorder": 4.5, "units": "xy"}
    where = {"offsets": np.array([at for at, _ in known]), "offset_transform": axes.transData}
    drawn = EllipseCollection(lengths[:, 1], lengths[:, 0], angles, **where, **style)
    axes.add_collection(drawn, autolim=False)
    axes.scatter([], [], s=90, color=_ESTIMATE, alpha=0.25, label=f"{_SIGMAS:g} sigma")  # for the legend


def _draw_errors(axes: Any, found: _Placed) -> None:
    """Position errors over time; on a logarithmic scale where dead reckoning's are of another size."""
    start_s = found.path.stamps_s[0]
    of_odometry = None if found.odometry_errors is None else found.odometry_errors[1]
    for errors, style in ((found.odometry_errors, _ODOMETRY_STYLE), (found.errors, _ESTIMATE_STYLE)):
        if errors is not None:
            axes.plot(errors[0] - start_s, errors[1], **style)
    if found.errors is not None and of_odometry is not None and of_odometry.max() > 5.0 * found.errors[1].max() > 0.0:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(bottom=max(1e-4, float(np.percentile(found.errors[1], 2.0))))
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("position error [m]")
    axes.margins(x=0.01)


def _box(found: _Placed, points: Array, axis: int) -> tuple[float, float]:
    """The interval of an axis: it has the estimate, the truth, and all else that is not far from them."""
    sure = [found.path.poses[:, axis]] + ([found.truth.poses[:, axis]] if found.truth is not None else [])
    low, high = float(np.nanmin(np.concatenate(sure))), float(np.nanmax(np.concatenate(sure)))
    reach = max(high - low, 1.0)
    others = [points[:, axis]] + ([found.odometry.poses[:, axis]] if found.odometry is not None else [])
    near = np.concatenate([[low, high], *others])
    near = near[(near > low - reach) & (near < high + reach)]
    return float(near.min()), float(near.max())


def _limit(axes: Any, found: _Placed, points: Array, shown: list[int]) -> None:
    for axis, limit in zip(shown, (axes.set_xlim, axes.set_ylim), strict=True):
        low, high = _box(found, points, axis)
        margin = 0.05 * max(high - low, 1.0)
        limit(low - margin, high + margin)


def _run_figure(found: _Placed, points: Array, dimensions: int) -> tuple[Any, list[Any], Any]:
    """A figure as wide or as high as the path needs; its views, and the axes below for errors, if there are any."""
    sides = [np.ptp(_box(found, points, axis)) + 0.1 for axis in range(3)]
    heights = [sides[1]] if dimensions == 2 else [sides[1], sides[2]]
    tall = [_INCHES * float(np.clip(height / sides[0], 0.35, 1.2)) for height in heights]
    has_errors = found.errors is not None
    size = (_INCHES + 1.0, sum(tall) + (2.2 if has_errors else 0.0) + 1.0)
    figure = canvas(size)
    grid = figure.add_gridspec(len(tall) + has_errors, 1, height_ratios=[*tall, *([2.0] * has_errors)])
    panels = [figure.add_subplot(grid[k]) for k in range(len(tall))]
    for axes in panels:
        dress(axes)
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlabel("x [m]")
    below = figure.add_subplot(grid[-1]) if has_errors else None
    if below is not None:
        dress(below)
    return figure, panels, below


def draw_graph(out_png: Path, graph: Graph, initial: Array, final: Array) -> None:
    """Draw a graph before and after optimisation, side by side.

    Odometry is a dark line, sightings are faint, other edges red.

    Parameters
    ----------
    initial, final : (n, 2) or more columns, x and y [m] of each vertex
    """
    figure = canvas((1.6 * _INCHES, _INCHES))
    pair = figure.subplots(1, 2)
    is_point = np.array([kind.name[0] == "R" for kind in graph.kinds])[graph.kind_codes(graph.vertex_ids.since())]
    tables = [table for table in graph.tables.values() if table.vertices.shape[1] == 2]
    for axes, values, title in zip(pair, (initial, final), ("initial", "optimised"), strict=True):
        dress(axes)
        axes.set(xlabel="x [m]", ylabel="y [m]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.05)
        axes.set_title(title, loc="left", fontsize=11, color="#333333")
        for code, label in enumerate(graph.labels):
            ends = [graph.vertex_ids.rows(table.vertices[table.label.values == code]) for table in tables]
            _draw_edges(axes, values[:, :2], np.concatenate([np.empty((0, 2), dtype=np.int64), *ends]), label)
        if is_point.any():
            _draw_stars(axes, values[is_point, :2])
        elif not tables:
            axes.plot(values[:, 0], values[:, 1], ".", color=_ODOMETRY, markersize=2)
        axes.autoscale_view()
    _legend(pair[1], at=1.0, side="right")
    _save(figure, out_png)


def _within(truth: Trajectory, path: Trajectory) -> Trajectory:
    """The truth during the run; the rest would only make the scale smaller."""
    at = (truth.stamps_s >= path.stamps_s[0] - 1.0) & (truth.stamps_s <= path.stamps_s[-1] + 1.0)
    return Trajectory(truth.stamps_s[at], truth.poses[at])


def _draw_stars(axes: Any, points: Array) -> None:
    style = {"marker": "*", "color": _LANDMARK, "edgecolors": "white", "linewidths": 0.4, "zorder": 6}
    axes.scatter(*points.T, s=70, label="landmarks", **style)


def _with_gaps(truth: Trajectory) -> Trajectory:
    """The path with NaN where nothing was recorded: no line is drawn there."""
    seconds = np.diff(truth.stamps_s)
    usual_s = float(np.median(seconds)) if len(seconds) else 0.0
    gaps = np.flatnonzero(seconds > max(_GAP_S, _LONG_STEPS * usual_s)) + 1
    return Trajectory(np.insert(truth.stamps_s, gaps, np.nan), np.insert(truth.poses, gaps, np.nan, axis=0))


def _draw_edges(axes: Any, points: Array, ends: Index, label: str) -> None:
    from matplotlib.collections import LineCollection

    if not len(ends):
        return
    style = {"odometry": (_ODOMETRY, 1.0, 0.9, 4), "landmarks": (_LANDMARK, 0.4, 0.25, 2)}
    color, width, alpha, layer = style.get(label, (_CLOSURE, 0.6, 0.45, 3))
    name = "sightings" if label == "landmarks" else label
    lines = LineCollection(list(points[ends]), colors=color, linewidths=width, alpha=alpha, zorder=layer, label=name)
    axes.add_collection(lines)
    axes.update_datalim(points[ends].reshape(-1, 2))


def canvas(size: tuple[float, float], dpi: int = _DPI) -> Any:
    """A figure of a size in inches, without pyplot, which has global state and needs a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Any) -> None:
    """Give axes a faint grid and no frame."""
    axes.grid(color="#e6e8eb", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors="#555555", labelsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#b0b4b9")


def _legend(axes: Any, *, at: float, side: str) -> None:
    """Add a legend above the axes, where it covers nothing; faint lines are shown in full colour."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    style = {"frameon": False, "fontsize": 9.5, "columnspacing": 1.6, "handlelength": 1.6, "borderaxespad": 0.0}
    legend = axes.legend(
        handles, labels, loc=f"lower {side}", bbox_to_anchor=(at, 1.01), ncols=min(len(handles), 4), **style
    )
    for line in legend.get_lines():
        line.set_alpha(1.0)
        line.set_linewidth(max(1.2, line.get_linewidth()))


def _save(figure: Any, out_png: Path) -> None:
    if Path(out_png).suffix != ".png":
        raise GraphSlamError(f"{out_png}: a picture is a .png file")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", metadata={"Software": "graph_slam_ros"})
    try:
        write_whole(Path(out_png), picture.getvalue())
    except OSError as error:
        raise GraphSlamError(f"{out_png}: {error.strerror or error}") from None
