"""Whether the pipeline knows how far it is from the truth: NEES over many drives through worlds with known noise.

``python -m benchmarks.consistency``. Each seed is a drive or flight through ``GraphSlam`` in memory, compared in the
frame of its first pose. The simulator draws white errors of velocity, and the pipeline is told of them and of nothing
else (``TOLD``). Besides fixed seeds there are fresh ones, and with ``--changed`` settings that depart from that.
"""

import argparse
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from benchmarks import options, table
from graph_slam_ros.analysis.consistency import Nees, landmark_errors, pose_errors
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.results import landmark_estimates
from graph_slam_ros.slam import Config, Control, GraphSlam, MapView
from graph_slam_ros.tools.simulation import Recording, measurements, simulate

Array = NDArray[np.float64]

BAND = 0.999
SIGMAS = 3.0

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

# An error lasts no longer than its message, sightings have no other noise than they say, and none is an outlier.
TOLD = {"odometry.twist_correlation_s": 0.0, "landmarks.added_sigma_m": 0.0, "landmarks.loss": "none"}

CHANGED: dict[str, dict[str, Any]] = {
    "shared_noise 0": {"keyframes.shared_noise": 0.0},
    "shared_noise off": {"keyframes.shared_noise": 1e9},
    "usual loss": {"landmarks.loss": "huber_then_cauchy"},
    "usual added_sigma_m": {"landmarks.added_sigma_m": 0.05},
    "usual twist_correlation_s": {"odometry.twist_correlation_s": 0.25},
}


@dataclass(frozen=True, slots=True)
class World:
    """A world of ``simulation``, its options, and what of the pipeline's settings must be told for it."""

    name: str
    dimensions: int
    options: Mapping[str, Any]
    settings: Mapping[str, Any]


def _worlds(about: str, sigmas: float, lasting_s: float, settings: Mapping[str, Any]) -> dict[str, World]:
    """The three worlds with so many times their usual errors of velocity, which last so long."""
    driven, flown = (
        {name: sigmas * value for name, value in usual.items()} | {"correlation_time_s": lasting_s}
        for usual in (_DRIVEN, _FLOWN)
    )
    hall = {"aisles": 2, "laps": 1, "aisle_m": 6.0, **driven}
    return {
        f"plane, positions{about}": World("warehouse", 2, hall | {"sensor": "position"}, settings),
        f"plane, poses{about}": World("warehouse", 2, hall, settings),
        f"space, poses{about}": World("flight", 3, {"laps": 1, **flown}, settings),
    }


USUAL = _worlds("", _WHITE, 0.0, {})
WORLDS = {
    **USUAL,
    **_worlds(", quiet", 1.0, 0.0, {}),
    **_worlds(", lasting", 1.0, 0.5, {"odometry.twist_correlation_s": 1.0}),
}


