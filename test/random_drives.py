"""Random drives of robots that are wrong in more ways than one, by class."""

from dataclasses import replace

import numpy as np
from imperfect import START_NS, Faults, imperfect_drive_and_truth

from graph_slam_ros.slam import Odometry, Sightings

CLASSES = {
    "nothing wrong": {},
    "wrong calibration": {},
    "some wrong ids": {"wrong_ids": 0.05},
    "many wrong ids": {"wrong_ids": 0.2},
    "one landmark": {},
    "two alike": {},
    "a landmark that moves": {},
    "no turns": {},
    "standing": {},
    "a clock that jumps": {},
}


def random_drive(name, seed):
    """Measurements, truth and faults of one drive of a class."""
    random = np.random.default_rng([seed, list(CLASSES).index(name)])
    part = 0.0 if name == "nothing wrong" else 1.0
    faults = Faults(
        distance=1.0 + part * 0.05 * random.standard_normal(),
        turn=1.0 + part * 0.05 * random.standard_normal(),
        clock_s=float(np.clip(part * 0.1 * random.standard_normal(), -0.25, 0.25)),
        yaw=part * np.radians(5.0) * random.standard_normal(),
        **CLASSES[name],
    )
    turns = 0.0 if name == "no turns" else float(random.uniform(0.3, 0.9))
    drive, truth = imperfect_drive_and_truth(
        faults,
        seed=int(random.integers(2**31)),
        seconds=float(random.uniform(20.0, 40.0)),
        kind=str(random.choice(["range_bearing", "position"])),
        turns=turns,
    )
    middle_ns = (drive[0].stamp_ns + drive[-1].stamp_ns) // 2
    match name:
        case "one landmark":
            drive = [_only(m, {"3"}) for m in drive]
        case "two alike":
            drive = [_renamed(m, {"3": "4"}) for m in drive]
        case "a landmark that moves":
            drive = [_moving(m) for m in drive]
        case "a clock that jumps":
            jump_ns = round(random.choice([-1, 1]) * random.uniform(0.1, 0.4) * 1e9)
            drive = [_shifted(m, jump_ns if m.stamp_ns > middle_ns else 0) for m in drive]
        case "standing":
            drive = [_stopped(m, random) for m in drive]
            truth = replace(truth, poses=np.repeat(truth.poses[:1], len(truth.poses), axis=0))
    return sorted((m for m in drive if m is not None), key=lambda m: m.stamp_ns), truth, faults


def _of_sightings(m, change):
    if isinstance(m, Odometry):
        return m
    seen = tuple(s for s in map(change, m.sightings) if s is not None)
    return replace(m, sightings=seen) if seen else None


def _only(m, names):
    return _of_sightings(m, lambda s: s if s.id in names else None)


def _renamed(m, names):
    return _of_sightings(m, lambda s: replace(s, id=names.get(s.id, s.id)))


def _moving(m):
    """Landmark 5 drives away, 0.1 m/s."""
    far = 0.1 * (m.stamp_ns - START_NS) * 1e-9
    return _of_sightings(m, lambda s: replace(s, measured=(s.measured[0] + far, *s.measured[1:])) if s.id == "5" else s)


def _shifted(m, by_ns):
    return replace(m, stamp_ns=m.stamp_ns + by_ns) if isinstance(m, Sightings) else m


def _stopped(m, random):
    """The robot stands; what it sees is noise around two landmarks."""
    if isinstance(m, Odometry):
        return Odometry(m.stamp_ns, (0.0, 0.0, 0.0))
    there = {"0": (3.0, 0.2), "1": (2.0, -0.7), "2": (4.0, 1.0), "3": (3.5, 2.0)}

    def change(s):
        if s.id not in there:
            return None
        far, bearing = np.array(there[s.id]) + (0.03, 0.01) * random.standard_normal(2)
        polar = (far, bearing) if s.kind == "range_bearing" else (far * np.cos(bearing), far * np.sin(bearing))
        return replace(s, measured=tuple(map(float, polar)))

    return _of_sightings(m, change)
