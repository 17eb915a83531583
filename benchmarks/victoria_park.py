"""A car among trees that have no names: Victoria Park, from its raw recording, against GPS.

``python -m benchmarks.victoria_park [FOLDER]`` (default: ``recorded/victoria_park`` of GRAPH_SLAM_DATASETS). Speed and
steering become poses of the middle of the rear axle, each scan's trees become sightings without identity, and
``GraphSlam`` associates them. GPS is not used but to judge.

What is compared is the path of the laser, at the front of the car: where the antenna was is not told, but the rear axle
is 4 m from where the estimate's turns have it.

GPS was failing at times: it is judged on quiet stretches only. A fix counts where all of the last 5 s have fixes at the
usual rate (none more than 0.5 s after the one before), and from each of them to this one GPS has moved as far as
odometry has, to within 1 m. That asks nothing of the estimate, and odometry does not drift as much in 5 s. The path is
laid onto those fixes by the rigid motion that fits best (least squares); told is the median distance. Odometry alone
is told beside it, laid on by itself.
"""

import argparse
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the commands do, before NumPy comes in

import numpy as np
from scipy.io import loadmat

from benchmarks import datasets, judge, table
from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.typing import Array

# The car: between the axles, left rear wheel (which has the encoder) beside the middle, and the laser before the axle.
_AXLES_M, _WHEEL_M, LASER = 2.83, 0.76, (2.83 + 0.95, 0.5, 0.0)

# What its sensors are good for: of the speed a part, for slip and tyres; of the steering the offset between its two
# extractions several times over, for backlash; sideways the same angle. Both last for seconds.
_SPEED_PART, _STEERING_RAD, _ERROR_LASTS_S = 0.05, 0.02, 1.0
# A beam every half degree and edges that fall between two, at a trunk of which one side is seen.
BEARING_RAD, RANGE_M, TRUNK_PART = 0.01, 0.1, 0.25

# Trees of a park stand some 15 m apart. What the car drives between two scans is a keyframe; less is none.
_SETTINGS: Mapping[str, Any] = {
    "map.condense": False,  # all of it is compared
    "landmarks.association": "joint",
    "landmarks.density_per_m": 0.07,
    "odometry.twist_correlation_s": _ERROR_LASTS_S,
    "keyframes.min_distance_m": 1.0,
}

_QUIET_S, _USUAL_S, _JUMP_M = 5.0, 0.5, 1.0


@dataclass(frozen=True, slots=True)
class Track:
    """Positions (n, 2) at stamps (n,) in seconds."""

    stamps_s: Array
    positions: Array

    @classmethod
    def of_laser(cls, stamps_s: Array, poses: Array) -> "Track":
        """Where the laser is, of poses (n, 3) of the base."""
        return cls(stamps_s, np.column_stack(se2.act(tuple(poses.T), LASER[:2])))

    def at(self, stamps_s: Array) -> Array:
        """Positions (n, 2) at other stamps, straight between two."""
        return np.column_stack([np.interp(stamps_s, self.stamps_s, x) for x in self.positions.T])


@dataclass(frozen=True, slots=True)
class Drive:
    """The recording.

    Attributes
    ----------
    odometry : (n, 4) stamp, x, y, heading of the base
    twists : (n, 2) speed in m/s and steering in rad
    scans : stamp and trees (3, k): range, bearing from the left of the laser's right side, diameter
    gps : its fixes
    """

    odometry: Array
    twists: Array
    scans: Sequence[tuple[float, Array]]
    gps: Track

    def path_of_odometry(self) -> Track:
        """Where odometry alone has the laser."""
        return Track.of_laser(self.odometry[:, 0], self.odometry[:, 1:])

    def quiet_fixes(self) -> Track:
        """The fixes that a path can be judged by."""
        gps, odometry = self.gps, self.path_of_odometry()
        moved = odometry.at(gps.stamps_s)
        late = np.diff(gps.stamps_s, prepend=-np.inf) > _USUAL_S
        good = np.zeros(len(late), dtype=bool)
        for k, stamp_s in enumerate(gps.stamps_s):
            first = int(np.searchsorted(gps.stamps_s, stamp_s - _QUIET_S - 0.5 * _USUAL_S))
            if stamp_s - gps.stamps_s[first] < _QUIET_S - 0.5 * _USUAL_S or late[first + 1 : k + 1].any():
                continue
            far, ours = (np.linalg.norm(x[first:k] - x[k], axis=1) for x in (gps.positions, moved))
            good[k] = float(np.abs(far - ours).max()) < _JUMP_M
        good &= (gps.stamps_s >= odometry.stamps_s[0]) & (gps.stamps_s <= odometry.stamps_s[-1])
        return Track(gps.stamps_s[good], gps.positions[good])

    def measurements(self) -> Iterator[Odometry | Sightings | Control]:
        """All of it but GPS, in order of time."""
        scans = iter([*self.scans, (np.inf, np.empty((3, 0)))])
        stamp_s, trees = next(scans)
        for row, (speed, steering) in zip(self.odometry, self.twists, strict=True):
            while stamp_s <= row[0]:
                yield _sightings(stamp_s, trees)
                stamp_s, trees = next(scans)
            yield Odometry(_ns(row[0]), (row[1], row[2], row[3]), _twist_covariance(speed, steering))
        yield Control("end")


