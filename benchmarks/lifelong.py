"""A map whose size follows its area: a robot drives in one hall, with all keyframes kept and with visits condensed.

``python -m benchmarks.lifelong``: the hall of ``benchmarks.hall``, in the plane, with points that have ids.
``GraphSlam`` gets the measurements as from a robot; each drive has a process of its own. What is printed of a drive:

* sizes of the graph at the end, and resident memory after a tenth of the drive and at the end;
* errors: of the newest pose (in the frame of the landmarks), of the whole path (keyframes that left the map included)
  and of the landmarks; NEES of one degree of freedom of the newest pose, and of the landmarks among each other: 1 is
  right, more is too sure;
* CPU time: of all updates by a keyframe's measurements in the second half (median, p99, worst), and for each keyframe.
"""

import argparse
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from benchmarks import fresh, lifelong, options, table
from benchmarks.hall import STEP_S, Course, config, measured
from benchmarks.judge import rms
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.lie import se2
from graph_slam_ros.runs.condensed_map import WholePath
from graph_slam_ros.slam import Control, GraphSlam
from graph_slam_ros.slam.landmarks.rotations import aligned
from graph_slam_ros.slam.lifelong.state import Left
from graph_slam_ros.typing import Array
from graph_slam_ros.warmup import warmup

_FLAT = 1.05  # of the memory after a tenth of a drive: more is not flat
_WARM, _LOOK = 640, 40  # keyframes: before errors of the newest pose are taken, and from one to the next
_AGAINST = ("newest m", "path m", "landmarks m")


