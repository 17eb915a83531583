"""Faults of a map that was read: parts of it that contradict one another."""

import math
from typing import Any

import numpy as np

from graph_slam_ros.graph.vertices import GROUPS
from graph_slam_ros.slam.snapshot import MapSnapshot


def fault_of(state: MapSnapshot) -> str:
    """Return the first fault of a map, in words; empty if there is none."""
    graph = state.graph
    kinds = [graph.kinds[code] for code in graph.kind.values.tolist()]
    pose = next((kind for kind in kinds if kind in GROUPS), None)

    def are_numbers(several: tuple[Any, ...]) -> bool:
        return all(isinstance(x, int | float) and math.isfinite(x) for x in several)

    def is_instant(stamp_ns: Any, at: tuple[Any, ...]) -> bool:
        return is_index(stamp_ns, 2**63) and are_numbers(at) and pose is not None and len(at) == pose.size

    for k, one in enumerate(state.keyframes):
        fits = is_index(one.vertex, len(kinds)) and kinds[one.vertex] is pose
        if not (fits and is_instant(one.stamp_ns, one.T_odom_base)):
            return f"keyframe {k} is not valid"
    for k, seen in enumerate(state.sighting_poses):
        is_of_one = is_index(seen.keyframe, state.keyframe_count) and seen.keyframe >= state.first_keyframe
        if not (is_of_one and is_instant(seen.stamp_ns, seen.T_keyframe_base)):
            return f"sighting {k} is not valid"
    for name, mark in state.landmarks.items():
        if not all(map(is_index, (mark.vertex, mark.sightings), (len(kinds), 2**31))):
            return f"landmark {name} is not valid"
        if not all(is_index(ns, 2**63) for ns in (mark.first_seen_ns, mark.last_seen_ns)):
            return f"a stamp of landmark {name} is not valid"
        is_sized = is_index(mark.sized, 2**31) and are_numbers((mark.size,)) and mark.size >= 0.0
        if not (isinstance(mark.sort, str) and is_sized):
            return f"the class or size of landmark {name} is not valid"
    if not all(is_index(one, state.keyframe_count) for one in (*state.segments, *state.drives)):
        return "a segment or a drive begins where no keyframe is"
    if not (state.used_ns is None or is_index(state.used_ns, 2**63)) or not isinstance(state.source, str):
        return "what is said of the odometry that was used last is not valid"
    if state.datum and not (len(state.datum) == 3 and are_numbers(state.datum)):
        return "the datum is not valid"
    if (gyro := state.gyro_bias) is not None:
        is_one = len(gyro.bias) == len(gyro.variance) and are_numbers((*gyro.bias, *gyro.variance))
        if not is_one or min(gyro.variance, default=-1.0) < 0.0 or not is_index(gyro.stamp_ns, 2**63):
            return "the bias of the gyro is not valid"
    if len(state.ledger) > graph.edge_count:
        return f"{len(state.ledger)} verdicts on {graph.edge_count} edges"
    return "" if np.isfinite(state.values).all() else "an estimate is not finite"


def is_index(one: Any, count: int) -> bool:
    """Return whether a value is a whole number from 0 up to a count."""
    return isinstance(one, int) and not isinstance(one, bool) and 0 <= one < count