def read_drive(folder: Path) -> Drive:
    """Read the recording. Raises ``datasets.Absent``."""
    datasets.check(folder)
    recorded = loadmat(folder / "VictoriaParkSinSincronizar.mat")
    stamps_s = recorded["time"].ravel()
    speed, steering = recorded["u"]
    speed = speed / (1.0 - np.tan(steering) * _WHEEL_M / _AXLES_M)
    scans = list(zip(recorded["TLsr"].ravel().tolist(), recorded["zt"].ravel(), strict=True))
    gps = loadmat(folder / "aa3_gpsx.mat")
    fixes = np.column_stack([gps["Lo_m"].ravel(), gps["La_m"].ravel()])
    odometry = np.column_stack([stamps_s, dead_reckoning(stamps_s, speed, steering)])
    return Drive(odometry, np.column_stack([speed, steering]), scans, Track(gps["timeGps"].ravel() * 1e-3, fixes))


def dead_reckoning(stamps_s: Array, speed: Array, steering: Array) -> Array:
    """Poses (n, 3) of the middle of the rear axle; each speed and steering hold until the next."""
    dt = np.diff(stamps_s)
    turned = np.cumsum(np.r_[0.0, speed[:-1] * np.tan(steering[:-1]) / _AXLES_M * dt])
    middle = 0.5 * (turned[1:] + turned[:-1])
    steps = (speed[:-1] * dt)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), turned])


def _twist_covariance(speed: float, steering: float) -> tuple[float, ...]:
    """Of speed, sideways speed and rate of turn, from the steering's error."""
    turn = speed / (_AXLES_M * np.cos(steering) ** 2) * _STEERING_RAD
    rate = speed * np.tan(steering) / _AXLES_M * _SPEED_PART
    sigmas = np.array([_SPEED_PART * speed, _STEERING_RAD * speed, np.hypot(turn, rate)])
    return tuple(np.diag(sigmas**2).ravel().tolist())


def _sightings(stamp_s: float, trees: Array) -> Sightings:
    out = []
    for distance, bearing, diameter in trees.T.tolist():
        variance = RANGE_M**2 + (TRUNK_PART * diameter) ** 2
        ahead = bearing - 0.5 * np.pi
        covariance = (variance, 0.0, 0.0, BEARING_RAD**2)
        out.append(Sighting("", "range_bearing", (distance, ahead), covariance, LASER))
    return Sightings(_ns(stamp_s), "trees", tuple(out))


def _ns(stamp_s: float) -> int:
    return round(stamp_s * 1e9)


def run(drive: Drive, more: Mapping[str, Any] | None = None) -> GraphSlam:
    """The pipeline after the whole drive, with more settings than those above."""
    slam = GraphSlam(Config.from_mapping({**_SETTINGS, **(more or {})}))
    for m in drive.measurements():
        slam.process(m)
    slam.process(Control("optimize"))
    return slam


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=datasets.PARK, metavar="FOLDER")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="set a parameter")
    table.add_write(parser)
    args = parser.parse_args()
    drive = read_drive(args.folder)
    begun_s = time.process_time()
    slam = run(drive, dict(text.split("=", 1) for text in args.set))
    cpu_s, fixes, view = time.process_time() - begun_s, drive.quiet_fixes(), slam.view
    estimate = Track.of_laser(view.sighting_poses.stamps_ns * 1e-9, view.sighting_trajectory())
    rows = list[table.Row]()
    for name, path in ((f"estimate {' '.join(args.set)}".strip(), estimate), ("odometry", drive.path_of_odometry())):
        error = judge.distances(path.at(fixes.stamps_s), fixes.positions)
        quantiles = np.percentile(error, [50, 95]).tolist()
        rms = float(np.sqrt(np.mean(error**2)))
        rows.append({"path": name, "median (m)": quantiles[0], "rms (m)": rms, "95 % within (m)": quantiles[1]})
    note = (
        f"{len(fixes.stamps_s)} of {len(drive.gps.stamps_s)} fixes, {len(view.landmarks)} landmarks, {cpu_s:.0f} s CPU"
    )
    table.finish("victoria_park", rows, write=args.write, note=note)


if __name__ == "__main__":
    main()
