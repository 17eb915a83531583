"""The history of the drive: the estimate at some moments, and the jumps of map -> odom."""

import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.formats.cdr import CdrReader
from graph_slam_ros.lie import se3
from graph_slam_ros.recordings.mcap_records import records
from graph_slam_ros.runs.journal import MAP, parts_of, read_records
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.typing import Array

MOST_FRAMES, MOST_POINTS, MOST_LANDMARKS, MOST_JUMPS = 80, 500, 300, 15
_RUN = "run"


Frame = tuple[int, Array, Array]
"""How many keyframes there were, positions (m, 3) of some of them, and of landmarks (l, 3), as they were known then."""


def frames(run: Path, saved: SavedGraph, losses: list[str]) -> list[Frame]:
    """The estimates of a map's journal, some of them where there are many; each with a part of its keyframes."""
    several = [np.array(record["values"], dtype=float) for record in read_records(run, MAP, losses, "estimate")]
    some = np.unique(np.linspace(0, len(several) - 1, min(len(several), MOST_FRAMES)).astype(int))
    width = saved.space.dimensions
    before, known = saved.slam.first_keyframe, saved.slam.keyframes.ids.tolist()
    first = np.array([saved.graph.vertex(vertex).stored.start for vertex in known])
    vertices = sorted(saved.landmarks.values())[:MOST_LANDMARKS]
    marks = np.array([saved.graph.vertex(vertex).stored.start for vertex in vertices], dtype=int)
    found = []

    def positions(values: Array, at: Array) -> Array:
        out = np.zeros((len(at), 3))
        out[:, :width] = values[at[:, None] + np.arange(width)]
        return out

    for values in (several[k] for k in some.tolist()):
        count = int(np.searchsorted(first + width, len(values), side="right"))
        if count:
            at = first[np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(int))]
            places = positions(values, at), positions(values, marks[marks + width <= len(values)])
            found.append((before + count, *places))
    return found


def corrections(run: Path, stamps_s: Array, odometry: Array, losses: list[str]) -> tuple[Array, Array, Array]:
    """Changes of ``map -> odom`` from keyframe to keyframe, as it was published.

    Returns keyframes (m,), distances (m,) [m] by which the robot was moved at each, angles (m,) [rad].

    Parameters
    ----------
    stamps_s, odometry : (n,), (n, 7) of the keyframes, ``T_odom_base``
    """
    published = list(_published(run, losses))
    if len(published) < 2:
        return np.zeros(0, dtype=int), np.zeros(0), np.zeros(0)
    stamps, poses = np.array([at for at, _ in published]) * 1e-9, np.array([pose for _, pose in published])
    at = np.clip(np.searchsorted(stamps_s, stamps - 1e-4), 0, len(stamps_s) - 1)
    fits = np.abs(stamps_s[at] - stamps) < 1e-3
    at, poses = at[fits], poses[fits]
    odom = tuple(odometry[at].T)
    T_map_odom = se3.compose(tuple(poses.T), se3.inverse(odom))
    before = tuple(number[:-1] for number in T_map_odom)
    foretold = se3.compose(before, tuple(number[1:] for number in odom))
    moved = np.stack(se3.between(foretold, tuple(poses[1:].T)), axis=1)
    angles = 2.0 * np.arctan2(np.linalg.norm(moved[:, 3:6], axis=1), np.abs(moved[:, 6]))
    keyframes: Any = at[1:]
    return keyframes, np.linalg.norm(moved[:, :3], axis=1), angles


def jumps(
    found: tuple[Array, Array, Array], entries: Sequence[Entry], changed: dict[int, list[int]]
) -> list[tuple[int, float, float, list[int]]]:
    """The largest corrections: keyframe, distance [m], angle [degrees], and the edges judged then that pulled most.

    Parameters
    ----------
    changed : by keyframe, the edges whose verdict changed there
    """
    keyframes, distances, angles = found
    came: dict[int, list[Entry]] = {}
    for e in entries:
        if e.verdict and e.is_in:
            came.setdefault(e.keyframe, []).append(e)
    out = []
    for k in np.argsort(-distances, kind="stable")[:MOST_JUMPS].tolist():
        if distances[k] <= 1e-3:
            break
        at = int(keyframes[k])
        pulled = sorted(came.get(at, ()), key=lambda e: -e.statistic)[:4]
        edges = list(dict.fromkeys([*changed.get(at, ())[:4], *(e.edge for e in pulled)]))
        out.append((at, float(distances[k]), float(angles[k]) * 180.0 / math.pi, edges))
    return out


def _published(run: Path, losses: list[str]) -> Iterator[tuple[int, tuple[float, ...]]]:
    for file in parts_of(run, _RUN):
        of_pose = -1
        for record in records(file, losses, follow=False):
            if isinstance(record, Channel) and record.topic == "/pose":
                of_pose = record.id
            elif isinstance(record, Message) and record.channel_id == of_pose:
                with suppress(struct.error):  # shorter than a pose: as if it had not come
                    reader = CdrReader(record.data)
                    stamp_ns, _ = reader.stamp_ns(), reader.text()
                    yield stamp_ns, reader.numbers("d", 7)