class Drive:
    """A pipeline on a drive, and what is measured of it on the way.

    Parameters
    ----------
    window : keyframes that stay as they were measured; 0: all of them
    """

    def __init__(self, course: Course, window: int) -> None:
        bounds = {"map_condense": True, "map_window_keyframes": window} if window else {"map_condense": False}
        self.course, self.slam = course, GraphSlam(config(PLANAR, **bounds))
        self.update_s = np.zeros(len(course.where) - 1)
        self.looks, self.memory_mib = list[tuple[float, ...]](), list[float]()

    def figures(self) -> dict[str, float]:
        """Drive to the end; returns what was measured."""
        with tempfile.TemporaryFile() as left:  # what leaves the map is not in memory, as in a run
            self._run(left)
            left.seek(0)
            parts = list[Left]()
            while left.peek(1):
                parts.append(pickle.load(left))
        view, late_ms = self.slam.view, 1e3 * self.update_s[len(self.update_s) // 2 :]
        path = WholePath(view, Left.joined(view.space, parts)).poses()
        error, nees, of_marks = np.array(self.looks).T if self.looks else np.full((3, 1), np.nan)
        return {
            "vertices": len(view.solver.vertices),
            "early MiB": self.memory_mib[0],
            "late MiB": self.memory_mib[1],
            "newest m": float(np.sqrt((error**2).mean())),
            "path m": rms(path[:, :2], self.course.where[: len(path)]),
            "landmarks m": rms(*self._landmarks()[1:]),
            "NEES newest": float(nees.mean()),
            "NEES landmarks": float(of_marks.mean()),
            "median ms": float(np.median(late_ms)),
            "p99 ms": float(np.quantile(late_ms, 0.99)),
            "worst ms": float(late_ms.max()),
            "CPU ms": 1e3 * float(self.update_s.mean()),
        }

    def _run(self, left: IO[bytes]) -> None:
        count, at = len(self.update_s), se2.IDENTITY
        for k, (_, step, seen) in enumerate(self.course.keyframes()):
            at = PLANAR.normalized(se2.compose(at, step)) if step else at
            given = list(measured(tuple(map(float, at)), round((k + 5) * STEP_S * 1e9), seen))
            began_s = time.thread_time()
            updates = [self.slam.process(m) for m in given]
            self.update_s[k] = time.thread_time() - began_s
            for one in (update.condensed for update in updates if update.condensed is not None):
                pickle.dump(one.left, left)
            if k >= _WARM and k % _LOOK == 0:
                self.looks.append(self._newest())
            if (k + 1) in (max(count // 10, 1), count):
                self.memory_mib.append(_resident_mib())
        self.slam.process(Control("end"))

    def _landmarks(self) -> tuple[list[int], Array, Array]:
        """Vertices of the landmarks that are in the problem, estimated and true positions in the map."""
        view = self.slam.view
        known = set(view.solver.vertices.tolist())
        marks = {name: mark.vertex for name, mark in view.landmarks.items() if mark.vertex in known}
        true = se2.act(se2.inverse(self.course.pose(0)), tuple(self.course.points[[int(name[1:]) for name in marks]].T))
        return list(marks.values()), view.solver.estimate(list(marks.values())), np.stack(true, axis=-1)

    def _newest(self) -> tuple[float, float, float]:
        """The error of the newest pose [m], its NEES, and that of the landmarks."""
        view, (vertices, there, right) = self.slam.view, self._landmarks()
        newest, (turn, shift) = view.keyframes[-1].vertex, aligned(there, right)
        (pose,) = view.solver.estimate([newest])
        true = se2.between(self.course.pose(0), self.course.pose(len(view.keyframes) - 1))
        error = float(np.linalg.norm(turn @ pose[:2] + shift - np.array(true[:2])))
        (covariance,) = view.solver.marginal([newest])
        off = np.array(se2.log(se2.between(tuple(pose), true)))
        nees = float(off @ np.linalg.solve(covariance, off)) / len(off)
        return error, nees, self._shape_nees(vertices, there, right)

    def _shape_nees(self, vertices: list[int], there: Array, right: Array) -> float:
        """NEES of the landmarks among each other: a turn of the whole map by 0.05 rad moves them by metres."""
        turn, shift = aligned(right, there)
        off = (right @ turn.T + shift - there).ravel()
        x, y = there.T
        moves = np.stack([[np.ones_like(x), 0.0 * x, -y], [0.0 * x, np.ones_like(y), x]])  # of the whole map
        gauge = moves.transpose(2, 0, 1).reshape(-1, 3)
        solved = np.linalg.solve(self.slam.view.solver.joint_marginal(vertices), np.c_[off, gauge])
        off_, gauge_ = solved[:, 0], solved[:, 1:]
        pull = gauge.T @ off_
        chi2 = off @ off_ - pull @ np.linalg.solve(gauge.T @ gauge_, pull)
        return float(chi2) / (len(off) - len(pull))


def _resident_mib() -> float:
    """The resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def drive(seed: int, keyframes: int, window: int) -> dict[str, float]:
    """The figures of one drive."""
    warmup(dimensions=2)  # as the node does
    Drive(Course(seed, 60), 0).figures()  # what is loaded at first use is not counted
    return Drive(Course(seed, keyframes), window).figures()


def measure(keyframes: int, seeds: Sequence[int], windows: Sequence[int]) -> Iterator[table.Row]:
    """A row for each window: the means over some drives. What errors are of those with all keyframes is said."""
    of_all: list[dict[str, float]] = []
    for window in windows:
        rows = [fresh.call(lifelong.drive, seed, keyframes, window) for seed in seeds]
        of_all = of_all if window else rows
        for name in _AGAINST if of_all else ():
            ratio = float(np.mean([a[name] / b[name] for a, b in zip(rows, of_all, strict=True)]))
            options.say(f"window {window or 'all'}: {name} of those with all keyframes: {ratio:.3f}")
        means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
        yield {"keyframes": keyframes, "window": window or "all", **means}


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=values.count, default=10_000, metavar="N")
    parser.add_argument("--seeds", type=values.count, default=2, metavar="N", help="drives 0 to N - 1")
    parser.add_argument("--windows", type=int, nargs="+", default=[0, 60, 2000], help="keyframes; 0 keeps all")
    parser.add_argument("--flat", action="store_true", help="fail where memory grows after a tenth of the drive")
    table.add_write(parser)
    args = parser.parse_args()
    rows = list(measure(args.keyframes, range(args.seeds), args.windows))
    table.finish("lifelong", rows, write=args.write, note="" if args.seeds == 1 else f"{args.seeds} drives", keys=2)
    if args.flat and any(row["late MiB"] > _FLAT * row["early MiB"] for row in rows):
        sys.exit("benchmarks: memory grows with the distance driven")


if __name__ == "__main__":
    main()
