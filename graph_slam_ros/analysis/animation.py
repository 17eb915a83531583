"""A drive and its correction as an animation: how the path looked at each moment, next to dead reckoning."""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.analysis.evaluation import input_topics, truth_in_map
from graph_slam_ros.analysis.plots import canvas, dress
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.colours import LIGHT
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.folder import recording_of, run_config
from graph_slam_ros.runs.journal import read_measurements
from graph_slam_ros.runs.map_file import read_start
from graph_slam_ros.runs.trajectory import Trajectory, read_rows
from graph_slam_ros.slam import GraphSlam, MapView
from graph_slam_ros.typing import Array

_FRAME_MS, _LAST_MS = 80, 2000
_INCHES, _DPI = 6.0, 80
_COLOURS = 64


@dataclass(frozen=True, slots=True)
class _Moment:
    """Positions (n, 3) in the map, as they were estimated at the newest keyframe's stamp."""

    stamp_s: float
    path: Array
    odometry: Array
    landmarks: Array


def animate_run(
    run: Path, out_gif: Path, frames: int = 80, truth: str | None = None, topic: str = "", *, align: bool = True
) -> list[str]:
    """Repeat a run's drive and draw the estimate of each moment into a GIF, from above.

    Returns what of the drive could not be read, a line each.

    Raises GraphSlamError: a file that is missing or unreadable; OSError: it cannot be written.

    Dead reckoning is black and begins where the estimate does; the estimate is red; truth is blue, laid on the whole
    path. A loop closure is seen as the moment at which the red path moves. The last frame is the solved graph.

    Parameters
    ----------
    run : folder of a run, with its ``ingest.mcap``
    frames : at equal steps of time
    truth, topic, align : as ``plots.draw_run`` takes them
    """
    if out_gif.suffix != ".gif":
        raise GraphSlamError(f"{out_gif}: an animation is a .gif file")
    known, losses = None, list[str]()
    if truth:
        known = truth_in_map(run, read_truth(truth, topic, input_topics(run)), align=align)
    moments = list(_moments(run, frames, losses))
    if not moments:
        raise GraphSlamError(f"{run}: nothing of the drive can be repeated: it has no ingest.mcap, or an empty one")
    drawn = io.BytesIO()
    images = list(_drawn(moments, recording_of(run), known))
    durations = [_FRAME_MS] * (len(images) - 1) + [_LAST_MS]
    images[0].save(
        drawn, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True
    )
    write_whole(out_gif, drawn.getvalue())
    return losses


def _moments(run: Path, frames: int, losses: list[str]) -> Iterator[_Moment]:
    """The estimate after equal times, and at the end. Time goes on from keyframe to keyframe, also of a set clock."""
    config = run_config(run).changed({"map.condense": False})  # all of the path is drawn
    start = read_start(run)
    stamps_s = read_rows(run / "path.tum").stamps_s[max(len(start.keyframes) - 1, 0) if start else 0 :]
    step_s = float(np.maximum(np.diff(stamps_s), 0.0).sum()) / max(frames - 1, 1)
    slam = GraphSlam(config, start=start)
    view = slam.view
    last_ns, passed_s, due_s = view.keyframes[-1].stamp_ns if view.keyframes else 0, 0.0, step_s
    for measurement in read_measurements(run, losses):
        slam.process(measurement)
        if not view.keyframes or view.keyframes[-1].stamp_ns == last_ns:
            continue
        now_ns = view.keyframes[-1].stamp_ns
        passed_s += max(1e-9 * (now_ns - last_ns), 0.0) if last_ns else 0.0
        last_ns = now_ns
        if passed_s >= due_s and len(view.keyframes) > 1:
            due_s = (passed_s // step_s + 1.0) * step_s if step_s else 0.0
            yield _now(view)
    if len(view.keyframes) > 1:
        yield _now(view)


def _now(view: MapView) -> _Moment:
    poses = se3.in_space(view.trajectory())
    odometry = se3.in_space(np.array([keyframe.T_odom_base for keyframe in view.keyframes]))
    T_map_odom = se3.compose(tuple(poses[0]), se3.inverse(tuple(odometry[0])))
    moved = np.stack(se3.compose(T_map_odom, tuple(odometry.T))[:3], axis=-1)
    points = [view.solver.estimate([mark.vertex])[0] for mark in view.landmarks.values()]
    in_space = [[*point[:2], point[2] if view.space.dimensions == 3 else 0.0] for point in points]
    stamp_s = 1e-9 * view.keyframes[-1].stamp_ns
    return _Moment(stamp_s, poses[:, :3], moved, np.array(in_space).reshape(-1, 3))


def _drawn(moments: list[_Moment], title: str, truth: Trajectory | None) -> Iterator[Any]:
    """Pillow images, one for each moment, all with the same limits."""
    from PIL import Image

    figure = canvas((_INCHES, _INCHES), _DPI)
    axes = figure.subplots()
    dress(axes)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=title)
    last = moments[-1]
    true = np.zeros((0, 3)) if truth is None else truth.poses[:, :3]
    everything = np.vstack([last.path, last.odometry, last.landmarks, true])
    low, high = everything[:, :2].min(axis=0), everything[:, :2].max(axis=0)
    room = 0.05 * float((high - low).max()) + 0.1
    axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room))
    (known,) = axes.plot([], [], color=LIGHT["truth"], linewidth=2.4, label="truth" if truth else None)
    (odometry,) = axes.plot([], [], "--", color=LIGHT["odometry"], linewidth=1.0, label="dead reckoning")
    (path,) = axes.plot([], [], color=LIGHT["estimate"], linewidth=1.6, label="estimate")
    (landmarks,) = axes.plot([], [], "*", color=LIGHT["landmarks"], label="landmarks")
    (robot,) = axes.plot([], [], "o", color=LIGHT["estimate"])
    axes.legend(loc="upper right", fontsize=8, framealpha=0.8)
    newest_s = -np.inf
    for moment in moments:
        newest_s = max(newest_s, moment.stamp_s)  # a clock that is set back takes nothing of the truth back
        so_far = 0 if truth is None else int(np.searchsorted(truth.stamps_s, newest_s, side="right"))
        shown = true[:so_far], moment.odometry, moment.path, moment.landmarks, moment.path[-1:]
        for line, points in zip((known, odometry, path, landmarks, robot), shown, strict=True):
            line.set_data(points[:, 0], points[:, 1])
        figure.canvas.draw()
        image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
        yield image.quantize(_COLOURS, dither=Image.Dither.NONE)
