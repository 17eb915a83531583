"""A map whose size follows its area: a robot drives in one hall, with all keyframes kept and with visits condensed.

``python -m benchmarks.lifelong``. A hall of 60 by 40 m, aisles driven at random, a keyframe each 0.5 m, 40 landmarks
that are seen within 8 m, every second one. ``GraphSlam`` gets the measurements as from a robot; each drive has a
process of its own. What is printed of a drive:

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
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from scipy.spatial import KDTree

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import fresh, lifelong, table
from benchmarks.hall import STEP_S, Course, config, fitted, measured, rms, without_ids
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.runs.condensed_map import WholePath
from graph_slam_ros.slam import Control, GraphSlam, Measurement, Sightings
from graph_slam_ros.slam.lifelong.state import Left
from graph_slam_ros.typing import Array, Numbers
from graph_slam_ros.warmup import warmup

Figures = dict[str, float]
_WRONG_M = 1.0  # farther than that from its place a landmark without id is wrong
_FLAT = 1.05  # of the memory after a tenth of a drive: more is not flat
_PROBE = 1e-6  # of a derivative [m, rad]
_WARM, _LOOK = 640, 40  # keyframes: before errors of the newest pose are taken, and from one to the next


class Drive:
    """A pipeline on a drive, and what is measured of it on the way.

    Parameters
    ----------
    window : keyframes that stay as they were measured; 0: all of them
    """

    def __init__(self, course: Course, window: int) -> None:
        self.course, self.slam = course, GraphSlam(config(course.space, **_settings(window)))
        self._begin(len(course.where) - 1)

    def _begin(self, keyframes: int) -> None:
        self.update_s = array("d", bytes(8 * keyframes))
        self.looks, self.memory_mib = list[tuple[float, ...]](), [0.0, 0.0]
        self.path = np.empty((0, self.slam.view.space.dimensions))  # estimated positions of all keyframes, at the end

    def run(self) -> None:
        """Drive to the end."""
        with tempfile.TemporaryFile() as left:  # what leaves the map is not in memory, as in a run
            self._run(left)
            left.seek(0)
            parts = list[Left]()
            while left.peek(1):
                parts.append(pickle.load(left))
        whole = WholePath(self.slam.view, Left.joined(self.slam.view.space, parts)).poses()
        self.path = whole[:, : self.slam.view.space.dimensions]

    def _run(self, left: IO[bytes]) -> None:
        count = len(self.update_s)
        tenth = max(count // 10, 1)
        for k, given in enumerate(self.measurements()):
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

    def measurements(self) -> Iterator[list[Measurement]]:
        """Return what the robot measures at each keyframe; once."""
        space, at = self.course.space, self.course.space.identity
        for k, (_, step, seen) in enumerate(self.course.keyframes()):
            at = space.normalized(space.group.compose(at, step)) if step else at
            yield list(measured(tuple(map(float, at)), round((k + 5) * STEP_S * 1e9), seen))

    def landmarks(self) -> tuple[list[int], Array, Array]:
        """Vertices of the landmarks that are in the problem, estimated and true positions, or poses."""
        known, course = set(self.slam.view.solver.vertices.tolist()), self.course
        marks = {name: mark for name, mark in self.slam.view.landmarks.items() if mark.vertex in known}
        vertices, numbers = [mark.vertex for mark in marks.values()], [int(name[1:]) for name in marks]
        whole = course.points[numbers]
        if course.turns:
            whole = np.concatenate((whole, np.array(course.turns)[numbers]), axis=1)
        true = np.stack(self._in_map("compose" if course.turns else "act", tuple(whole.T)), axis=-1)
        return vertices, self.slam.view.solver.estimate(vertices), true

    def figures(self) -> dict[str, float]:
        """What was measured."""
        error, nees, of_marks = np.array(self.looks).T
        there, right = (one[:, : self.slam.view.space.dimensions] for one in self.landmarks()[1:])
        return {
            **self._sizes(),
            "newest m": float(np.sqrt((error**2).mean())),
            "path m": rms(self.path, self._true()),
            "landmarks m": rms(there, right),
            "NEES newest": float(nees.mean()),
            "NEES landmarks": float(of_marks.mean()),
            **self._times(),
        }

    def _true(self) -> Array:
        """True positions of the keyframes."""
        out = np.zeros((len(self.update_s), self.slam.view.space.dimensions))
        out[:, :2] = self.course.where[: len(out)]
        return out

    def _sizes(self) -> dict[str, float]:
        return {
            "vertices": len(self.slam.view.solver.vertices),
            "edges": len(self.slam.view.solver.edges),
            "early MiB": self.memory_mib[0],
            "late MiB": self.memory_mib[1],
        }

    def _times(self) -> dict[str, float]:
        late_ms = 1e3 * np.array(self.update_s[len(self.update_s) // 2 :])
        return {
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

    def _newest(self) -> tuple[float, ...]:
        """Return the error of the newest pose [m], its NEES, and that of the landmarks."""
        view, space, n = self.slam.view, self.course.space, self.course.space.dimensions
        newest, (vertices, there, right) = view.keyframes[-1].vertex, self.landmarks()
        (pose,) = view.solver.estimate([newest])
        true = self._in_map("compose", self.course.pose(len(view.keyframes) - 1))
        turn, shift = fitted(there[:, :n], right[:, :n])
        error = float(np.linalg.norm(turn @ pose[:n] + shift - np.array(true[:n])))
        (covariance,) = view.solver.marginal([newest])
        off = np.array(space.group.log(space.group.between(tuple(pose), true)))
        nees = float(off @ np.linalg.solve(covariance, off)) / len(off)
        return error, nees, self._shape_nees(vertices, there, right, (turn, shift))

    def _shape_nees(self, vertices: list[int], there: Array, right: Array, laid: tuple[Array, Array]) -> float:
        """NEES of the landmarks among each other: a turn of the whole map by 0.05 rad moves them by metres.

        Parameters
        ----------
        laid : rotation and shift by which they lie on the true ones
        """
        group, view = self.course.space.group, self.slam.view
        kind, act = view.graph.kind_of(vertices[0]), group.compose if self.course.turns else group.act
        onto = np.eye(len(laid[1]) + 1)
        onto[:-1, :-1], onto[:-1, -1] = laid
        whole = np.eye(self.course.space.dof) * _PROBE
        moves = [np.stack(act(group.exp(tuple(one)), tuple(there.T)), axis=-1) for one in whole]
        gauge = np.stack([kind.local(there, one).ravel() / _PROBE for one in moves], axis=-1)
        off = kind.local(there, np.stack(act(group.inverse(group.from_matrix(onto)), tuple(right.T)), axis=-1)).ravel()
        off_, gauge_ = np.split(np.linalg.solve(view.solver.joint_marginal(vertices), np.c_[off, gauge]), [1], 1)
        pull = gauge.T @ off_[:, 0]
        chi2 = off @ off_[:, 0] - pull @ np.linalg.solve(gauge.T @ gauge_, pull)
        return float(chi2) / (len(off) - len(pull))


class UnnamedDrive(Drive):
    """The same with sightings that do not tell which landmark they are of."""

    def __init__(self, course: Course, window: int) -> None:
        super().__init__(course, window)
        values = {"landmarks_association": "joint", **_settings(window)}
        self.slam = GraphSlam(config(course.space, **values))

    def measurements(self) -> Iterator[list[Measurement]]:
        """Return what the robot measures at each keyframe; once."""
        for given in super().measurements():
            yield [without_ids(m) if isinstance(m, Sightings) else m for m in given]

    def landmarks(self) -> tuple[list[int], Array, Array]:
        """Vertices of the confirmed landmarks, estimated positions, and the true ones that these are of."""
        vertices = [mark.vertex for mark in self.slam.view.landmarks.values() if not mark.is_tentative]
        there = self.slam.view.solver.estimate(vertices)
        places = np.stack(self._in_map("act", tuple(self.course.points.T)), axis=-1)
        return vertices, there, places[self._nearest(there, places)]

    def figures(self) -> Figures:
        """What was measured, and how many landmarks are not where one is, or where another is already."""
        _, there, right = self.landmarks()
        turn, shift = fitted(there, right)
        is_near = np.linalg.norm(there @ turn.T + shift - right, axis=1) < _WRONG_M
        found = len(np.unique(right[is_near], axis=0))
        return super().figures() | {"landmarks": float(found), "wrong": float(len(there) - found)}

    def _nearest(self, there: Array, places: Array) -> Array:
        """Return which place is nearest to each landmark, after they were laid on those that are nearest at first."""
        turn, shift = fitted(there, places[KDTree(places).query(there)[1]])
        return np.asarray(KDTree(places).query(there @ turn.T + shift)[1])


def _settings(window: int) -> dict[str, Any]:
    return {"map_condense": True, "map_window_keyframes": window} if window else {"map_condense": False}


def _resident_mib() -> float:
    """Return the resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def drive(seed: int, keyframes: int, window: int, dimensions: int = 2, world: str = "points") -> Figures:
    """Return the figures of one drive in a hall with a kind of landmarks."""
    warmup(dimensions=dimensions)  # as the node does
    Drive(Course(seed, 60), 0).run()  # what is loaded at first use is not counted
    space = PLANAR if dimensions == 2 else SPATIAL
    kind = UnnamedDrive if world == "unnamed" else Drive
    one = kind(Course(seed, keyframes, space, tags=world == "tags"), window)
    one.run()
    return one.figures()


