"""Checks of a gyro that is used as part of odometry, against odometry's turns."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graph_slam_ros.check.columns import Columns, TopicColumns
from graph_slam_ros.check.contradictions import turned_mount
from graph_slam_ros.check.odometry import SCALE, fitted
from graph_slam_ros.check.pairs import poses_at
from graph_slam_ros.check.times import MOST_LATE_S, offset_setting
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.formats.parameters import assignment
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.typing import Array, Numbers

_WINDOW_NS, _LEAST_WINDOWS, _LEAST_SAMPLES = 1_000_000_000, 20, 3  # in which both turn, how many, and samples in each
_TURNING_RAD, _LEAST_TURNING = 0.1, 10  # windows in which the robot turns
_GROSS, _BIAS_SIGMAS = 0.4, 3.0  # of a factor: the track width is no cause
_UNEXPLAINED = 0.5  # part of the turns, or of a wrong heading: more is left where another cause is
_OF_NOTHING = 0.2  # of odometry's turns: a gyro that measures none of them, but others
_EITHER = ": the track width is wrong, or the scale of the gyro"
_OF_A_HEADING = ("id_reused", "ids_unsure", "landmark_moved", "map_breaks", "outliers")  # where that is wrong
_GRAVITY_M_S2, _LEAST_LATE_S = 9.81, 0.1  # _LEAST_LATE_S: between two that are tried there are two steps
_MOST_BIAS = 1.0  # [rad/s] that gyro.bias_sigma may be


def check_gyro(c: Columns) -> Iterator[Finding]:
    """Scale, sign, axis and bias of a gyro: both must turn alike over each second."""
    topic = c.topic_of(c.config.gyro_input)
    odometry, gyro = _turns(c)
    if topic is None or len(gyro) < _LEAST_WINDOWS:
        return
    factor, bias, left = _line(odometry, gyro)
    limit = _BIAS_SIGMAS * c.config.gyro.bias_sigma
    is_turning = np.abs(odometry) > _TURNING_RAD
    if np.count_nonzero(is_turning) >= _LEAST_TURNING:
        size = max(1.0, abs(factor)) * float(np.median(np.abs(odometry[is_turning])))
        unexplained = float(np.median(np.abs(left[is_turning]))) / size
        most = _UNEXPLAINED if abs(factor) > _GROSS else _OF_NOTHING
        if (unexplained > most or abs(factor - 1.0) > SCALE) and (late_s := _late_s(c)):
            when = f"{abs(late_s) * 1e3:.0f} ms {'later' if late_s < 0.0 else 'earlier'} than stamped"
            mend = (offset_setting(c, c.config.gyro_input, -late_s),)
            text = f"its gyro turns as odometry does {when}: correct its clock"
            yield topic.finding("clock_offset", "warning", -late_s, _LEAST_LATE_S, "s", text, settings=mend)
            return
        if unexplained > most:
            text = f"odometry's turns do not explain {unexplained:.0%} of those of the gyro"
            yield topic.finding("gyro_unrelated", "warning", unexplained, most, "part", text)
            return
        if abs(factor - 1.0) > SCALE:
            yield _scale(c, factor, topic)
            if abs(factor - 1.0) >= _GROSS:  # its offset means nothing
                return
    if abs(bias) > limit:
        text = f"its gyro turns by {bias:.3f} rad/s where odometry does not"
        settings = (assignment("gyro.bias_sigma", round(abs(bias), 3)),) if abs(bias) < _MOST_BIAS else ()
        yield topic.finding("gyro_bias", "warning", bias, limit, "rad/s", text, settings=settings)


def _late_s(c: Columns) -> float:
    """Return how much too late the gyro is stamped, where odometry's turns are its own only then; else 0."""
    tried_s = np.arange(-MOST_LATE_S, MOST_LATE_S + 0.01, _LEAST_LATE_S / 2.0)
    turns = (_turns(replace(c, gyro_ns=c.gyro_ns - round(float(late_s) * 1e9))) for late_s in (0.0, *tried_s))
    now, *left = (1.0 - abs(float(np.corrcoef(*both)[0, 1])) for both in turns)
    late_s = float(tried_s[int(np.argmin(left))])
    return late_s if min(left) < 0.2 * now and abs(late_s) >= _LEAST_LATE_S else 0.0


