"""False loop closures and wrong identities: how far the path is off, who is believed, and what it costs.

``python -m benchmarks.robust [FILE ...] [--policy random,group --rate 0.1,0.5] [--seeds 3]``; without all of it the
cells of docs/robustness.md. A rate is the false part of all. What is false is drawn anew for each seed; contenders take
turns, each in a fresh process. Position errors are against the optimum of the graph without false closures, or where
there is truth against that.
"""

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from statistics import median
from typing import Literal

import numpy as np
from scipy.stats import chi2

from benchmarks import contenders, courses, fresh, judge, options, table
from benchmarks.contenders import OURS, OURS_PLAIN, ROBUST_PEERS, Believed
from benchmarks.courses import Course
from benchmarks.trials import ID_POLICIES, POLICIES, Trial
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.errors import GraphSlamError

Stage = Literal["online", "batch"]
Rates = Mapping[str, Sequence[float]]
"""Rates by policy."""

_PATIENCE_S = 120.0  # CPU time after which a peer is called off
_FITS = 0.99  # of who tells no weight: what is within this quantile of chi2 was believed
_HALF = 0.5  # of a weight

_MANHATTAN: Rates = {"random": (0.0, 0.1, 0.32, 0.5)}
_LANDMARKS: Rates = {"wrong_ids": (0.0, 0.05, 0.2)}
_CELLS: Mapping[str, Rates] = {
    "intel_943": {
        "random": (0.0, 0.1, 0.5, 0.8),
        **dict.fromkeys(("local", "group", "local-group"), (0.3, 0.5)),
        "aliased": (0.3,),
    },
    "M3500": _MANHATTAN,
    "manhattanOlson3500": {**_MANHATTAN, "group": (0.32,), "aliased": (0.1,)},
    "sphere2500": {"random": (0.0, 0.1, 0.5, 0.8)},
    "MR.CLAM 7": {**_LANDMARKS, "swapped_ids": (0.0,)},
    "Victoria Park": _LANDMARKS,
}

_COLUMNS = {
    f"{OURS}, online": f"{OURS}, online",
    f"{OURS}, batch": f"{OURS}, solved",
    "gtsam-huber, batch": "Huber",
    "gtsam-gm, batch": "Geman-McClure",
    "gtsam-gnc, batch": "GNC",
    "isam2-dcs, online": "DCS",
}


@dataclass(frozen=True, slots=True)
class Score:
    """Of one run; what there is not is None.

    Attributes
    ----------
    error_m : see ``Course``
    believed : false measurements that keep more than half of their weight
    lost : true ones that keep less than half
    """

    cpu_s: float
    fault: str
    error_m: float = math.nan
    believed: int | None = None
    lost: int | None = None


def stages(who: str) -> tuple[Stage, ...]:
    """When a contender has a path: after the last measurement came, or after everything was solved."""
    return ("online", "batch") if who.startswith(OURS) else ("online",) if who.startswith("isam2") else ("batch",)


def score(course: Course, trial: Trial, found: Believed, stage: Stage) -> Score:
    """Judge a run at one of its stages."""
    poses = found.online if stage == "online" else found.batch
    cpu_s = found.online_s + (found.batch_s if stage == "batch" else 0.0)
    if found.fault or not len(poses) or not np.isfinite(poses).all():
        return Score(cpu_s, found.fault or "no finite path")
    weights = found.online_weights if stage == "online" else found.weights
    if not len(weights) and not len(trial.odometry.sightings):
        fit = judge.fits(trial.closures, poses)
        weights = np.where(fit <= chi2.ppf(_FITS, trial.closures.root.shape[-1]), 1.0, 0.0)
    if not len(weights):
        return Score(cpu_s, "", course.error_m(poses))
    believed, lost = int((weights[trial.false] > _HALF).sum()), int((weights[~trial.false] <= _HALF).sum())
    return Score(cpu_s, "", course.error_m(poses), believed, lost)


