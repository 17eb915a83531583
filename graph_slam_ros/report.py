"""Pictures of runs and of graphs, drawn into PNG files without a display."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros import evaluation
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se3
from graph_slam_ros.path_error import alignment, associate
from graph_slam_ros.trajectory import Trajectory, read_landmarks, read_tum
from graph_slam_ros.truth import read_truth

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TRUTH, _ODOMETRY, _ESTIMATE, _LANDMARK = "#1f6fd6", "#1a1a1a", "#d62728", "#e08a00"
_CLOSURE, _SIGHTING, _QUIET = "#d62728", "#e08a00", "#9aa0a6"
_TRUTH_LOOK = {"label": "truth", "color": _TRUTH, "linewidth": 2.4, "zorder": 2}
_ODOMETRY_LOOK = {"label": "dead reckoning", "color": _ODOMETRY, "linewidth": 1.0, "zorder": 3}
_ESTIMATE_LOOK = {"label": "estimate", "color": _ESTIMATE, "linewidth": 1.3, "zorder": 4}
_INCHES, _DPI = 8.0, 150
_GAP_S, _LONG_STEPS = 1.0, 5.0  # truth was not recorded where stamps are farther apart and this many times the usual


def draw_run(run: Path, truth: str | Path | None, out_png: Path) -> None:
    """Draw a run: dead reckoning black, estimate red, landmarks as stars; truth blue, true landmarks as circles.

    With truth, everything is in its frame, each path moved onto it as for the scores (landmarks with the estimate);
    without, in the frame map. In space it is drawn from above and from the side.

    Parameters
    ----------
    run : folder with ``path.tum`` and, where there are any, ``sightings.tum``, ``odometry.tum`` and ``landmarks.csv``
    truth : ``BAG``, ``BAG:TOPIC``, ``FILE.tum`` or None

    Raises
    ------
    GraphSlamError
        A file that is missing or unreadable, or no evo to align with.
    """
    dimensions = evaluation.dimensions_of(run)
    path = read_tum(run / "path.tum")
    odometry = read_tum(run / "odometry.tum") if (run / "odometry.tum").exists() else None
    landmarks = {name: landmark.position for name, landmark in read_landmarks(run / "landmarks.csv").items()}
    true_path, true_landmarks = None, np.zeros((0, 3))
    T_world_map = se3.IDENTITY
    if truth is not None:
        known = read_truth(truth)
        true_landmarks = np.array([at for name, at in known.landmarks.items() if name in landmarks]).reshape(-1, 3)
        scored = run / "sightings.tum"
        has_sightings = scored.exists() and scored.stat().st_size > 0
        T_world_map = _onto(read_tum(scored) if has_sightings else path, known.trajectory, dimensions)
        if odometry is not None:
            odometry = odometry.moved(_onto(odometry, known.trajectory, dimensions))
        true_path = _with_gaps(_within(known.trajectory, path))
    path = path.moved(T_world_map)
    points = np.stack(se3.act(T_world_map, tuple(np.array(list(landmarks.values())).reshape(-1, 3).T)), axis=1)
    figure, panels = _figure(dimensions - 1)
    for axes, shown in zip(np.ravel(panels), ([0, 1], [0, 2]), strict=False):
        axes.set_ylabel("xyz"[shown[1]] + " [m]")
        for drawn, look in ((true_path, _TRUTH_LOOK), (odometry, _ODOMETRY_LOOK), (path, _ESTIMATE_LOOK)):
            if drawn is not None:
                axes.plot(*drawn.poses[:, shown].T, solid_joinstyle="round", **look)
        if len(points):
            _draw_stars(axes, points[:, shown])
        if len(true_landmarks):
            circles = {"s": 90, "facecolors": "none", "edgecolors": _TRUTH, "linewidths": 1.0, "zorder": 5}
            axes.scatter(*true_landmarks[:, shown].T, label="true landmarks", **circles)
        start = {"color": _ESTIMATE, "markeredgecolor": "white", "markersize": 7, "zorder": 7, "label": "start"}
        axes.plot(*path.poses[0, shown], "o", **start)
    _legend(np.ravel(panels)[-1], at=0.5 if dimensions == 2 else 1.0, side="center" if dimensions == 2 else "right")
    _save(figure, out_png)


def draw_graph(
    out_png: Path,
    initial: Array,
    final: Array,
    edges: Mapping[str, Index],
    landmarks: Array | None = None,
) -> None:
    """Draw a graph before and after optimisation, side by side.

    Parameters
    ----------
    initial, final : (n, 2) or more columns, x and y [m] of each vertex, in the same order
    edges : (m, 2) rows of those arrays, by label: ``odometry`` as a dark line, ``landmarks`` faint, others red
    landmarks : rows that are landmarks; the others are poses
    """
    figure, pair = _figure(2)
    is_point = np.zeros(len(final), dtype=bool)
    if landmarks is not None:
        is_point[landmarks] = True
    for axes, values, title in zip(pair, (initial, final), ("initial", "optimised"), strict=True):
        axes.set_title(title, loc="left", fontsize=11, color="#333333")
        for order, (label, ends) in enumerate(edges.items()):
            _draw_edges(axes, values[:, :2], np.asarray(ends).reshape(-1, 2), label, order)
        if is_point.any():
            _draw_stars(axes, values[is_point, :2])
        elif not edges:
            axes.plot(values[:, 0], values[:, 1], ".", color=_ODOMETRY, markersize=2)
        axes.autoscale_view()
    _legend(pair[1], at=1.0, side="right")
    _save(figure, out_png)


def _onto(path: Trajectory, truth: Trajectory, dimensions: int) -> se3.Pose:
    mine, theirs = associate(path, truth)
    return alignment(mine.poses[:, :dimensions], theirs.poses[:, :dimensions])


def _within(truth: Trajectory, path: Trajectory) -> Trajectory:
    """The truth during the run: what came before and after would only shrink the picture."""
    at = (truth.stamps_s >= path.stamps_s[0] - 1.0) & (truth.stamps_s <= path.stamps_s[-1] + 1.0)
    return Trajectory(truth.stamps_s[at], truth.poses[at])


def _draw_stars(axes: Any, points: Array) -> None:
    look = {"marker": "*", "color": _LANDMARK, "edgecolors": "white", "linewidths": 0.4, "zorder": 6}
    axes.scatter(*points.T, s=70, label="landmarks", **look)


def _with_gaps(truth: Trajectory) -> Trajectory:
    """Not a number where nothing was recorded: no line is drawn there."""
    seconds = np.diff(truth.stamps_s)
    usual_s = float(np.median(seconds)) if len(seconds) else 0.0
    gaps = np.flatnonzero(seconds > max(_GAP_S, _LONG_STEPS * usual_s)) + 1
    return Trajectory(np.insert(truth.stamps_s, gaps, np.nan), np.insert(truth.poses, gaps, np.nan, axis=0))


def _draw_edges(axes: Any, points: Array, ends: Index, label: str, order: int) -> None:
    from matplotlib.collections import LineCollection

    looks = {"odometry": (_ODOMETRY, 1.0, 0.9, 4), "landmarks": (_SIGHTING, 0.4, 0.25, 2)}
    color, width, alpha, layer = looks.get(label, (_CLOSURE, 0.6, 0.45, 3))
    name = "sightings" if label == "landmarks" else label
    lines = LineCollection(list(points[ends]), colors=color, linewidths=width, alpha=alpha, zorder=layer, label=name)
    axes.add_collection(lines)
    axes.update_datalim(points[ends].reshape(-1, 2))


def _figure(count: int = 1) -> Any:
    """A figure and its axes, equal scales, metres; without pyplot, which would keep state and look for a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_INCHES * (1.0 + 0.6 * (count - 1)), _INCHES), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, count, squeeze=False)[0]
    for one in axes:
        one.set_aspect("equal", adjustable="datalim")
        one.set_xlabel("x [m]")
        one.set_ylabel("y [m]")
        one.grid(color="#e6e8eb", linewidth=0.6)
        one.set_axisbelow(True)
        one.tick_params(colors="#555555", labelsize=9)
        for side in ("top", "right"):
            one.spines[side].set_visible(False)
        for side in ("left", "bottom"):
            one.spines[side].set_color("#b0b4b9")
        one.margins(0.05)
    return figure, (axes[0] if count == 1 else axes)


def _legend(axes: Any, *, at: float, side: str) -> None:
    """Above the axes, where it covers nothing; faint lines are shown in full colour."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    look = {"frameon": False, "fontsize": 9.5, "columnspacing": 1.6, "handlelength": 1.6, "borderaxespad": 0.0}
    legend = axes.legend(handles, labels, loc=f"lower {side}", bbox_to_anchor=(at, 1.01), ncols=len(handles), **look)
    for line in legend.get_lines():
        line.set_alpha(1.0)
        line.set_linewidth(max(1.2, line.get_linewidth()))


def _save(figure: Any, out_png: Path) -> None:
    if Path(out_png).suffix != ".png":
        raise GraphSlamError(f"{out_png}: a picture is a .png file")
    try:
        figure.savefig(out_png, metadata={"Software": "graph_slam_ros"})
    except OSError as error:
        raise GraphSlamError(f"{out_png}: {error.strerror or error}") from None
