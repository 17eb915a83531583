"""A warehouse: a robot drives aisle after aisle and reads tags on racks and walls, each with its orientation."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Sighting
from graph_slam_ros.tools.simulation.options import option, random
from graph_slam_ros.tools.simulation.recording import (
    CORRELATION_TIME,
    SIGMA_SIDEWAYS,
    SIGMA_SPEED,
    SIGMA_TURN,
    Recording,
    VelocityNoise,
    drive,
)
from graph_slam_ros.tools.simulation.sensing import KINDS, RangeBearing, sightings
from graph_slam_ros.typing import Array, Numbers

SPEED_M_S = 1.0
TICK_NS = 20_000_000  # odometry at 50 Hz
OBSERVE_EVERY = 8  # camera at 6.25 Hz
AISLE_SPACING_M = 4.0
RACK_DEPTH_M = 1.6
TAG_SPACING_M = 2.0
CORNER_RADIUS_M = 1.2
CROSS_AISLE_M = 2.0  # from the ends of the racks to the middle of the cross aisle
WALL_M = 3.5  # from the ends of the racks to the wall
MAX_SLANT_RAD = np.deg2rad(65.0)  # a tag seen at a flatter angle is not read
CAMERA = RangeBearing(0.05, np.deg2rad(0.5), 5.0, np.deg2rad(100.0))
SIGMA_YAW_RAD = np.deg2rad(2.0)
START = (0.0, -CROSS_AISLE_M, 0.5 * np.pi)


def simulate(
    seed: int,
    aisles: int = option(3, "aisles, 4 m apart", "", 2, 100),
    aisle_m: float = option(12.0, "length of an aisle", "m", 4, 1000),
    laps: int = option(
        2, "how often all aisles are driven; with an odd number of them, from the other end each time", "", 1, 1000
    ),
    sensor: str = option("pose", "what the sensor measures of a tag", choices=("pose", *KINDS)),
    sigma_speed_m_s: float = SIGMA_SPEED,
    sigma_sideways_m_s: float = SIGMA_SIDEWAYS,
    sigma_turn_rad_s: float = SIGMA_TURN,
    correlation_time_s: float = CORRELATION_TIME,
) -> Recording:
    """Drive all aisles in a serpentine, return to the first and enter it again.

    The robot drives at 1 m/s, with odometry at 50 Hz; tags are read at 6.25 Hz.
    """
    rng = random(seed)
    names, tags = _tags(aisles, aisle_m)

    def observe(T_world_base: Numbers) -> list[Sighting]:
        at = CAMERA.visible(T_world_base, tags[:, :2])
        at = at[_is_facing(T_world_base, tags[at])]
        seen = [names[k] for k in at]
        if sensor != "pose":
            return sightings(seen, sensor, *CAMERA.measure(rng, T_world_base, tags[at, :2], sensor))
        positions, covariance = CAMERA.measure(rng, T_world_base, tags[at, :2], "position")
        yaw = se2.wrap(tags[at, 2] - T_world_base[2] + SIGMA_YAW_RAD * rng.standard_normal(len(at)))
        full = np.zeros((len(at), 3, 3))
        full[:, :2, :2] = covariance
        full[:, 2, 2] = SIGMA_YAW_RAD**2
        poses = np.column_stack([positions, yaw])
        in_tangent = [PLANAR.in_tangent(tuple(z), c) for z, c in zip(poses.tolist(), full, strict=True)]
        return sightings(seen, "pose", poses, np.array(in_tangent).reshape(-1, 3, 3))

    twists = follow(_route(aisles, aisle_m, laps), CORNER_RADIUS_M, SPEED_M_S, TICK_NS * 1e-9)
    noise = VelocityNoise((sigma_speed_m_s, sigma_sideways_m_s, sigma_turn_rad_s), correlation_time_s)
    landmarks = dict(zip(names, (tuple(tag) for tag in tags.tolist()), strict=True))
    return drive(rng, START, twists, TICK_NS, noise, observe, OBSERVE_EVERY, landmarks)


def _tags(aisles: int, aisle_m: float) -> tuple[list[str], Array]:
    """Names and poses (m, 3): along the racks, on their ends, and on the walls that aisles lead to.

    A tag's x axis points at the reader, out of the rack or wall.
    """
    south, north = -0.5 * np.pi, 0.5 * np.pi
    count = max(1, int(aisle_m // TAG_SPACING_M))
    along = ((np.arange(count) + 0.5) * (aisle_m / count)).tolist()
    tags: dict[str, se2.Pose] = {}
    for rack in range(aisles + 1):
        x = (rack - 0.5) * AISLE_SPACING_M
        tags |= {f"rack{rack}w{k}": (x - 0.5 * RACK_DEPTH_M, y, -np.pi) for k, y in enumerate(along)}
        tags |= {f"rack{rack}e{k}": (x + 0.5 * RACK_DEPTH_M, y, 0.0) for k, y in enumerate(along)}
        tags |= {f"rack{rack}s": (x, 0.0, south), f"rack{rack}n": (x, aisle_m, north)}
    for aisle in range(aisles):
        x = aisle * AISLE_SPACING_M
        tags |= {f"wall{aisle}s": (x, -WALL_M, north), f"wall{aisle}n": (x, aisle_m + WALL_M, south)}
    return list(tags), np.array(list(tags.values()))


def _is_facing(T_world_base: Numbers, tags: Array) -> NDArray[np.bool_]:
    toward = np.arctan2(T_world_base[1] - tags[:, 1], T_world_base[0] - tags[:, 0])
    return np.asarray(np.abs(se2.wrap(toward - tags[:, 2])) <= MAX_SLANT_RAD)


def _route(aisles: int, aisle_m: float, laps: int) -> Array:
    """Waypoints (n, 2): a serpentine for each lap, then a cross aisle and the first aisle again."""
    south, north = -CROSS_AISLE_M, aisle_m + CROSS_AISLE_M
    points = [START[:2]]
    for _ in range(laps):
        for aisle in range(aisles):
            y = points[-1][1]
            points += [(aisle * AISLE_SPACING_M, y), (aisle * AISLE_SPACING_M, south if y == north else north)]
        points.append((0.0, points[-1][1]))
    points.append((0.0, south if points[-1][1] == north else north))
    return np.array([p for k, p in enumerate(points) if k == 0 or p != points[k - 1]])


def follow(waypoints: Array, radius_m: float, speed_m_s: float, dt_s: float) -> Array:
    """Twists (n, 3) of a drive along right-angled waypoints (m, 2) at constant speed, corners rounded."""
    legs = np.diff(waypoints, axis=0)
    headings = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    pieces = list(_pieces(np.hypot(legs[:, 0], legs[:, 1]), headings, radius_m))
    distance = np.cumsum([0.0, *(length for length, _ in pieces)])
    heading = np.cumsum([headings[0], *(turn for _, turn in pieces)])
    ticks = int(distance[-1] / (speed_m_s * dt_s))
    at_tick = np.interp(speed_m_s * dt_s * np.arange(ticks + 1), distance, heading)
    return np.column_stack([np.full(ticks, speed_m_s), np.zeros(ticks), np.diff(at_tick) / dt_s])


def _pieces(lengths: Array, headings: Array, radius_m: float) -> Iterator[tuple[float, float]]:
    """Straights and arcs as (length, turn)."""
    cut = 0.0
    for k, length in enumerate(lengths.tolist()):
        turn = float(headings[k + 1] - headings[k]) if k + 1 < len(lengths) else 0.0
        next_cut = radius_m * float(np.tan(0.5 * abs(turn)))
        yield length - cut - next_cut, 0.0
        if turn:
            yield radius_m * abs(turn), turn
        cut = next_cut
