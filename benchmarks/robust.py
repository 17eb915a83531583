"""False loop closures and wrong identities: how far the path is off, who is believed, and what it costs.

``python -m benchmarks.robust [FILE ...] [--policy random,group --rate 0.1,0.5] [--seeds 10]``; without all of it the
cells of docs/robustness.md. A rate is the false part of all. What is false is drawn anew for each seed; contenders take
turns, each in a fresh process. Position errors are against the optimum of the graph without false closures, or where
there is truth against that.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import contenders, fresh, options, recorded, robust_cells, table
from benchmarks.contenders import OURS, ROBUST_PEERS, Believed
from benchmarks.courses import Course, of_graph
from benchmarks.kept import Kept, code_of, digest
from benchmarks.robust_cells import Rates
from benchmarks.scores import Row, Score, Stage, row, score, stages
from benchmarks.trials import POLICIES, Trial
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.errors import GraphSlamError

SEEDS = 10
FEW_SEEDS = 3  # of peers, who take most of the time, and of ours where a run takes longer than
LONG_S = 300.0  # of CPU time
PATIENCE_S = 120.0
SLOW_S = 30.0  # a peer that takes longer has one seed
USUAL = ("gtsam-huber", "gtsam-gm", "gtsam-gnc", "isam2-dcs")


@dataclass(frozen=True, slots=True)
class Race:
    """Who races, and how.

    Attributes
    ----------
    seeds : of each cell; peers have the first few
    patience_s : CPU time after which a peer is called off
    jobs : seeds at a time, of each of which contenders take turns
    """

    peers: Sequence[str]
    seeds: int
    patience_s: float
    jobs: int
    kept: Kept

    def cell(self, course: Course, policy: str, rate: float) -> list[Row]:
        """The rows of one cell: ours online and solved, and each peer."""
        found: dict[str, dict[int, dict[Stage, Score]]] = {who: {} for who in (OURS, *self.peers)}
        sizes: dict[str, int] = {}

        def one(seed: int) -> None:
            trial = course.trial(policy, rate, seed)
            sizes.update(true=int((~trial.false).sum()), false=int(trial.false.sum()))
            for who, so_far in found.items():
                if self._is_asked(who, seed, so_far):
                    believed = self.believe(who, trial)
                    so_far[seed] = {stage: score(course, trial, believed, stage) for stage in stages(who)}
                    options.say(f"{course.name}, {policy} {rate:g}, seed {seed}: {_told(who, so_far[seed])}")

        with ThreadPoolExecutor(self.jobs) as pool:
            list(pool.map(one, range(1 if is_clean(policy, rate) else self.seeds)))
        cell = {"graph": course.name, "policy": policy, "rate": rate, "odometry_m": course.odometry_m} | sizes
        clean, asked, rows = self._without_faults(course, OURS), robust_cells.target(course.name, policy, rate), []
        for who, by_seed in found.items():
            plain = self._without_faults(course, contenders.plain(who))
            for stage in stages(who):
                about = cell | {"who": who, "stage": stage}
                about |= {"plain_s": plain[stage].cpu_s, "plain_chi2": plain[stage].chi2}
                about["target"] = asked.as_row(stage, clean[stage].error_m) if asked and who == OURS else None
                rows.append(row(about, [(seed, by_seed[seed][stage]) for seed in sorted(by_seed)]))
        return rows

    def _without_faults(self, course: Course, who: str) -> Mapping[Stage, Score]:
        trial = course.trial(course.clean_policy, 0.0, 0)
        believed = self.believe(who, trial)
        return {stage: score(course, trial, believed, stage) for stage in stages(who)}

    def believe(self, who: str, trial: Trial) -> Believed:
        """What a contender makes of a trial, in a process of its own."""
        patience_s = np.inf if who.startswith(OURS) else self.patience_s

        def call() -> Believed:
            try:
                return fresh.call(contenders.believe, who, trial.odometry, trial.closures, cpu_s=patience_s)
            except fresh.Crashed as error:
                return Believed(fault=str(error))

        return self.kept.ask(digest(who, patience_s, code_of(who), *trial.arrays()), call)

    def _is_asked(self, who: str, seed: int, so_far: Mapping[int, Mapping[Stage, Score]]) -> bool:
        scores = [one[stage] for one in list(so_far.values()) for stage in stages(who)]
        if who == OURS:
            return seed < FEW_SEEDS or not any(one.cpu_s > LONG_S for one in scores)
        slow = any(one.cpu_s > SLOW_S or one.fault.startswith("called off") for one in scores)
        return seed < FEW_SEEDS and not slow


def is_clean(policy: str, rate: float) -> bool:
    """Whether nothing is false in a cell, whatever the seed."""
    return rate == 0.0 and policy != "swapped_ids"


def _told(who: str, scores: Mapping[Stage, Score]) -> str:
    told = []
    for stage, one in scores.items():
        counts = f"{one.believed} believed, {one.lost} lost, " if one.believed is not None else ""
        told.append(f"{stage} " + (one.fault or f"{one.error_m:.3f} m, {counts}{one.cpu_s:.1f} s"))
    return f"{who} {'; '.join(told)}"


def courses(args: argparse.Namespace, kept: Kept) -> Iterator[tuple[Course, Rates]]:
    """What is asked for, each with its cells; what cannot be raced is said and skipped."""
    asked = None if args.policy is None else dict.fromkeys(args.policy, args.rate)
    for problem in () if args.recordings else options.problems(args):
        rates = asked or robust_cells.GRAPHS.get(problem.name)
        if rates is None:
            if args.files:
                options.say(f"skipped: {problem.name}: tell --policy and --rate")
            continue
        try:
            yield of_graph(problem), rates
        except GraphSlamError as error:
            options.say(f"skipped: {error}")
    for course in () if args.files else recorded.courses(kept):
        yield course, asked or robust_cells.RECORDINGS[course.name.split(",")[0]]


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__, ROBUST_PEERS, USUAL)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="graphs (default: those of the document)")
    parser.add_argument("--recordings", action="store_true", help="recorded drives among landmarks alone")
    parser.add_argument("--policy", type=_policies, metavar="NAME,...", help=f"of {', '.join(POLICIES)}")
    parser.add_argument("--rate", type=_rates, default=[0.3], metavar="R,...", help="false ones of all (0.3)")
    parser.add_argument(
        "--seeds", type=values.count, default=SEEDS, metavar="N", help=f"default: {SEEDS}; peers: {FEW_SEEDS}"
    )
    parser.add_argument(
        "--patience", type=values.positive, default=PATIENCE_S, metavar="S", help="CPU seconds for a peer's run"
    )
    parser.add_argument("--jobs", type=values.count, default=1, metavar="N", help="seeds at a time")
    parser.add_argument("--poses", type=values.count, metavar="N", help="the first N poses of each graph only")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="of what was run; what is there is not run again")
    args = parser.parse_args()
    if args.keep is not None and args.keep.exists() and not args.keep.is_dir():
        parser.error(f"argument --keep: {args.keep} is not a folder")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        race = Race(args.peers, args.seeds, args.patience, args.jobs, Kept(args.keep or Path(folder)))
        for course, asked in courses(args, race.kept):
            for policy, rates in asked.items():
                for rate in rates:
                    try:
                        rows += race.cell(course, policy, rate)
                    except GraphSlamError as error:
                        options.say(f"skipped: {error}")
    if not rows:
        sys.exit(2)  # why has been said
    about = f"seeds: {args.seeds}, of peers at most {FEW_SEEDS}; {args.patience:g} s of patience with each of these"
    table.finish(table.results("robust", rows, about), args.json)


def _policies(text: str) -> list[str]:
    names = text.split(",")
    for name in names:
        if name not in POLICIES:
            raise argparse.ArgumentTypeError(f"{name} is none of {', '.join(POLICIES)}")
    return names


def _rates(text: str) -> list[float]:
    try:
        rates = [float(word) for word in text.split(",")]
    except ValueError:
        rates = [-1.0]
    if not all(0.0 <= rate < 1.0 for rate in rates):
        raise argparse.ArgumentTypeError(f"{text}: rates are from 0 up to 1")
    return rates


if __name__ == "__main__":
    main()