@dataclass(frozen=True, slots=True)
class Race:
    """Who races, and how.

    Attributes
    ----------
    seeds : of each cell
    jobs : seeds at a time, of each of which contenders take turns
    """

    peers: Sequence[str]
    seeds: int
    jobs: int

    def plain_s(self, course: Course) -> float:
        """CPU time of ours without a loss and without false measurements."""
        clean = course.trial(course.clean_policy, 0.0, 0)
        options.say(f"{course.name}: odometry alone {course.error_m(clean.odometry.poses):.3f} m")
        return self._scores(course, (OURS_PLAIN,), clean)[f"{OURS_PLAIN}, batch"].cpu_s

    def cell(self, course: Course, policy: str, rate: float, plain_s: float) -> table.Row:
        """The line of one cell: ours online and solved, its time over that without a loss, and each peer."""
        is_clean = rate == 0.0 and policy != "swapped_ids"
        trials = [course.trial(policy, rate, seed) for seed in range(1 if is_clean else self.seeds)]
        with ThreadPoolExecutor(self.jobs) as pool:
            found = list(pool.map(lambda trial: self._scores(course, (OURS, *self.peers), trial), trials))
        by_column = {column: [one[column] for one in found] for column in found[0]}
        times = [one.cpu_s / plain_s for one in by_column[f"{OURS}, batch"] if not one.fault]
        false = trials[0].false
        return {
            "graph": course.name,
            "false ones": f"{policy}, {int(false.sum())} of {len(false)}",
            "of plain": f"{median(times):.1f}" if times else "",
            **{_COLUMNS[column]: _spread(scores) for column, scores in by_column.items()},
        }

    def _scores(self, course: Course, names: Sequence[str], trial: Trial) -> dict[str, Score]:
        out = {}
        for who in names:
            believed = self.believe(who, trial)
            for stage in stages(who):
                out[f"{who}, {stage}"] = found = score(course, trial, believed, stage)
                options.say(f"{course.name}, {who}, {stage}: {found}")
        return out

    def believe(self, who: str, trial: Trial) -> Believed:
        """What a contender makes of a trial, in a process of its own."""
        patience_s = np.inf if who.startswith(OURS) else _PATIENCE_S
        try:
            return fresh.call(contenders.believe, who, trial.odometry, trial.closures, cpu_s=patience_s)
        except fresh.Crashed as error:
            return Believed(fault=str(error))


def _spread(scores: Sequence[Score]) -> str:
    """The median error in metres and in brackets the worst; and how many seeds have no path and why the first has."""
    known, faults = [one.error_m for one in scores if not one.fault], [one.fault for one in scores if one.fault]
    words = []
    if known:
        middle, worst = f"{median(known):.4f}", f"{max(known):.4f}"
        words.append(middle if middle == worst else f"{middle} ({worst})")
    if faults:
        words.append((f"{len(faults)} of {len(scores)} " if known else "") + faults[0])
    return " ".join(words)


def rows_of(race: Race, course: Course, rates: Rates) -> tuple[list[table.Row], list[table.Row]]:
    """The lines of a course, with false closures, and one with wrong ids; what cannot be raced is said and skipped."""
    closures, ids, plain_s = list[table.Row](), table.Row(), race.plain_s(course)
    for policy, rate in ((policy, rate) for policy, several in rates.items() for rate in several):
        try:
            row = race.cell(course, policy, rate, plain_s)
        except GraphSlamError as error:
            options.say(f"skipped: {error}")
            continue
        if policy in ID_POLICIES:
            what = "two tags swapped" if policy == "swapped_ids" else f"{rate:.0%} wrong ids" if rate else "clean"
            ids |= {what: row[f"{OURS}, solved"]}
        else:
            closures.append(row)
    return closures, [{"error in m, solved": course.name} | ids] if ids else []


def _courses(args: argparse.Namespace) -> Iterator[Course]:
    for problem in () if args.recordings else options.problems(args):
        if args.files or args.policy or problem.name in _CELLS:
            try:
                yield courses.of_graph(problem)
            except GraphSlamError as error:
                options.say(f"skipped: {error}")
    if not args.files:
        yield from courses.recorded()


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__)
    options.add_peers(parser, ROBUST_PEERS)
    parser.add_argument("--recordings", action="store_true", help="recorded drives among landmarks alone")
    policies = f"of {', '.join(POLICIES)}"
    parser.add_argument("--policy", type=lambda text: options.chosen(text, POLICIES), metavar="NAME,...", help=policies)
    about = "false ones of all, from 0 up to 1 (0.3)"
    parser.add_argument("--rate", type=_numbers, default=[0.3], metavar="R,...", help=about)
    parser.add_argument("--seeds", type=values.count, default=3, metavar="N", help="of each cell (3)")
    parser.add_argument("--jobs", type=values.count, default=1, metavar="N", help="seeds at a time")
    args = parser.parse_args()
    race, is_empty = Race(args.peers, args.seeds, args.jobs), True
    for course in _courses(args):
        rates = dict.fromkeys(args.policy, args.rate) if args.policy else _CELLS.get(course.name.split(",")[0])
        if rates is None:
            options.say(f"skipped: {course.name}: tell --policy and --rate")
            continue
        for name, keys, rows in zip(("robust", "wrong_ids"), (2, 1), rows_of(race, course, rates), strict=True):
            if rows:
                is_empty = False
                table.finish(name, rows, write=args.write, note=f"{args.seeds} seeds", keys=keys)
    if is_empty:
        sys.exit(2)  # why has been said


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split(",")]


if __name__ == "__main__":
    main()
