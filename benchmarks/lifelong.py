"""A map whose size follows its area: a robot drives in one hall, with all keyframes kept and with visits condensed.

``python -m benchmarks.lifelong``. A hall of 60 by 40 m, aisles driven at random, a keyframe each 0.5 m, 40 landmarks
that are seen within 8 m, every second one. ``GraphSlam`` gets the measurements as from a robot; each drive has a
process of its own. What is printed of a drive:

* sizes of the graph at the end, and resident memory after a tenth of the drive and at the end;
* errors: of the newest pose (in the frame of the landmarks), of the whole path (keyframes that left the map included)
  and of the landmarks; NEES of one degree of freedom of the newest pose and of the landmarks: 1 is right, more is too
  sure;
* CPU time: of all updates by a keyframe's measurements in the second half (median, p99, worst), and for each keyframe.
"""

import argparse
import os
import pickle
import sys
import tempfile
import time
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import fresh, lifelong, table
from benchmarks.hall import STEP_S, Course, config, fitted, measured, rms
from graph_slam_ros.cli import values
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.runs.whole_path import removed_path
from graph_slam_ros.slam import Control, GraphSlam
from graph_slam_ros.slam.lifelong.removed import Left
from graph_slam_ros.typing import Array, Numbers

_FLAT = 1.05  # of the memory after a tenth of a drive: more is not flat
_WARM, _LOOK = 640, 40  # keyframes: before errors of the newest pose are taken, and from one to the next