_AGAINST = ("newest m", "path m", "landmarks m")


def measure(
    keyframes: int, seeds: Sequence[int], windows: Sequence[int], dimensions: int, *, world: str
) -> Iterator[table.Row]:
    """Yield a row for each drive, and one for each window: the means, and errors over those of all keyframes."""
    found: dict[int, list[Figures]] = {window: [] for window in windows}
    for seed in seeds:
        for window in windows:
            row = fresh.call(lifelong.drive, seed, keyframes, window, dimensions, world)
            found[window].append(row)
            yield {"seed": seed, "window": window or "all", **row}
    for window, rows in found.items():
        mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
        yield {"seed": "mean", "window": window or "all", **mean}
        if window and 0 in found:
            pairs = list(zip(rows, found[0], strict=True))
            ratios = {name: float(np.mean([a[name] / b[name] for a, b in pairs])) for name in _AGAINST if name in mean}
            yield {"seed": "over all", "window": window, **ratios}


def main() -> None:
    """The programme."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--keyframes", type=values.count, default=10_000, metavar="N")
    options.add_argument("--seeds", type=values.count, default=2, metavar="N", help="drives 0 to N - 1")
    options.add_argument("--windows", type=int, nargs="+", default=[0, 60, 2000], help="keyframes; 0 keeps all")
    options.add_argument("--dimensions", type=int, choices=(2, 3), default=2)
    options.add_argument(
        "--landmarks",
        choices=("points", "tags", "unnamed"),
        default="points",
        help="points with ids, tags whose orientation is seen, too, or points without ids",
    )
    options.add_argument("--flat", action="store_true", help="fail where memory grows after a tenth of the drive")
    options.add_argument("--json", type=Path, metavar="OUT", help="write the results there as well")
    args = options.parse_args()
    rows = []
    for row in measure(args.keyframes, range(args.seeds), args.windows, args.dimensions, world=args.landmarks):
        print(
            "benchmarks:",
            *(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()),
            file=sys.stderr,
            flush=True,
        )
        rows.append(row)
    table.finish(
        table.results("lifelong", rows, f"{args.keyframes} keyframes, {args.dimensions} dimensions"),
        args.json,
    )
    if args.flat and any(row["late MiB"] > _FLAT * row["early MiB"] for row in rows if "late MiB" in row):
        sys.exit("benchmarks: memory grows with the distance driven")


if __name__ == "__main__":
    main()
