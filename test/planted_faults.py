"""Faults planted into recordings, and how many of them ``graph_slam check`` finds under their names.

``PYTHONPATH=test python test/planted_faults.py [--quick] [--seconds N] BAG ...`` prints a line for each; without a
recording, of two simulated ones. A recording needs /ground_truth, by which landmarks are moved.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.from_msg import own_decoder
from graph_slam_ros.runs.check import check
from graph_slam_ros.tools.simulation import Drive, Fault, put_faults, simulate, write_bag
from graph_slam_ros.tools.simulation.drive import Sightings
from graph_slam_ros.tools.simulation.recording import moved_from

TRUTH = "/ground_truth"


class Places:
    """Where landmarks are, and how the robot points, by the truth of a recording."""

    def __init__(self, drive):
        decode = own_decoder("geometry_msgs/msg/PoseStamped")
        truth = [decode(m.content) for m in drive.messages if m.topic == TRUTH]
        self.stamps = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in truth])
        at = np.array([(p.position.x, p.position.y, p.orientation.z, p.orientation.w) for p in (m.pose for m in truth)])
        self.x, self.y = at[:, 0], at[:, 1]
        self.heading = np.unwrap(2.0 * np.arctan2(at[:, 2], at[:, 3]))
        found = {}
        middle = np.median([m.stamp_ns for m in drive.landmarks])
        for m in drive.landmarks:
            seen, (x, y, heading) = Sightings(m), self.pose(m.stamp_ns)
            c, s = np.cos(heading), np.sin(heading)
            for name, p in zip(seen.ids, seen.points, strict=True):
                if name:
                    at = x + c * p[0] - s * p[1], y + s * p[0] + c * p[1]
                    found.setdefault(name, []).append((m.stamp_ns > middle, *at))
        self.middle = middle
        self.at = {name: np.median([one[1:] for one in rows], axis=0) for name, rows in found.items()}
        self.times = {name: len(rows) for name, rows in found.items()}
        self.on_both = {n: min(sum(r[0] for r in rows), sum(not r[0] for r in rows)) for n, rows in found.items()}

    def pose(self, stamp_ns):
        return (np.interp(stamp_ns, self.stamps, row) for row in (self.x, self.y, self.heading))

    def two(self, times):
        """The landmark that is seen most often, and the next that is far from it."""
        order = sorted(times, key=lambda name: -times[name])
        first = order[0]
        far = [n for n in order[1:] if np.linalg.norm(self.at[n] - self.at[first]) > 1.5]
        if not far or times[far[0]] < 12:
            raise GraphSlamError("no two landmarks are seen often enough")
        return first, far[0]


def reused(drive):
    first, second = (places := Places(drive)).two(places.times)
    for m in drive.landmarks:
        seen = Sightings(m)
        if not {first, second} <= set(seen.ids):  # both at once would be a conflict, which is refused
            seen.ids = [first if name == second else name for name in seen.ids]
            seen.store()


def exchanged(drive):
    first, second = (places := Places(drive)).two(places.on_both)
    other = {first: second, second: first}
    for m in drive.landmarks:
        if m.stamp_ns > places.middle:
            seen = Sightings(m)
            seen.ids = [other.get(name, name) for name in seen.ids]
            seen.store()


def displaced(drive):
    first, _ = (places := Places(drive)).two(places.on_both)
    for m in drive.landmarks:
        seen = Sightings(m)
        if m.stamp_ns > places.middle and first in seen.ids:
            *_, heading = places.pose(m.stamp_ns)
            c, s = np.cos(heading), np.sin(heading)
            k = seen.ids.index(first)
            seen.points[k, :2] += np.array([[c, s], [-s, c]]) @ [1.6, 1.2]
            seen.store()


def six_moved(drive):
    """Landmarks of which six stand elsewhere from the middle on, each by its own way."""
    places = Places(drive)
    names = sorted(places.on_both, key=lambda name: -places.on_both[name])[:6]
    if len(names) < 6 or places.on_both[names[-1]] < 6:
        raise GraphSlamError("fewer than six landmarks are seen often enough")
    angles = np.arange(6.0)
    for m in drive.landmarks:
        seen = Sightings(m)
        if m.stamp_ns > places.middle and set(names) & set(seen.ids):
            *_, heading = places.pose(m.stamp_ns)
            for k, name in enumerate(seen.ids):
                if name in names:
                    angle = angles[names.index(name)] - heading
                    seen.points[k, :2] += 2.0 * np.array([np.cos(angle), np.sin(angle)])
            seen.store()


def carried(drive):
    """Odometry that notices nothing of the part of the drive from half to 0.6."""
    poses = drive.poses
    first, last = len(poses) // 2, round(0.6 * len(poses))
    moved = moved_from(poses, last, tuple(poses[first].tolist()))
    moved[first:last] = poses[first]
    drive.poses = moved


def echoes(drive):
    """Sightings of which one in twenty is too far away."""
    rng = np.random.default_rng(1)
    for m in drive.landmarks:
        seen = Sightings(m)
        for k in np.flatnonzero(rng.random(len(seen.ids)) < 0.05):
            seen.points[k] *= 1.0 + rng.uniform(1.0, 5.0) / np.linalg.norm(seen.points[k])
        seen.store()


def mirrored(drive):
    drive.poses = drive.poses * [1.0, -1.0, *np.ones(5)]


def jumped(drive):
    poses = drive.poses
    at = len(poses) // 2
    drive.poses = moved_from(poses, at, se3.compose(tuple(poses[at].tolist()), (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))


def of(*texts):
    faults = [Fault.parsed(text) for text in texts]
    return lambda drive: put_faults(drive, faults, 1)


FAULTS = {
    "landmark clock +100 ms": (of("clock_offset:seconds=0.1"), "clock_offset"),
    "landmark clock -100 ms": (of("clock_offset:seconds=-0.1"), "clock_offset"),
    "landmark clock +400 ms": (of("clock_offset:seconds=0.4"), "clock_offset latency"),
    "landmark clock set by 200 ms": (of("clock_offset:seconds=0.2,begin=0.5"), "clock_jump"),
    "landmark clock set by -400 ms": (of("clock_offset:seconds=-0.4,begin=0.5"), "clock_jump"),
    "landmarks by uptime": (of("clock_offset:seconds=-1e9"), "clock_domains no_overlap"),
    "zero stamps": (of("zero_stamps"), "zero_stamp"),
    "odometry recorded twice": (of("recorded_twice"), "duplicates"),
    "odometry out of order by 0.2 s": (of("out_of_order"), "out_of_order"),
    "clock set back by 30 s": (of("clock_set_back"), "time_jump"),
    "a twentieth of odometry lost": (of("missing:what=odometry,begin=0.33,lasting=0.05"), "gap"),
    "odometry at 2 Hz": (of("slow_odometry"), "slow_odometry"),
    "odometry scaled 1.05": (of("wrong_scale:distance=1.05"), "odometry_scale"),
    "odometry scaled 0.9": (of("wrong_scale:distance=0.9"), "odometry_scale"),
    "track width 8 % wrong": (of("wrong_scale:distance=1.0,turn=1.08"), "turn_scale"),
    "turn rate mirrored": (of("wrong_scale:distance=1.0,turn=-1.0"), "mirrored"),
    "twist mirrored, pose right": (of("wrong_twist:angular=-1.0"), "twist_scale"),
    "twist in degrees": (of("wrong_twist:angular=57.29578"), "twist_scale"),
    "two publishers of odometry": (of("other_publisher"), "two_publishers"),
    "odometry in millimetres": (of("wrong_scale:distance=1000.0"), "units"),
    "position of odometry mirrored, turns right": (mirrored, "mirrored"),
    "pose in feet, twist in metres": (of("wrong_scale:distance=3.28", "wrong_twist:linear=0.3049"), "units"),
    "twist in the odom frame": (of("wrong_twist:axes=odom"), "twist_frame"),
    "mount turned 5 degrees": (of("wrong_mount:yaw_deg=5.0"), "mount_yaw"),
    "mount turned -10 degrees": (of("wrong_mount:yaw_deg=-10.0"), "mount_yaw"),
    "sensor 0.3 m to the left of its mount": (of("wrong_mount:yaw_deg=0.0,y_m=0.3"), "mount_place"),
    "sensor 0.4 m behind its mount": (of("wrong_mount:yaw_deg=0.0,x_m=-0.4"), "mount_place"),
    "knocked by 10 degrees half-way": (of("wrong_mount:yaw_deg=10.0,begin=0.5"), "mount_moved"),
    "mount turned 180 degrees": (of("wrong_axes:how=backwards"), "axes"),
    "bearings mirrored": (of("wrong_axes:how=mirrored"), "mirrored"),
    "x and y exchanged": (of("wrong_axes:how=exchanged"), "axes mirrored"),
    "optical frame called base_link": (of("wrong_axes:how=optical"), "axes"),
    "landmarks in millimetres": (of("wrong_units"), "units"),
    "landmark sigma 1e-6": (of("tiny_covariance"), "noise_zero"),
    "sensor frame without TF": (of("wrong_frames"), "frame_unlinked"),
    "sensor frame with two parents": (of("two_parents"), "two_parents"),
    "sightings given in odom": (of("wrong_frames:landmarks=odom"), "seen_in_fixed_frame"),
    "twist sigma 1e-6": (of("twist_variance:variance=1e-12"), "covariance_tiny"),
    "twist variance 1000": (of("twist_variance:variance=1000.0"), "covariance_useless"),
    "negative variance": (of("twist_variance:variance=-1.0"), "covariance_not_positive_definite"),
    "noise 8 times its covariance": (of("noisy"), "over_confident"),
    "two landmarks share an identity": (reused, "id_reused"),
    "two identities exchanged half-way": (exchanged, "ids_exchanged"),
    "a landmark moved by 2 m": (displaced, "landmark_moved"),
    "identities of tracks": (of("track_ids"), "seen_once"),
    "identities at random": (of("random_ids"), "unrelated ids_unsure outliers"),
    "30 % of ids wrong": (of("random_ids:rate=0.3"), "outliers ids_unsure"),
    "odometry stands": (of("wrong_scale:distance=0,turn=0"), "static"),
    "odometry jumps 1 m": (jumped, "odometry_jumps"),
    "odometry restarted": (of("restarted"), "odometry_reset"),
    "odometry corrected every 20 s": (of("corrected"), "corrected"),
    "odometry in frame map": (of("wrong_frames:odometry=map,landmarks=kept"), "odometry_in_map"),
    "all ids new each 15 s": (of("new_ids"), "no_closure"),
    "all ids new after 60 s": (of("new_ids:seconds=60"), "ids_renewed no_closure"),
    "nothing seen after a quarter": (of("missing:begin=0.25"), "silent"),
    "NaN in odometry": (of("not_a_number"), "nonfinite"),
    "a tenth of the drive": (of("missing:what=all,begin=0.1"), "not_observable"),
    "file cut off": (of("cut_off"), "damaged"),
    "no landmarks": (of("missing"), "no_landmarks"),
    "no odometry": (of("missing:what=odometry"), "no_odometry"),
    "landmarks of another definition": (of("unreadable"), "input_unused"),
    "an id twice in a message": (of("same_ids"), "id_twice"),
    "an id for each sighting": (of("track_ids:sightings=1"), "seen_once no_parallax"),
    "wheels slip for a twentieth": (of("wrong_scale:distance=1.5,begin=0.5,lasting=0.05"), "odometry_slips"),
    "carried for a tenth": (carried, "odometry_slips"),
    "six landmarks moved by 2 m": (six_moved, "map_breaks landmark_moved"),
    "5 % of sightings too far": (echoes, "outliers"),
}
"""By name: what is planted, and the codes of which one is to be found."""


def planted(bag, target, name):
    drive = Drive(bag)
    FAULTS[name][0](drive)
    drive.write(target)
    return target


def said(bag, name, folder, *, quick):
    """What comes of a planted fault: the finding, its value, and whether it stays with its settings; prints a line."""
    codes = FAULTS[name][1].split()
    try:
        file = planted(bag, folder / "faulty.mcap", name)
    except GraphSlamError as error:
        print(f"{bag.stem}, {name}: not possible: {error}", flush=True)
        return True, True
    found = check(file, quick=quick).findings
    hits = [one for one in found if one.code in codes]
    stays = [
        one.code
        for one in hits
        if one.settings
        and one.code in {f.code for f in check(file, dict(map(parse_setting, one.settings)), quick=quick).findings}
    ]
    others = sorted({f.code for f in found if f.severity != "note"} - set(codes))
    values = ", ".join(f"{one.code} {one.value:.4g} {one.unit}" for one in hits) or "MISSED"
    print(f"{bag.stem}, {name}: {values}; others: {others}; not mended: {stays}", flush=True)
    return bool(hits), not stays


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seconds", type=float, default=300.0, metavar="N", help="of the beginning of each recording")
    parser.add_argument("--only", action="append", metavar="NAME")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bags = [Path(folder) / bag.name for bag in args.bags]
        for bag, part in zip(args.bags, bags, strict=True):
            drive = Drive(bag)
            end_ns = drive.messages[0].log_ns + round(args.seconds * 1e9)
            drive.messages = [m for m in drive.messages if m.log_ns <= end_ns]
            drive.write(part)
        if not bags:
            for name, options in (("tags", {"aisles": 2}), ("range_bearing", {"aisles": 3, "sensor": "range_bearing"})):
                bags.append(Path(folder) / f"{name}.mcap")
                write_bag(simulate("warehouse", 3, laps=2, **options), bags[-1])
        names = args.only or list(FAULTS)
        rows = [said(bag, name, Path(folder), quick=args.quick) for bag in bags for name in names]
    missed, unmended = (sum(not row[k] for row in rows) for k in (0, 1))
    print(f"RELIABILITY planted_faults tried={len(rows)} found={len(rows) - missed} unmended={unmended}", flush=True)
    return 1 if missed > 0.05 * len(rows) or unmended else 0


if __name__ == "__main__":
    sys.exit(main())
