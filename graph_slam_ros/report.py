"""Pictures of runs and of graphs, drawn into PNG files without a display."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros import evaluation
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.evaluation import Trajectory
from graph_slam_ros.lie import se2

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TRUTH, _ODOMETRY, _ESTIMATE, _LANDMARK = "#1f6fd6", "#1a1a1a", "#d62728", "#e08a00"
_CLOSURE, _SIGHTING, _QUIET = "#d62728", "#e08a00", "#9aa0a6"
_INCHES, _DPI = 8.0, 150
_GAP_S, _LONG_STEPS = 1.0, 5.0  # truth was not recorded where stamps are farther apart and this many times the usual


def draw_run(run: Path, truth: str | Path | None, out_png: Path) -> None:
    """Draw a run: dead reckoning black, estimate red, landmarks as stars; truth blue, true landmarks as circles.

    With truth, everything is in its frame, each path moved onto it as for the scores (landmarks with the estimate);
    without, in the frame map.

    Parameters
    ----------
    run : folder with ``path.tum`` and, where there are any, ``sightings.tum``, ``odometry.tum`` and ``landmarks.csv``
    truth : ``BAG``, ``BAG:TOPIC``, ``FILE.tum`` or None

    Raises
    ------
    GraphSlamError
        A file that is missing or unreadable, or no evo to align with.
    """
    path = evaluation.read_tum(run / "path.tum")
    odometry = evaluation.read_tum(run / "odometry.tum") if (run / "odometry.tum").exists() else None
    landmarks = evaluation.read_landmarks(run / "landmarks.csv")
    figure, axes = _figure()
    true_landmarks: dict[str, tuple[float, float]] = {}
    T_world_map = se2.IDENTITY
    if truth is not None:
        known = evaluation.read_truth(truth)
        true_landmarks = known.landmarks
        scored = run / "sightings.tum"
        has_sightings = scored.exists() and scored.stat().st_size > 0
        T_world_map = _onto(evaluation.read_tum(scored) if has_sightings else path, known.trajectory)
        if odometry is not None:
            odometry = odometry.moved(_onto(odometry, known.trajectory))
        _draw_path(axes, _with_gaps(_within(known.trajectory, path)), "truth", _TRUTH, 2.4, 2)
    if odometry is not None:
        _draw_path(axes, odometry, "dead reckoning", _ODOMETRY, 1.0, 3)
    _draw_path(axes, path.moved(T_world_map), "estimate", _ESTIMATE, 1.3, 4)
    if landmarks:
        x, y = se2.act(T_world_map, tuple(np.array(list(landmarks.values())).T))
        axes.scatter(
            x, y, s=70, marker="*", color=_LANDMARK, edgecolors="white", linewidths=0.4, zorder=6, label="landmarks"
        )
    shown = np.array([at for name, at in true_landmarks.items() if name in landmarks]).reshape(-1, 2)
    if len(shown):
        axes.scatter(
            *shown.T, s=90, facecolors="none", edgecolors=_TRUTH, linewidths=1.0, zorder=5, label="true landmarks"
        )
    start_x, start_y = path.moved(T_world_map).poses[0, :2]
    axes.plot(start_x, start_y, "o", color=_ESTIMATE, markeredgecolor="white", markersize=7, zorder=7, label="start")
    _legend(axes, at=0.5, side="center")
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
            x, y = values[is_point, 0], values[is_point, 1]
            axes.scatter(
                x, y, s=60, marker="*", color=_LANDMARK, edgecolors="white", linewidths=0.4, zorder=6, label="landmarks"
            )
        elif not edges:
            axes.plot(values[:, 0], values[:, 1], ".", color=_ODOMETRY, markersize=2)
        axes.autoscale_view()
    _legend(pair[1], at=1.0, side="right")
    _save(figure, out_png)


def _onto(path: Trajectory, truth: Trajectory) -> se2.Pose:
    mine, theirs = evaluation.associate(path, truth)
    return evaluation.alignment(mine.poses[:, :2], theirs.poses[:, :2])


def _within(truth: Trajectory, path: Trajectory) -> Trajectory:
    """The truth during the run: what came before and after would only shrink the picture."""
    at = (truth.stamps_s >= path.stamps_s[0] - 1.0) & (truth.stamps_s <= path.stamps_s[-1] + 1.0)
    return Trajectory(truth.stamps_s[at], truth.poses[at])


def _draw_path(axes: Any, path: Trajectory, label: str, color: str, width: float, order: int) -> None:
    axes.plot(*path.poses[:, :2].T, color=color, linewidth=width, label=label, zorder=order, solid_joinstyle="round")


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