def _turns(c: Columns, rates: Array | None = None) -> tuple[Array, Array]:
    """The turns [rad] about the robot's z over each second, by odometry and by the gyro, or by other rates of it."""
    path_ns, path = c.path_ns, c.path
    stamp_ns, first = np.unique(c.gyro_ns, return_index=True)
    if len(path_ns) < 2 or len(stamp_ns) < 2:
        return np.empty(0), np.empty(0)
    rate, began_ns = (c.gyro if rates is None else rates)[first], max(path_ns[0], stamp_ns[0])
    begins = began_ns + np.unique((stamp_ns - began_ns) // _WINDOW_NS) * _WINDOW_NS  # none in a gap of years
    begins = begins[(begins >= began_ns) & (begins + _WINDOW_NS < min(path_ns[-1], stamp_ns[-1]))]
    edges = np.stack([begins, begins + _WINDOW_NS])
    motion = se3.between(*(tuple(poses_at(edge, path_ns, path).T) for edge in edges))
    odometry = so3.log(tuple(motion[3:]))[2] * c.config.odometry.turn_factor
    step_s = np.diff(stamp_ns) * 1e-9
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step_s)])
    gyro = np.diff(np.interp((edges - began_ns) * 1e-9, (stamp_ns - began_ns) * 1e-9, angle), axis=0)[0]
    is_there = np.diff(np.searchsorted(stamp_ns, edges), axis=0)[0] >= _LEAST_SAMPLES
    is_there &= np.diff(np.searchsorted(path_ns, edges), axis=0)[0] >= _LEAST_SAMPLES
    return np.asarray(odometry)[is_there], gyro[is_there]


def _line(x: Array, y: Array) -> tuple[float, float, Array]:
    """Robust slope and offset of y over x, and what they leave."""
    rows = np.stack([x, np.ones(len(x))], axis=1)
    line, _ = fitted(rows, y)
    return float(line[0]), float(line[1]), y - rows @ line


def _scale(c: Columns, factor: float, topic: TopicColumns) -> Finding:
    text = f"its gyro turns {factor:.3g} times as much as odometry"
    settings: tuple[str, ...] = ()
    if abs(factor - 1.0) < _GROSS:
        text += _EITHER
        settings = (assignment("odometry.turn_factor", round(c.config.odometry.turn_factor * factor, 4)),)
    elif abs(factor + 1.0) < _GROSS:
        text += ": its sensor is upside down, or odometry turns the wrong way"
        if c.config.world.dimensions == 2 and c.T_base_gyro is not None:  # in space x or y points the other way, too
            R_base_gyro = se3.rotation(c.T_base_gyro)  # turned over about the robot's x
            x, y, z, w = so3.compose(so3.compose(so3.inverse(R_base_gyro), (1.0, 0.0, 0.0, 0.0)), R_base_gyro)
            settings = turned_mount(c.config.gyro_input, c.gyro_frame, c.T_base_gyro, (0.0, 0.0, 0.0, x, y, z, w))
    elif abs(factor) < _GROSS:
        text += ": another of its axes points upwards, it sends zeros, or odometry turns too much"
        settings = _upright(c) if c.config.world.dimensions == 2 else ()
    elif abs(factor) > 1.0 / _GROSS:
        text += ": are these degrees?"
        settings = (assignment(f"{c.config.gyro_input}.use", "none"),)
    severity: Severity = "warning" if abs(factor - 1.0) < _GROSS else "error"
    return topic.finding("gyro_scale", severity, factor, 1.0 + SCALE, "times", text, settings=settings)


def upright(felt: Numbers) -> tuple[float, float]:
    """Roll and pitch [rad] of a sensor that feels this acceleration in the mean; zeros where that is no gravity."""
    x, y, z = felt
    is_gravity = 0.5 < math.hypot(x, y, z) / _GRAVITY_M_S2 < 1.5
    return (math.atan2(y, z), math.atan2(-x, math.hypot(y, z))) if is_gravity else (0.0, 0.0)


def _upright(c: Columns) -> tuple[str, ...]:
    """The settings by which gravity is upright, if the robot then turns as odometry says. A gyro needs no yaw."""
    turned = se3.from_xyz_rpy((0.0, 0.0, 0.0, *upright(tuple(c.felt[:, 3:].mean(axis=0))), 0.0))
    odometry, gyro = _turns(c, c.felt[:, :3] @ so3.matrix(se3.rotation(turned))[2])
    if c.T_base_gyro is None or abs(_line(odometry, gyro)[0] - 1.0) >= _GROSS:
        return ()
    return turned_mount(c.config.gyro_input, c.gyro_frame, (*se3.position(c.T_base_gyro), 0.0, 0.0, 0.0, 1.0), turned)


def of_gyro_or_wheels(findings: list[Finding], gyro_input: str) -> list[Finding]:
    """Findings in which landmarks have decided whether a gyro or odometry turns by a wrong amount.

    The heading is that of the gyro. If that turns k times as much, and the robot 1 / k times, odometry is right.
    """
    gyro = next((one for one in findings if one.code == "gyro_scale" and one.severity == "warning"), None)
    turn = next((one for one in findings if one.code == "turn_scale"), None)
    if gyro is None or turn is None:
        return findings
    rest = [one for one in findings if one is not turn]
    if abs((1.0 + turn.value) * gyro.value - 1.0) > _UNEXPLAINED * abs(turn.value):
        return rest  # both are wrong: the gyro's finding says by how much they differ
    text = f"{gyro.text.removesuffix(_EITHER)}: landmarks agree with odometry, so the scale of the gyro is wrong"
    mended = replace(gyro, text=text, settings=(assignment(f"{gyro_input}.use", "none"),))
    return [mended if one is gyro else one for one in rest if one.code not in _OF_A_HEADING]