class Drive:
    """A pipeline on a drive, and what is measured of it on the way.

    Parameters
    ----------
    window : keyframes that stay as they were measured; 0: all of them
    """

    def __init__(self, course: Course, window: int, **settings: Any) -> None:
        if window:
            settings |= {"map_condense": True, "map_window_keyframes": window}
        self.course, self.slam = course, GraphSlam(config(course.space, **settings))
        self.update_s = array("d", bytes(8 * (len(course.where) - 1)))
        self.looks, self.memory_mib = list[tuple[float, float, float]](), [0.0, 0.0]
        self.path = np.empty((0, course.space.dimensions))  # estimated positions of all keyframes, at the end

    def run(self) -> None:
        """Drive to the end."""
        with tempfile.TemporaryFile() as left:  # what leaves the map is not in memory, as in a run
            self._run(left)
            left.seek(0)
            parts = list[Left]()
            while left.peek(1):
                parts.append(pickle.load(left))
        before = removed_path(self.slam, Left.joined(self.course.space, parts))
        whole = np.concatenate((before, self.slam.trajectory()))
        self.path = whole[:, : self.course.space.dimensions]

    def _run(self, left: IO[bytes]) -> None:
        count, space, at = len(self.course.where) - 1, self.course.space, self.course.space.identity
        tenth = max(count // 10, 1)
        for k, (_, step, seen) in enumerate(self.course.keyframes()):
            at = space.normalized(space.group.compose(at, step)) if step else at
            given = list(measured(tuple(map(float, at)), round((k + 5) * STEP_S * 1e9), seen))
            began = time.thread_time()
            updates = [self.slam.process(m) for m in given]
            self.update_s[k] = time.thread_time() - began
            for one in (update.condensed for update in updates if update.condensed is not None):
                pickle.dump(one.left, left)
            if k >= _WARM and k % _LOOK == 0:
                self.looks.append(self._newest())
            if (k + 1) in (tenth, count):
                self.memory_mib[(k + 1) == count] = _resident_mib()
        self.slam.process(Control("end"))

    def landmarks(self) -> tuple[list[int], Array, Array]:
        """Vertices of the landmarks, estimated and true positions, or poses."""
        marks, course = self.slam.landmarks, self.course
        vertices, numbers = [mark.vertex for mark in marks.values()], [int(name[1:]) for name in marks]
        whole = course.points[numbers]
        if course.turns:
            whole = np.concatenate((whole, np.array(course.turns)[numbers]), axis=1)
        true = np.stack(self._in_map("compose" if course.turns else "act", tuple(whole.T)), axis=-1)
        return vertices, self.slam.solver.estimate(vertices), true

    def figures(self) -> dict[str, float]:
        """What was measured."""
        error, nees, of_marks = np.array(self.looks).T
        true = np.zeros((len(self.update_s), self.course.space.dimensions))
        true[:, :2] = self.course.where[: len(true)]
        late_ms, slam = 1e3 * np.array(self.update_s[len(self.update_s) // 2 :]), self.slam
        there, right = (one[:, : true.shape[1]] for one in self.landmarks()[1:])
        return {
            "vertices": len(slam.solver.vertices),
            "edges": len(slam.solver.edges),
            "early MiB": self.memory_mib[0],
            "late MiB": self.memory_mib[1],
            "newest m": float(np.sqrt((error**2).mean())),
            "path m": rms(self.path, true),
            "landmarks m": rms(there, right),
            "NEES newest": float(nees.mean()),
            "NEES landmarks": float(of_marks.mean()),
            "median ms": float(np.median(late_ms)),
            "p99 ms": float(np.quantile(late_ms, 0.99)),
            "worst ms": float(late_ms.max()),
            "CPU ms": 1e3 * sum(self.update_s) / len(self.update_s),
        }

    def _in_map(self, name: str, of: Numbers) -> Numbers:
        """Return poses (``compose``) or points (``act``) of the hall in the map, which begins at the first pose."""
        group = self.course.space.group
        out: Numbers = getattr(group, name)(group.inverse(self.course.pose(0)), of)
        return out

    def _newest(self) -> tuple[float, float, float]:
        """Return the error of the newest pose [m], its NEES, and that of the landmarks."""
        slam, space, n = self.slam, self.course.space, self.course.space.dimensions
        newest, (vertices, there, right) = slam.keyframes[-1].vertex, self.landmarks()
        (pose,) = slam.solver.estimate([newest])
        true = self._in_map("compose", self.course.pose(len(slam.keyframes) - 1))
        turn, shift = fitted(there[:, :n], right[:, :n])
        error = float(np.linalg.norm(turn @ pose[:n] + shift - np.array(true[:n])))
        (covariance,) = slam.solver.marginal([newest])
        off = np.array(space.group.log(space.group.between(tuple(pose), true)))
        of_marks = slam.graph.kind_of(vertices[0]).local(there, right).ravel()
        joint = slam.solver.joint_marginal(vertices)
        nees = float(off @ np.linalg.solve(covariance, off)) / len(off)
        return error, nees, float(of_marks @ np.linalg.solve(joint, of_marks)) / len(of_marks)


def _resident_mib() -> float:
    """Return the resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def drive(seed: int, keyframes: int, window: int, dimensions: int = 2, tags: bool = False) -> dict[str, float]:
    """Return the figures of one drive."""
    Drive(Course(seed, 60), 0).run()  # what is loaded or compiled at first use is not counted
    one = Drive(Course(seed, keyframes, PLANAR if dimensions == 2 else SPATIAL, tags=tags), window)
    one.run()
    return one.figures()


_AGAINST = ("newest m", "path m", "landmarks m", "NEES newest", "NEES landmarks")


def measure(
    keyframes: int, seeds: Sequence[int], windows: Sequence[int], dimensions: int, *, tags: bool
) -> Iterator[table.Row]:
    """Yield a row for each drive, and one for each window: the means, and errors over those of all keyframes."""
    found: dict[int, list[dict[str, float]]] = {window: [] for window in windows}
    for seed in seeds:
        for window in windows:
            row = fresh.call(lifelong.drive, seed, keyframes, window, dimensions, tags)
            found[window].append(row)
            yield {"seed": seed, "window": window or "all", **row}
    for window, rows in found.items():
        mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
        yield {"seed": "mean", "window": window or "all", **mean}
        if window and 0 in found:
            pairs = list(zip(rows, found[0], strict=True))
            ratios = {name: float(np.mean([a[name] / b[name] for a, b in pairs])) for name in _AGAINST[:3]}
            yield {"seed": "over all", "window": window, **ratios}


def main() -> None:
    """The programme."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--keyframes", type=values.count, default=10_000, metavar="N")
    options.add_argument("--seeds", type=values.count, default=2, metavar="N", help="drives 0 to N - 1")
    options.add_argument("--windows", type=int, nargs="+", default=[0, 60, 2000], help="keyframes; 0 keeps all")
    options.add_argument("--dimensions", type=int, choices=(2, 3), default=2)
    options.add_argument("--tags", action="store_true", help="the orientation of landmarks is seen, too")
    options.add_argument("--flat", action="store_true", help="fail where memory grows after a tenth of the drive")
    options.add_argument("--json", type=Path, metavar="OUT", help="write the results there as well")
    args = options.parse_args()
    rows = []
    for row in measure(args.keyframes, range(args.seeds), args.windows, args.dimensions, tags=args.tags):
        print(
            "benchmarks:",
            *(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()),
            file=sys.stderr,
            flush=True,
        )
        rows.append(row)
    table.finish(
        table.results("lifelong", rows, f"{args.keyframes} keyframes, {args.dimensions} dimensions"), args.json
    )
    if args.flat and any(row["late MiB"] > _FLAT * row["early MiB"] for row in rows if "late MiB" in row):
        sys.exit("benchmarks: memory grows with the distance driven")


if __name__ == "__main__":
    main()
