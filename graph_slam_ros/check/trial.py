"""A trial of a recording: a replay in memory, then a fit of clock, mount and scales that starts at its estimate."""

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from graph_slam_ros.check.columns import Columns, SightingColumns
from graph_slam_ros.check.gyro import check_gyro
from graph_slam_ros.check.identities import at_two_places, check_moved, check_outliers, check_reused
from graph_slam_ros.check.odometry import TOGETHER, twist_factor, worst_stretch
from graph_slam_ros.check.pairs import noisier, pairs_of, poses_at
from graph_slam_ros.check.times import EARLY_S
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.formats.parameters import assignment
from graph_slam_ros.lie import se3
from graph_slam_ros.measurements.types import END, Measurement, Odometry
from graph_slam_ros.slam import Config, GraphSlam, MapView
from graph_slam_ros.slam.calibration import answers
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import Parameter
from graph_slam_ros.slam.frontend.gyro import GyroState
from graph_slam_ros.slam.levels import SIGMAS
from graph_slam_ros.slam.noise.scale import LARGEST, NoiseScale
from graph_slam_ros.typing import Array, Index

_THIN_NS, _APART_S = 80_000_000, 1.0  # between odometry, and between keyframes, of a replay that a fit begins at
_COARSE = {"solve.every_keyframes": 20, "odometry.doubt": False, "map.condense": False}  # a fit needs all keyframes
_TURN_SIGMAS = 6.0  # a wheel's noise that lasts adds up in heading, which neither sigma of a fit knows
_RECORDED_S = 5.0  # by one clock
_OF_STEP = 0.25  # of the time between two poses of odometry
# By parameter: unit, limit, and from which sigma on it is not observable.
_LIMITS = {
    "clock": ("s", 0.03, 0.05),
    "yaw": ("rad", math.radians(3.0), math.radians(3.0)),
    "x": ("m", answers.LEAST_M, np.inf),
    "y": ("m", answers.LEAST_M, np.inf),
    **dict.fromkeys(("distance", "turn", "range_factor"), ("part", 0.03, 0.05)),
    "range_offset": ("m", 0.1, np.inf),
}
_OVER_CONFIDENT, _ODOMETRY_OVER_CONFIDENT = 2.0, 6.0**0.5  # sigmas: wheels that slip now and then are no fault
_OF_A_BREAK = ("ids_unsure", "map_breaks", "landmark_moved")  # a robot that was carried has them with right ids
_LEAST_M, _LEAST_RAD, _PART, _SLIP_SIGMAS = 0.15, 0.3, 0.1, 6.0  # of a slip; _PART: of the way
_LARGE_M, _LARGE_RAD, _LARGE_SIGMAS = 0.5, 0.8, 2.0 * _SLIP_SIGMAS  # of one that is no note


def replayed(config: Config, measured: Iterable[Measurement]) -> GraphSlam:
    """The pipeline after all measurements, with fewer odometry, keyframes, solves and searches for other hypotheses.

    Its estimate is where a fit begins.
    """
    apart_s = max(config.keyframes.min_interval_s, _APART_S)
    slam = GraphSlam(config.changed(_COARSE | {"keyframes.min_interval_s": apart_s}))
    last_ns = 0
    for m in measured:
        if isinstance(m, Odometry):
            if 0 <= m.stamp_ns - last_ns < _THIN_NS:
                continue
            last_ns = m.stamp_ns
        slam.process(m)
    for event in END:
        slam.process(event)
    return slam


def _points_in_map(c: Columns, s: SightingColumns, view: MapView) -> Array:
    """(k, 3) Where each sighting puts its landmark, by the estimate at its stamp, corrected between keyframes."""
    order = np.argsort(view.keyframes.stamps_ns, kind="stable")
    estimate, own = (se3.in_space(poses).reshape(-1, 7)[order] for poses in (view.trajectory(), view.keyframes.poses))
    at_ns, stamp_ns = view.keyframes.stamps_ns[order], np.clip(s.stamp_ns, c.path_ns[0], c.path_ns[-1])
    driven = poses_at(stamp_ns, c.path_ns, c.path)
    own[:, :3] *= c.config.odometry.distance_factor
    after = np.clip(np.searchsorted(at_ns, stamp_ns), 1, len(at_ns) - 1)
    ends = []
    for k in (after - 1, after):
        since = se3.between(tuple(own[k].T), tuple(driven.T))
        ends.append(se3.compose(tuple(estimate[k].T), since))
    part = np.clip((stamp_ns - at_ns[after - 1]) / np.maximum(at_ns[after] - at_ns[after - 1], 1), 0.0, 1.0)
    return np.stack(se3.act(se3.interpolate(ends[0], ends[1], part), tuple(s.points.T)), axis=1)


