"""The table that must not get worse: ``make figures``; at most half an hour on two cores.

Every row has a name, a value, which way is better, and by what factor it may be worse than the row of
docs/figures/figures.csv. Worse rows are listed and end the programme with 1, and so do rows that no longer exist and
measurements that fail. What cannot be measured, since a data set is absent, is named. ``--write`` replaces the table.

Results are the same in each run, so these are measured two at a time. What takes time is measured alone, at the end.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from benchmarks import courses, datasets, figures, fresh, judge, lifelong, online, replay
from benchmarks.carried import MOMENTS_S, Carried
from benchmarks.contenders import OURS
from benchmarks.datasets import DATASETS, Absent, mrclam
from benchmarks.figure_rows import COST, NEVER, TABLE, TIME, Outcome, Row, compare, read_table, write_table
from benchmarks.options import say
from benchmarks.problem import Problem, read_problem
from benchmarks.robust import Race, score
from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.runs.replay import replay as replayed
from graph_slam_ros.runs.trajectory import read_landmarks
from graph_slam_ros.slam import Config, Control, GraphSlam, MapView, Measurement
from graph_slam_ros.slam.landmarks.rotations import aligned
from graph_slam_ros.tools.simulation import Fault, Recording, faulty_recording, measurements, simulate, write_bag
from graph_slam_ros.typing import Array

_NEAR_M = 0.5  # farther than that from all poles, a landmark is wrong
_SLIP_S, _SOON_S, _LOSS = 20.0, 4.0, 0.2
_RANGES = {"inputs.names": "odom ranges", "ranges.type": "sensor_msgs/msg/PointCloud2", "ranges.topic": "/ranges"}


def recorded_robot(robot: int, ids: str) -> Iterator[Row]:
    """A robot of MR.CLAM set 7, with its ids or without."""
    bag, run = mrclam(robot, Path("bag"), *(() if ids == "known" else ("--ids", "none"))), Path("run")
    replayed(bag, run, Config.from_mapping({} if ids == "known" else {"landmarks.association": "joint"}))
    scores = evaluate(run, str(bag))
    yield Row("position", scores.estimate.position_m["rmse"], "m")
    if ids == "known":
        yield Row("map", _known(scores.map_rmse_m), "m")
    else:
        yield from _unnamed_map(bag, run)
    nees = scores.consistency and scores.consistency.poses
    yield Row("NEES of poses", nees.mean if nees else NEVER, better="3", comment="3 is expected")


def _unnamed_map(bag: Path, run: Path) -> Iterator[Row]:
    """Landmarks against the nearest poles, as the path lies on the truth; poles that stand together may be one."""
    truth, path = read_truth(bag), np.loadtxt(run / "path.tum")
    stamps_s = truth.trajectory.stamps_s
    path = path[(path[:, 0] > stamps_s[0]) & (path[:, 0] < stamps_s[-1])]
    true = np.stack([np.interp(path[:, 0], stamps_s, truth.trajectory.poses[:, k]) for k in (0, 1)], axis=1)
    turn, shift = aligned(path[:, 1:3], true)
    marks = read_landmarks(run / "landmarks.csv").positions[:, :2] @ turn.T + shift
    poles = np.array([one[:2] for one in truth.landmarks.values()])
    apart = np.linalg.norm(poles[:, None] - marks[None], axis=2)
    near = apart.min(axis=0)
    yield Row("map", _rms(near[near < _NEAR_M]), "m", comment="to the nearest poles")
    yield Row("landmarks wrong", int((near >= _NEAR_M).sum()))
    yield Row("poles missing", int((apart.min(axis=1) >= _NEAR_M).sum()))


def plaza() -> Iterator[Row]:
    """Ranges alone, to four beacons."""
    bag, epoch_s, truth = datasets.plaza()
    stamps_s, x, y, _ = loadmat(truth)["GT"].T
    rows = np.column_stack([stamps_s + epoch_s, x, y, np.zeros((len(x), 4)), np.ones(len(x))])
    np.savetxt("truth.tum", rows, fmt="%.9f")
    replayed(bag, Path("run"), Config.from_mapping(_RANGES))
    yield Row("position", evaluate(Path("run"), "truth.tum").estimate.position_m["rmse"], "m")


def world(kind: str, dimensions: int, seeds: Sequence[int]) -> Iterator[Row]:
    """Drives in a simulated world."""
    found = []
    for seed in seeds:
        bag, run = Path(f"{seed}.mcap"), Path(f"run{seed}")
        write_bag(simulate(kind, seed), bag)
        replayed(bag, run, Config.from_mapping({"world.dimensions": dimensions}))
        scores = evaluate(run, str(bag))
        found.append((scores.estimate.position_m["rmse"], _known(scores.map_rmse_m)))
    for name, errors in zip(("position", "map"), zip(*found, strict=True), strict=True):
        yield Row(name, _rms(errors), "m", comment=f"{len(seeds)} drives")


def carried(drives: Sequence[tuple[int, float]]) -> Iterator[Row]:
    """Robots that are carried; found is where one displacement is left at the end."""
    errors, found, false = [], 0, 0
    for seed, at_s in drives:
        one = Carried(seed, at_s)
        slam = _driven(one.measurements())
        displaced, slips = _left(slam, "displaced", "displacement"), _left(slam, "slip", "slip")
        found, false = found + (displaced > 0), false + max(displaced - 1, 0) + slips
        errors.append(_error_m(slam.view, one.true_positions(slam.view.keyframes.stamps_ns)))
    yield Row("found", found, f"of {len(drives)}", "higher", 1.0)
    yield Row("false", false, tolerance=1.0, comment="slips, and displacements beside the true one")
    yield Row("path, median", float(np.median(errors)), "m")
    yield Row("path, worst", max(errors), "m")


def slips(drives: Sequence[tuple[int, str]]) -> Iterator[Row]:
    """Wheels that lose a fifth of the way for 20 s; found is what is decided within 4 s."""
    errors, found, false = [], 0, 0
    for seed, sensor in drives:
        clean = simulate("warehouse", seed=seed, aisle_m=40.0, aisles=3, sensor=sensor)
        length_s = 1e-9 * float(clean.stamps_ns[-1] - clean.stamps_ns[0])
        fault = Fault.named("slip", at=0.7, lasting=_SLIP_S / length_s, factor=1.0 / (1.0 - _LOSS))
        begin_ns = int(clean.stamps_ns[round(0.7 * (len(clean.stamps_ns) - 1))])
        slam, before, soon = GraphSlam(Config()), 0, 0
        for m in measurements(faulty_recording(clean, [fault], seed=1)[0]):
            slam.process(m)
            decided = slam.counters["odometry", "slip"]
            before = decided if m.stamp_ns <= begin_ns else before
            soon = decided if m.stamp_ns <= begin_ns + _SOON_S * 1e9 else soon
        slam.process(Control("end"))
        found, false = found + (soon > before), false + before + _left(slam, "displaced", "displacement")
        errors.append(_error_m(slam.view, _true_positions(clean, slam.view)))
    yield Row("found", found, f"of {len(drives)}", "higher", 1.0)
    yield Row("false", false, tolerance=1.0, comment="displacements, and slips before it slipped")
    yield Row("path", _rms(errors), "m")


def clean(drives: Sequence[tuple[str, int, dict[str, Any]]]) -> Iterator[Row]:
    """Drives of ten minutes with nothing wrong."""
    alarms = 0
    for kind, seed, how in drives:
        slam = _driven(measurements(simulate(kind, seed, **how)))
        alarms += slam.counters["odometry", "displaced"] + slam.counters["odometry", "slip"]
    yield Row("false alarms", alarms, f"in {len(drives)}", tolerance=1.0)


def false_closures(name: str, poses: int, policy: str, rate: float) -> Iterator[Row]:
    """False measurements in a graph, or wrong ids of a robot; everything is solved at the end."""
    race = Race((), 1, 1)
    if name.startswith("MR.CLAM"):
        course = courses.of_robot(int(name[-1]))
    else:
        course = courses.of_graph(_graph(name).prefix(poses))
    trial = course.trial(policy, rate, 0)
    found = score(course, trial, race.believe(OURS, trial), "batch")
    if found.fault:
        raise RuntimeError(found.fault)
    true, false = int((~trial.false).sum()), int(trial.false.sum())
    yield Row("path", _known(found.error_m), "m", slack=1e-3)
    yield Row("true ones lost", _known(found.lost), f"of {true}")
    yield Row("false ones kept", _known(found.believed), f"of {false}")


def against_isam2(name: str) -> Iterator[Row]:
    """Pose by pose, the newest pose read after each; both take turns."""
    problem = _graph(name)
    drives = online.race(problem, 3, False)
    faults = [several[-1].fault for several in drives.values() if several[-1].fault]
    if faults:
        raise RuntimeError(faults[0])
    times = [online.times(several)[0] for several in drives.values()]
    yield Row("CPU of iSAM2's", times[0] / times[1], "times", tolerance=TIME)
    chi2 = [judge.chi2(problem, one.poses, one.landmarks) for *_, one in drives.values()]
    yield Row("chi2 of iSAM2's", chi2[0] / chi2[1], "times", tolerance=COST)


def hall(keyframes: int, window: int) -> Iterator[Row]:
    """A robot that drives in one hall, its map bounded."""
    found = next(iter(lifelong.measure(keyframes, [0], [window])))
    yield Row("path", found["path m"], "m")
    yield Row("landmarks", found["landmarks m"], "m")
    yield Row("memory", found["late MiB"], "MiB", tolerance=1.05)
    yield Row("p99 of updates", found["p99 ms"], "ms", tolerance=TIME)
    yield Row("CPU of a keyframe", found["CPU ms"], "ms", tolerance=TIME)


def replay_cpu() -> Iterator[Row]:
    """The whole command, as a multiple of reading its recording with rosbags."""
    _, command_s, reading_s = replay.times(mrclam(5, Path("bag")), "replay", [], 3)
    ratio = float(np.median(np.divide(command_s, reading_s)))
    yield Row("CPU of reading", ratio, "times", tolerance=TIME)


def kernels() -> Iterator[Row]:
    """All of them, into an empty cache."""
    cpu_s, _ = replay.commanded(["warmup", "--dimensions", "3"], GRAPH_SLAM_CACHE=str(Path("cache").absolute()))
    yield Row("CPU to compile", cpu_s, "s", tolerance=1.2)


@dataclass(frozen=True, slots=True)
class Job:
    """What makes rows, in a process and a folder of its own."""

    name: str
    make: Callable[..., Iterator[Row]]
    given: tuple[Any, ...] = ()

    def run(self) -> Outcome:
        """Measure."""
        began_s, rows, absent = time.process_time(), tuple[Row, ...](), ""
        with tempfile.TemporaryDirectory(prefix="figures-") as folder:
            os.chdir(folder)
            try:
                rows = tuple(replace(row, name=f"{self.name}: {row.name}") for row in self.make(*self.given))
            except Absent as error:
                absent = str(error)
            os.chdir(fresh.ROOT)
        return Outcome(rows, absent, cpu_s=time.process_time() - began_s + fresh.children_s())

    def apart(self) -> Outcome:
        """As ``run``, in a fresh process."""
        try:
            out: Outcome = fresh.call(figures.run, self.name)
        except fresh.Crashed as error:
            out = Outcome(failed=str(error))
        say(f"{self.name}: {out.cpu_s:.0f} s of CPU{''.join(f'; {why}' for why in (out.absent, out.failed) if why)}")
        return out


_WAREHOUSE = {"aisles": 3, "aisle_m": 40.0, "laps": 4}
_CLEAN = (
    *(("warehouse", seed, {**_WAREHOUSE, "sensor": sensor}) for seed in (1, 2) for sensor in ("pose", "range_bearing")),
    *(("manhattan", seed, {"poses": 500, "blocks": 8}) for seed in (1, 2)),
    *(("pythonrobotics", seed, {"poses": 200}) for seed in (1, 2)),
)
RESULTS = (
    *(Job(f"MR.CLAM 7, robot {n}, ids removed", recorded_robot, (n, "removed")) for n in range(1, 6)),
    *(Job(f"carried, seed {n}", carried, ([(n, at_s) for at_s in MOMENTS_S],)) for n in range(3)),
    *(Job(f"slips, {of}", slips, ([(n, of) for n in (1, 5001, 5002)],)) for of in ("pose", "range_bearing")),
    Job("clean drives", clean, (_CLEAN,)),
    *(Job(f"MR.CLAM 7, robot {n}, ids known", recorded_robot, (n, "known")) for n in range(1, 6)),
    *(
        Job(f"{name}, {rate:g} of {policy}", false_closures, (name, poses, policy, rate))
        for name, poses, policy, rate in (
            ("M3500", 3500, "random", 0.5),
            ("manhattanOlson3500", 3500, "group", 0.32),
            ("MR.CLAM 7, robot 4", 0, "wrong_ids", 0.2),
            ("sphere2500", 800, "random", 0.5),
            ("intel_943", 943, "random", 0.8),
            ("intel_943", 943, "local-group", 0.5),
        )
    ),
    *(
        Job(f"world {kind}", world, (kind, dimensions, range(11, 14)))
        for kind, dimensions in (("flight", 3), ("warehouse", 2), ("manhattan", 2))
    ),
    Job("Plaza 2", plaza),
)
TIMED = (
    *(Job(name, against_isam2, (name,)) for name in ("M3500", "intel_943", "parking-garage", "sphere2500")),
    Job("hall", hall, (6000, 300)),
    Job("replay of MR.CLAM 7, robot 5", replay_cpu),
    Job("kernels", kernels),
)


def run(name: str) -> Outcome:
    """Measure the rows of a job."""
    return next(job for job in (*RESULTS, *TIMED) if job.name == name).run()


def _graph(name: str) -> Problem:
    file = DATASETS / f"pose_graphs/{name}.g2o"
    datasets.check(file)
    return read_problem(file)


def _driven(given: Iterable[Measurement]) -> GraphSlam:
    slam = GraphSlam(Config())
    for m in (*given, Control("end"), Control("optimize")):
        slam.process(m)
    return slam


def _left(slam: GraphSlam, counter: str, word: str) -> int:
    """Return how many of them were not taken back."""
    return slam.counters["odometry", counter] - slam.counters["odometry", f"{word}_taken_back"]


def _true_positions(recording: Recording, view: MapView) -> Array:
    at = np.searchsorted(recording.stamps_ns, view.keyframes.stamps_ns, side="right") - 1
    return recording.T_world_base[at, :2]


def _error_m(view: MapView, positions: Array) -> float:
    return judge.position_error(view.trajectory(), np.pad(positions, ((0, 0), (0, 1))))


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _known(value: float | None) -> float:
    return NEVER if value is None else value


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help=f"into docs/figures/{TABLE}.csv")
    parser.add_argument("--only", default="", metavar="TEXT", help="rows whose name begins with it")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="results at a time (default: 2)")
    args = parser.parse_args()
    began_s = time.perf_counter()
    results, timed = ([job for job in jobs if job.name.startswith(args.only)] for jobs in (RESULTS, TIMED))
    replay.commanded(["warmup"])
    with ThreadPoolExecutor(args.jobs) as pool:
        outcomes = dict(zip([job.name for job in results], pool.map(Job.apart, results), strict=True))
    outcomes |= {job.name: job.apart() for job in timed}
    before = read_table()
    faults = compare(outcomes, {name: row for name, row in before.items() if name.startswith(args.only)})
    print(*faults, sep="\n")
    cpu_s = [sum(outcomes[job.name].cpu_s for job in jobs) for jobs in (results, timed)]
    print(f"{time.perf_counter() - began_s:.0f} s; CPU: {cpu_s[0]:.0f} s for results, {cpu_s[1]:.0f} s for times")
    if args.write:
        others = {name: row for name, row in before.items() if not name.startswith(args.only)}
        write_table((others | {row.name: row for one in outcomes.values() for row in one.rows}).values())
    sys.exit(bool(faults) and not args.write)


if __name__ == "__main__":
    main()
