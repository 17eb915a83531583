"""Whether the pipeline knows how far it is from the truth: NEES over many drives through worlds with known noise.

``python -m benchmarks.consistency [WORLD ...]``. Each seed is a drive or flight, replayed and evaluated. The simulator
draws white errors of velocity, and the pipeline is told of them and of nothing else (``_TOLD``). Besides fixed seeds
there are as many fresh ones, and with ``--changed`` settings that depart from that.
"""

import argparse
import random
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks import options, table
from graph_slam_ros.analysis.consistency import Nees
from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag
from graph_slam_ros.typing import Array

_BAND = 0.999

# Errors of velocity that are drawn anew for each tick of 20 ms make the worlds' usual drift, by errors that last half a
# second, with the root of (2 * 0.5 s / 0.02 s) times the usual sigmas.
_WHITE = (2.0 * 0.5 / 0.02) ** 0.5
_DRIVEN = {"sigma_speed_m_s": 0.05, "sigma_sideways_m_s": 0.01, "sigma_turn_rad_s": 0.05}
_FLOWN = {
    "sigma_forward_m_s": 0.05,
    "sigma_sideways_m_s": 0.03,
    "sigma_climb_m_s": 0.04,
    "sigma_tilt_rad_s": 0.004,
    "sigma_turn_rad_s": 0.02,
}
_HALL = {"aisles": 2, "laps": 1, "aisle_m": 6.0, **{name: _WHITE * sigma for name, sigma in _DRIVEN.items()}}
_WORLDS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "plane, positions": ("warehouse", 2, _HALL | {"sensor": "position"}),
    "plane, poses": ("warehouse", 2, _HALL),
    "space, poses": ("flight", 3, {"laps": 1, **{name: _WHITE * sigma for name, sigma in _FLOWN.items()}}),
}

# An error lasts no longer than its message, sightings have no other noise than they say, and none is an outlier.
_TOLD = {"odometry.twist_correlation_s": 0.0, "landmarks.added_sigma_m": 0.0, "landmarks.loss": "none"}
_CHANGED: dict[str, dict[str, Any]] = {
    "shared_noise off": {"keyframes.shared_noise": 1e9},
    "usual loss": {"landmarks.loss": "huber_then_cauchy"},
    "usual added_sigma_m": {"landmarks.added_sigma_m": 0.05},
    "usual twist_correlation_s": {"odometry.twist_correlation_s": 0.25},
}


def drive(name: str, seed: int, settings: Mapping[str, Any]) -> tuple[Nees, Nees]:
    """NEES of the last pose and of the landmarks of a drive, solved at its end."""
    world, dimensions, how = _WORLDS[name]
    with tempfile.TemporaryDirectory() as folder:
        bag, run = Path(folder) / "drive.mcap", Path(folder) / "run"
        write_bag(simulate(world, seed, correlation_time_s=0.0, **how), bag)
        replay(bag, run, Config.from_mapping({"world.dimensions": dimensions, **settings}))
        found = evaluate(run, str(bag)).consistency
    assert found is not None and found.last_pose is not None and found.landmarks is not None
    return found.last_pose, found.landmarks


def measure(name: str, seeds: range, settings: Mapping[str, Any]) -> Iterator[str]:
    """Mean NEES of the last pose and of landmarks in a world; outside the band is said."""
    runs = [drive(name, seed, settings) for seed in seeds]
    for k in range(2):
        nees, expected = np.array([run[k].mean for run in runs]), runs[0][k].dof
        mean, (low, high) = float(nees.mean()), _band(nees, expected, are_independent=k == 0)
        options.say(f"{name}, from seed {seeds[0]}: {mean:.3f}, band {low:.3f} to {high:.3f}")
        yield f"{mean:.3f}" + ", outside its band" * (not low <= mean <= high)


def _band(values: Array, dof: int, *, are_independent: bool) -> tuple[float, float]:
    """Where the mean over independent runs is with a probability of 99.9 %: by chi-square of single errors.

    Errors of a run's landmarks are not independent, so it is Student's t of their means' spread.
    """
    n = len(values)
    if are_independent:
        low, high = stats.chi2.ppf([0.5 - 0.5 * _BAND, 0.5 + 0.5 * _BAND], dof * n) / n
        return float(low), float(high)
    half = stats.t.ppf(0.5 + 0.5 * _BAND, n - 1) * values.std(ddof=1) / n**0.5 if n > 1 else np.inf
    return float(dof - half), float(dof + half)


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("worlds", nargs="*", metavar="WORLD", help=f"of {'; '.join(_WORLDS)} (default: all)")
    parser.add_argument("--seeds", type=values.count, default=100, metavar="N", help="so many drives, and fresh ones")
    about = "a setting that departs from that"
    parser.add_argument("--changed", action="append", default=[], choices=[*_CHANGED, "all"], help=about)
    table.add_write(parser)
    args = parser.parse_args()
    for name in args.worlds:
        if name not in _WORLDS:
            parser.error(f"{name} is none of {'; '.join(_WORLDS)}")
    drawn = random.SystemRandom().randrange(10**6, 2**31)
    first, others = f"mean, seeds 0 to {args.seeds - 1}", f"mean, {args.seeds} other seeds"
    rows: list[table.Row] = []
    for name in args.worlds or _WORLDS:
        found = measure(name, range(args.seeds), _TOLD), measure(name, range(drawn, drawn + args.seeds), _TOLD)
        space = _WORLDS[name][1] == 3
        of = ("last pose", 6 if space else 3), ("landmarks", 3 if space else 2)
        for (what, expected), mean, other in zip(of, *found, strict=True):
            rows.append({"world": name, "NEES of": what, "expected": expected, first: mean, others: other})
        for label, changed in _CHANGED.items():
            if {label, "all"} & set(args.changed):
                for (what, expected), mean in zip(of, measure(name, range(args.seeds), _TOLD | changed), strict=True):
                    rows.append({"world": f"{name}, {label}", "NEES of": what, "expected": expected, first: mean})
    table.finish("consistency", rows, write=args.write, keys=2)


if __name__ == "__main__":
    main()