def check_trial(c: Columns, view: MapView) -> Iterator[Finding]:
    """Findings of the replay and of the fit: clock, mount, scales, noise, identities, outliers."""
    if len(view.keyframes) < 3 or len(c.path_ns) < 2 or not view.landmarks:
        return
    try:
        fit, fitted = view.trial_fit()
    except GraphSlamError as error:
        yield Finding("fit_unsure", "note", 1, 0, "fits", f"the trial fit failed: {error}")
        return
    unsure = answers.unsure(fit)
    step_s = float(np.median(np.diff(c.path_ns))) * 1e-9
    off = {one.parameter: one.value for one in fitted if _is_far_off(fit, one, step_s)}
    slip = None if off else check_slips(c, view)  # a clock or mount that is wrong bends the path in turns
    is_broken = slip is not None and slip[0].severity == "warning"
    goes_back = any((np.diff(t.stamp_ns[t.stamp_ns != 0]) < -1_000_000_000).any() for t in c.topics.values())
    found = [] if off or goes_back else _places(c, view, slip if is_broken else None)
    if unsure is not None:
        found += [one for s in c.sightings for one in noisier(s, pairs_of(c, s))]
        why, value, limit, unit = unsure
        text = f"{why}: clock, mount and scale cannot be checked"
        yield from found or [Finding("fit_unsure", "warning", value, limit, unit, text)]
        return
    yield from (found_one for one in fitted for found_one in _fitted(c, view, fit, one, off))
    yield from _jumps(c, fit)
    yield from [slip[0]] if slip else []
    hidden = _OF_A_BREAK if is_broken else ("ids_unsure",) * any(one.code == "map_breaks" for one in found)
    yield from (one for one in found if one.code not in hidden)
    if new := view.renewed_ids():
        name = c.sightings[0].topic
        text = f"{name}: {new}"
        yield Finding("ids_renewed", "warning", new.same, 0, "landmarks", text, name, new.since_ns, new.new)
    yield from _noise(c, view, has_cause=bool(off))


def check_doubted(c: Columns, gyro: GyroState | None) -> Iterator[Finding]:
    """A gyro that a replay does not use any more, where nothing else is found of it."""
    if gyro is not None and gyro.state == "doubted" and all(one.severity == "note" for one in check_gyro(c)):
        name = topic.topic if (topic := c.topic_of(gyro.name)) else ""
        yield Finding("gyro_unrelated", "warning", gyro.ratio or 0.0, 1.0, "times", gyro.fault, name, 0, len(c.gyro_ns))


def _noise(c: Columns, view: MapView, *, has_cause: bool) -> Iterator[Finding]:
    """Noise that is too small, and more than the run allows for, where nothing that is off explains it."""
    for noise in () if has_cause else view.backend.noise_scale():
        limit = _ODOMETRY_OVER_CONFIDENT if noise.label == "odometry" else _OVER_CONFIDENT
        factor = float(np.sqrt(noise.per_dof))
        is_allowed_for = c.config.robust.noise_scale == "estimated" and noise.factor < LARGEST
        if factor > limit and not noise.reason and not is_allowed_for:
            yield _over_confident(c, noise, factor, limit)


def _over_confident(c: Columns, noise: NoiseScale, factor: float, limit: float) -> Finding:
    code = "odometry_over_confident" if noise.label == "odometry" else "over_confident"
    of = c.topic_of(noise.source)
    topic = noise.source if of is None else of.topic
    what = " ".join(filter(None, (noise.label, noise.part)))
    text = f"{topic}: residuals ({what}) are {factor:.1f} times as large as its noise says"
    if c.config.robust.noise_scale != "estimated":
        return Finding(code, "warning", factor, limit, "times", text, topic, 0, 0, ("robust.noise_scale=estimated",))
    text += f"; a run allows for {LARGEST:g} times"
    own = next((one for one in c.config.sources if one.name == noise.source and one.use == "odometry"), None)
    settings = (f"{own.name}.sigma_factor={own.sigma_factor * factor:.2g}",) if own else ()
    return Finding(code, "note", factor, limit, "times", text, topic, settings=settings)


def _is_far_off(fit: TrialFit, one: answers.Fitted, step_s: float) -> bool:
    """Return whether a parameter is far off by its limit and several sigmas. Between two poses a clock is no proof."""
    limit = max(_LIMITS.get(one.parameter.name, ("", np.inf))[1], _OF_STEP * step_s * (one.parameter.name == "clock"))
    sigmas = _TURN_SIGMAS if one.parameter.name == "turn" else SIGMAS
    return answers.is_off(fit, one) and abs(one.value) > max(limit, sigmas * one.sigma)