@dataclass(frozen=True, slots=True)
class Run:
    """Errors of one drive in the frame of its first pose, and the covariances of these.

    Attributes
    ----------
    poses, of_poses : (n, d) and (n, d, d), of all keyframes but the first
    landmarks, of_landmarks : (m, 2) and (m, 2, 2), or in space (m, 3) and (m, 3, 3)
    """

    poses: Array
    of_poses: Array
    landmarks: Array
    of_landmarks: Array

    @property
    def last_pose_nees(self) -> float:
        """Of the last pose."""
        return _nees(self.poses[-1:], self.of_poses[-1:])

    @property
    def landmark_nees(self) -> float:
        """The mean of all landmarks."""
        return _nees(self.landmarks, self.of_landmarks)

    def within(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which coordinates of the last position, and of all landmarks, are within their three sigmas."""
        n = self.landmarks.shape[1]
        return _within(self.poses[-1:, :n], self.of_poses[-1:, :n, :n]), _within(self.landmarks, self.of_landmarks)


def drive(world: World, seed: int, settings: Mapping[str, Any]) -> Run:
    """One drive, online and solved at its end."""
    recording = simulate(world.name, seed, **world.options)
    slam = GraphSlam(Config.from_mapping({"world.dimensions": world.dimensions, **settings, **world.settings}))
    for m in [*measurements(recording), Control("end"), Control("optimize")]:
        slam.process(m)
    return compare(slam.view, recording)


def compare(view: MapView, recording: Recording) -> Run:
    """A solved run with the truth; keyframes are at stamps of odometry, for which the simulator knows the truth."""
    estimate = se3.in_space(view.trajectory()) if view.space.dimensions == 2 else view.trajectory()
    at = np.searchsorted(recording.stamps_ns, view.keyframes.stamps_ns)
    true = recording.T_world_base[at]
    true = se3.in_space(true) if view.space.dimensions == 2 else true
    covariances = view.keyframe_covariances()
    n, found = view.space.dimensions, landmark_estimates(view)
    positions, true_positions = np.zeros((len(found), 3)), np.zeros((len(found), 3))
    of_positions = np.zeros((len(found), 3, 3))
    for k, (name, value, covariance) in enumerate(found):
        positions[k, :n], true_positions[k, :n] = value[:n], recording.landmarks[name][:n]
        of_positions[k, :n, :n] = covariance[:n, :n]
    of_landmarks = landmark_errors(positions, true_positions, of_positions, estimate[0], true[0], covariances[0])
    return Run(*pose_errors(estimate, true, covariances), *of_landmarks)


def measure(name: str, seeds: Sequence[int], label: str, settings: Mapping[str, Any]) -> Iterator[table.Row]:
    """Two rows of a world: last pose and landmarks."""
    world = WORLDS[name]
    runs = [drive(world, seed, settings) for seed in seeds]
    within = [np.concatenate(one) for one in zip(*(run.within() for run in runs), strict=True)]
    last, landmarks = np.array([run.last_pose_nees for run in runs]), np.array([run.landmark_nees for run in runs])
    dof, dimensions = runs[0].poses.shape[1], runs[0].landmarks.shape[1]
    told = {"world": name, "settings": label, "first": seeds[0], "seeds": len(seeds)}
    for what, values, expected, band, inside in (
        ("last pose", last, dof, chi_square_band(dof, len(runs)), within[0]),
        ("landmarks", landmarks, dimensions, run_band(landmarks, dimensions), within[1]),
    ):
        mean, share = float(values.mean()), float(inside.mean())
        options.say(f"{name}, {label}, from seed {seeds[0]}: {what} {mean:.3f}, band {band[0]:.3f} to {band[1]:.3f}")
        nees = {"mean": mean, "expected": expected, "band": band, "inside": band[0] <= mean <= band[1]}
        yield {**told, "what": what, **nees, "within": share, "coordinates": len(inside)}


def chi_square_band(dof: int, runs: int) -> tuple[float, float]:
    """Where the mean over independent runs is with a probability of 99.9 %."""
    low, high = stats.chi2.ppf([0.5 - 0.5 * BAND, 0.5 + 0.5 * BAND], dof * runs) / runs
    return float(low), float(high)


def run_band(values: Array, expected: float) -> tuple[float, float]:
    """The same for means over each run's landmarks, which are not independent: by Student's t from their spread."""
    if len(values) < 2:
        return 0.0, float("inf")
    half = stats.t.ppf(0.5 + 0.5 * BAND, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return float(expected - half), float(expected + half)


def _nees(errors: Array, covariances: Array) -> float:
    nees = Nees.of(errors, covariances)
    return np.nan if nees is None or nees.skipped else nees.mean


def _within(errors: Array, covariances: Array) -> NDArray[np.bool_]:
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return np.asarray(np.abs(errors) <= SIGMAS * sigmas).ravel()


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("worlds", nargs="*", metavar="WORLD", help=f"of {'; '.join(WORLDS)} (default: the first three)")
    parser.add_argument("--seeds", type=int, default=100, metavar="N", help="so many drives of each world")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first of them")
    parser.add_argument(
        "--fresh", type=int, metavar="N", help="so many more of seeds that are drawn (default: as many)"
    )
    parser.add_argument(
        "--changed", action="append", choices=[*CHANGED, "all"], help="a setting that departs from that"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the results there as well")
    args = parser.parse_args()
    for name in args.worlds:
        if name not in WORLDS:
            parser.error(f"{name} is none of {'; '.join(WORLDS)}")
    fixed, drawn = range(args.first, args.first + args.seeds), random.SystemRandom().randrange(10**6, 2**31)
    fresh = range(drawn, drawn + (args.seeds if args.fresh is None else args.fresh))
    rows: list[table.Row] = []
    for name in args.worlds or USUAL:
        rows += measure(name, fixed, "told", TOLD)
        rows += measure(name, fresh, "told", TOLD) if fresh else []
        for label, changed in CHANGED.items():
            if {label, "all"} & set(args.changed or ()):
                rows += measure(name, fixed, label, TOLD | changed)
    table.finish(table.results("consistency", rows), args.json)


if __name__ == "__main__":
    main()