def _fitted(
    c: Columns, view: MapView, fit: TrialFit, one: answers.Fitted, off: Mapping[Parameter, float]
) -> Iterator[Finding]:
    topic = c.topic_of(one.parameter.source)
    if one.parameter.name not in _LIMITS or topic is None:
        return
    code, (unit, limit, unknown) = answers.CODES[one.parameter.name], _LIMITS[one.parameter.name]
    if one.parameter in off:
        of_pose = twist_factor(c.odometry) * c.config.odometry.distance_factor
        is_pose = abs(of_pose * (1.0 + one.value) - 1.0) < limit < abs(of_pose - 1.0)  # by its twist
        told = answers.off_by(fit, one.parameter, off, view.corrections.total, may_be_ranges=not is_pose)
        setting, lag_s, own = told.setting, float(np.median(topic.lag_s)), c.odometry.input
        if code == "clock_offset" and -_RECORDED_S < lag_s < one.value - EARLY_S:  # none is recorded before it is seen
            setting = f"{own}.offset_s", round(view.corrections.total(own, "clock") - one.value, 3)
        is_open = code == "odometry_scale" and not is_pose
        settings = () if is_open or not setting else (assignment(*setting),)
        yield topic.finding(code, "warning", one.value, limit, unit, told.text, settings=settings)
    elif one.sigma > unknown:
        yield Finding("not_observable", "note", one.sigma, unknown, unit, one.text, topic.topic)


def _jumps(c: Columns, fit: TrialFit) -> Iterator[Finding]:
    for one, limit in answers.jumps(fit):
        if (topic := c.topic_of(one.parameter.source)) is not None:
            unit = _LIMITS[one.parameter.name][0]
            yield topic.finding(one.code, "warning", one.value, limit, unit, one.text)


def _places(c: Columns, view: MapView, slip: tuple[Finding, int] | None) -> list[Finding]:
    """Identities by where the estimate puts them, and sightings that are far from their landmark, but for a slip's."""
    found: list[Finding] = []
    for s in c.sightings:
        inside = (s.stamp_ns >= c.path_ns[0]) & (s.stamp_ns <= c.path_ns[-1])
        if slip is not None:
            inside &= (s.stamp_ns < slip[0].first_ns) | (s.stamp_ns > slip[1])
        if not inside.any():
            continue
        points = _points_in_map(c, s, view)
        points[~inside] = np.nan
        two = at_two_places(s, points, c.path_ns, c.config.world.dimensions)
        found += [*check_moved(s, two), *check_reused(s, two)]
        found += check_outliers(s, points, inside, c.config.world.dimensions)
    return found


def check_slips(c: Columns, view: MapView) -> tuple[Finding, int] | None:
    """Find the stretch in which odometry is worst, if it is far worse there than in the rest of the drive.

    Returned are the finding, from the stamp on at which the stretch begins, and the stamp at which it ends.
    """
    errors, sizes, stamps_ns = _errors(view)
    found = worst_stretch(errors, sizes, np.array([_LEAST_M, _LEAST_RAD]), _PART, _SLIP_SIGMAS)
    if found is None:
        return None
    k, part, error, limit, scale = found
    stamps_ns, unit = stamps_ns[k : k + TOGETHER + 1], ("m", "rad")[part]
    is_large = abs(error) > max((_LARGE_M, _LARGE_RAD)[part], _LARGE_SIGMAS * scale)
    severity: Severity = "warning" if is_large else "note"
    by = f"{('drives', 'turns')[part]} {abs(error):.2f} {unit} {'less' if error < 0.0 else 'more'} than odometry says"
    if abs(error) > sizes[k : k + TOGETHER, part].sum():
        by = f"is elsewhere than odometry says, by {abs(error):.2f} {unit}"
    span = f"in a stretch of {np.ptp(stamps_ns) * 1e-9:.0f} s, where {scale:.2f} {unit} is usual"
    text = f"by the landmarks the robot {by}, {span}: its wheels slip, or it is carried or held"
    slip = c.odometry.finding("odometry_slips", severity, abs(error), limit, unit, text, TOGETHER, at=stamps_ns)
    return slip, int(stamps_ns[-1])


def _errors(view: MapView) -> tuple[Array, Array, Index]:
    """Errors (n, 2) of odometry ahead and in heading at each step, how much it says it moved, and stamps (n + 1,)."""
    own, estimate = (se3.in_space(poses).reshape(-1, 7) for poses in (view.keyframes.poses, view.trajectory()))
    order = np.argsort(view.keyframes.stamps_ns, kind="stable")
    own, estimate = own[order], estimate[order]
    stated, found = (se3.between(tuple(poses[:-1].T), tuple(poses[1:].T)) for poses in (own, estimate))
    error = np.stack(se3.local(found, stated), axis=1)
    decided = {alarm.segment for alarm in view.alarms}
    begins = np.isin(order, [index for index in view.segments if index not in decided])
    error[begins[1:]] = 0.0  # odometry was restarted or jumps there, which is another finding
    moved = np.stack(se3.local(stated, se3.IDENTITY), axis=1)
    sizes = np.stack([np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)], axis=1)
    return error[:, [0, 5]], sizes, view.keyframes.stamps_ns[order]
