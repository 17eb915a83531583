"""What is said of a trial fit: a verdict on each parameter, and what is off so far that the poses are worse for it.

A verdict answers four questions.

1. Is it determined? Its sigma must be below a limit.
2. Is it worth it? It must be off by four sigmas, and by more than anybody would notice.
3. Is it reproducible? Fitted on either half of the drive, it must lower the cost of the other.
4. Is it this parameter, not another? Its correlation with any other must be below 0.95, and it must lie within three
   sigmas of its prior. And neither noise of odometry nor another distance in bends explains it as well (``places``).

The sigmas of the first two hang on the noise that odometry states: where it is too small, the drift of a heading passes
for a wrong factor. So nothing is let in where odometry states less noise than any wheels have.

Landmarks without identities were identified by this odometry. So they confirm its factors, whatever these are. A factor
is refused, unless it is asked for by name, or the map was there before. Their association leaves factors open, and what
it finds is corrected (``found_factors``).

A yaw (in space a pitch, too) is measured against the direction in which odometry moves. So it is refused for a robot
that is configured to slide across that direction, and for one that only turned on the spot: there the errors of other
parameters make a direction.

A parameter may be far off and harm nothing, e.g. where sightings at all sides average it. So what nothing corrects is
told by its effect: the poses would move. With the shift b of a pose and its covariance P, which takes the parameter for
known, b' inv(P) b is what the parameter adds to the pose's normalised error squared (NEES), of which the degrees of
freedom are expected.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import BEND, DEGREE, OF_ODOMETRY, Parameter, Values
from graph_slam_ros.slam.frontend.corrections import AXES
from graph_slam_ros.slam.levels import ENOUGH, SIGMAS
from graph_slam_ros.typing import Array

MOST_CORRELATED = 0.95  # with more, noise decides which of two it is
PRIOR_SIGMAS = 3.0  # more is another configuration, not an error of this one
MOST_LOST = 0.2  # part of the sightings: with more, the fit is of what is left
MOST_SLIDING = 0.3  # of odometry's noise ahead: with more sideways, a turned sensor and a robot that slides are one
LEAST_SIGMA_PER_M = 1e-3  # of odometry: the noise of its position [m] for each metre
_OF_MOTION = {"yaw": 0, "pitch": 1}  # angles that are measured against the motion, and the direction across it

Verdict = Literal["admitted", "nothing_to_correct", "not_determined", "not_reproducible", "not_separable", "refused"]


@dataclass(frozen=True, slots=True)
class Fitted:
    """What a trial fit finds of one parameter.

    Attributes
    ----------
    value, sigma : the correction or the jump; where the stated noise is too small, that noise [m for each metre], and 0
    text : the reason of the verdict for a person
    code : the finding of ``graph_slam check``, if the poses are worse for it than their covariances say; else empty
    shift : root mean square by which it moves the poses, in their sigmas
    setting : a parameter of the configuration, and the value that mends it; empty where none does
    """

    parameter: Parameter
    value: float
    sigma: float
    verdict: Verdict
    text: str
    code: str = ""
    shift: float = 0.0
    setting: tuple[str, Any] | tuple[()] = ()

    @classmethod
    def of(cls, parameter: Parameter, value: float, sigma: float, verdict: Verdict, text: str) -> "Fitted":
        """Make a finding; ``{}`` in its text is the value with its sigma."""
        shown = text.replace("{}", parameter.with_sigma(value, sigma))
        return cls(parameter, value, sigma, verdict, f"{parameter}: {shown}")

    @property
    def is_determined(self) -> bool:
        """Return whether the drive determines the parameter."""
        return self.verdict in ("admitted", "nothing_to_correct")

    def __str__(self) -> str:
        by = f"; by it the poses are off by {self.shift:.1f} times what noise does to them" * (self.shift > MOST_SHIFT)
        return f"{self.code}: {self.parameter.source}: {self.text}{by}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values with six digits, because the last ones depend on the memory alignment of an array."""
        numbers = {name: float(f"{getattr(self, name):.6g}") for name in ("value", "sigma", "shift")}
        settings = dict([self.setting] if self.setting else [])
        return {"code": self.code, **numbers, "text": str(self), "settings": settings}


def decide(
    found: TrialFit,
    landmarks: int,
    *,
    slides: tuple[float, float] = (0.0, 0.0),
    sigma_per_m: float = 1.0,
    is_unnamed: bool = False,
) -> list[Fitted]:
    """Answer the four questions for each parameter of a trial fit.

    Parameters
    ----------
    landmarks : how many were seen
    slides : configured noise of odometry sideways and upwards, relative to that ahead
    sigma_per_m : of odometry's position for each metre, as stated, in the middle of all steps; infinite if none moves
    is_unnamed : whether this odometry has identified the landmarks, so that its factors are not to be had from them
    """
    void, out = _void(found, landmarks, sigma_per_m), []
    for k, one in enumerate(found.parameters):
        if one in found.doubted and not void:
            value, sigma, why = found.doubted[one]
            out.append(Fitted.of(one, value, sigma, "not_separable", f"not sure ({{}}): {why}"))
            continue
        stands = math.isinf(sigma_per_m) and one.name in _OF_MOTION
        why = void or (f"odometry does not move: {one.quantity.manoeuvre}" if stands else "")
        verdict, text = _verdict(found, k, why, _slides(one, slides) or (_unnamed(one) if is_unnamed else ""))
        out.append(Fitted.of(one, float(found.values[k]), float(found.sigmas[k]), verdict, text))
    return out


def is_certain(found: TrialFit, parameter: Parameter) -> bool:
    """Return whether a parameter is off beyond doubt, however large its sigma is: the last three questions."""
    k = found.parameters.index(parameter)
    is_far = SIGMAS * found.sigmas[k] < abs(found.values[k]) <= PRIOR_SIGMAS * found.priors[k]
    is_alone = found.worst_correlation(k)[0] <= MOST_CORRELATED
    return bool(is_far and is_alone and _agree(*(float(half[k]) for half in found.halves)))


def _void(found: TrialFit, landmarks: int, sigma_per_m: float) -> str:
    """Return why a whole fit is not used; empty if it may be."""
    if landmarks < ENOUGH:
        return f"{landmarks} landmark{' was' if landmarks == 1 else 's were'} seen, {ENOUGH} are needed"
    if why := unsure(found):
        return f"{why[0]}: check ids and noise, or configure it"
    if sigma_per_m < LEAST_SIGMA_PER_M:
        stated = f"odometry states {sigma_per_m:.1g} m of noise for each metre"
        return f"{stated}, no wheels are so good: set odometry.noise=motion"
    return ""


def unsure(found: TrialFit) -> tuple[str, float, float, str] | None:
    """Return why nothing of a fit is believed, with a value, its limit and their unit; None if it may be.

    Of ranges alone, many of which are wrong, the likeliest map may be shrunk to next to nothing. All else follows it.
    """
    if found.lost > MOST_LOST:
        return f"{found.lost:.0%} of the sightings do not fit", found.lost, MOST_LOST, "part"
    for one, value, prior in zip(found.parameters, found.values.tolist(), found.priors.tolist(), strict=True):
        sigmas = abs(value) / max(prior, one.quantity.prior)
        if one.name.startswith("range") and sigmas > PRIOR_SIGMAS:
            return f"many ranges are wrong, or {one} is off by {one.shown(value, 3)}", sigmas, PRIOR_SIGMAS, "sigmas"
    return None


def _verdict(found: TrialFit, k: int, void: str, slides: str) -> tuple[Verdict, str]:
    parameter, value, sigma = found.parameters[k], float(found.values[k]), float(found.sigmas[k])
    quantity, (correlation, other) = parameter.quantity, found.worst_correlation(k)
    if void:
        is_unseen = void.endswith(" are needed")
        return "refused", f"not determined: {void}{f': {quantity.manoeuvre}' if is_unseen else ''}"
    if sigma >= quantity.determined_below:
        needs = f"sigma {parameter.shown(sigma)}, needs {parameter.shown(quantity.determined_below)}"
        return "not_determined", f"not determined ({needs}): {quantity.manoeuvre}"
    if abs(value) < quantity.least:
        return "nothing_to_correct", "nothing to correct ({})"
    if abs(value) < SIGMAS * sigma:
        return "nothing_to_correct", f"not corrected ({{}}): within {SIGMAS:.0f} sigmas of zero"
    if slides:
        return "refused", f"not used ({{}}): {slides}"
    if correlation > MOST_CORRELATED:
        return "not_separable", f"not separable from {other} (correlation {correlation:.2f}): {quantity.manoeuvre}"
    if abs(value) > PRIOR_SIGMAS * found.priors[k]:
        most = parameter.shown(PRIOR_SIGMAS * float(found.priors[k]))
        return "refused", f"not used ({{}}): larger than {most}: correct the configuration first"
    halves = [float(half[k]) for half in found.halves]
    if not _agree(*halves):
        first, second = (parameter.shown(half, 3) for half in halves)
        return "not_reproducible", f"not used ({{}}): {first} in one half of the drive, {second} in the other"
    return "admitted", "{}"


def _slides(parameter: Parameter, slides: tuple[float, float]) -> str:
    """Return why an angle cannot be told from a slide across the direction of motion; empty if it can."""
    axis = _OF_MOTION.get(parameter.name)
    if axis is None or slides[axis] <= MOST_SLIDING:
        return ""
    across, density = ("sideways", "lateral") if axis == 0 else ("upwards", "vertical")
    return (
        f"the robot may slide: odometry.{density}_density ({across}) is {slides[axis]:.1f} of "
        f"odometry.translation_density, more than {MOST_SLIDING}. If it does not slide, lower it; "
        f"{parameter.quantity.manoeuvre}"
    )


def _unnamed(parameter: Parameter) -> str:
    """Return why a factor of odometry is not believed of landmarks without identities; empty if it may be."""
    if parameter.name not in OF_ODOMETRY:
        return ""
    remedy = f"Use ids, or ask for it: graph_slam calibrate --groups {parameter.quantity.group}"
    return f"landmarks without ids were identified by this odometry. {remedy}"


def _agree(first: float, second: float) -> bool:
    """Return whether each half's estimate lowers the cost of the other half, taken as a parabola."""
    return 0.0 < first / second < 2.0 and 0.0 < second / first < 2.0 if first and second else False


# -- what is off and not corrected -------------------------------------------------------------------------------------

CODES = {
    "clock": "clock_offset",
    **dict.fromkeys(("roll", "pitch", "yaw"), "mount_yaw"),
    **dict.fromkeys(("x", "y"), "mount_place"),
    "distance": "odometry_scale",
    "turn": "turn_scale",
    "range_factor": "range_scale",
    "range_offset": "range_scale",
}
"""The finding of ``graph_slam check`` by parameter."""

LEAST_M = 0.2  # errors that last, as a robot that follows its commands late, are up to 0.14 m in recorded drives
MOST_SCALE = 0.03  # of distances: with more, the map has another size if ranges are wrong, though its poses agree
BESIDE_BENDS = 0.06  # of the distance where it is another in bends: in recorded robots with right ranges up to 0.05
MOST_SHIFT = 2.0**0.5  # sigmas of the poses: with more, their NEES is three times what is expected
_SIDES = {"x": ("ahead", "back"), "y": ("to the left", "to the right")}
_AXIS = {"roll": "about the axis ahead ", "pitch": "about the axis to the left ", "yaw": ""}
_JUMPED = {"clock": 0.08, **dict.fromkeys(_AXIS, 3.0 * DEGREE)}  # s, rad; recorded robots: 0.04 s, 1.3 degrees

Total = Callable[[str, str], float]
"""The value of a parameter of an input that measurements are corrected by at present."""


def uncorrected(
    found: TrialFit,
    findings: Sequence[Fitted],
    covariances: Mapping[int, Array],
    total: Total,
    sigma_per_m: float,
) -> list[Fitted]:
    """Return what is off by more than the poses' sigmas allow, the worst first.

    Findings are of each parameter, covariances (dof, dof) of poses by vertex, ``sigma_per_m`` is that of odometry.
    """
    shifts = pose_shifts(found, covariances)
    if sigma_per_m < LEAST_SIGMA_PER_M:
        return _too_sure(found, shifts, sigma_per_m)
    scaled = [one.parameter.name == "distance" and abs(one.value) > MOST_SCALE for one in findings]
    off = [k for k, one in enumerate(findings) if is_off(found, one) and (shifts[k] > MOST_SHIFT or scaled[k])]
    values = {found.parameters[k]: float(found.values[k]) for k in off if found.parameters[k].name in CODES}
    out = []
    for one in values:
        shift, told = float(shifts[found.parameters.index(one)]), off_by(found, one, values, total)
        text = f"{told.text}, more than its stated noise allows for (odometry.noise)"
        out.append(replace(told, shift=shift, text=text if one.name in OF_ODOMETRY else told.text))
    return [*(one for one, _ in jumps(found)), *sorted(out, key=lambda one: -one.shift)]


def off_by(found: TrialFit, one: Parameter, values: Values, total: Total, *, may_be_ranges: bool = True) -> Fitted:
    """Return what a parameter is off by, and the setting that mends it with others that are off, too."""
    value, sigma = values[one], found.sigma(one)
    setting = () if one in found.doubted else setting_of(one, values, total)
    ranges = _ranges_instead(found, value, total, setting) if may_be_ranges and one.name == "distance" else ""
    return Fitted(one, value, sigma, "admitted", _sentence(one, value, sigma, ranges), CODES[one.name], 0.0, setting)


def is_off(found: TrialFit, one: Fitted) -> bool:
    """Return whether a parameter is off beyond doubt, though its sigma may be too large to correct it."""
    name, far, limit = one.parameter.name, abs(one.value), max(SIGMAS * one.sigma, BESIDE_BENDS)
    is_known = one.verdict == "admitted" or (one.verdict == "not_determined" and is_certain(found, one.parameter))
    is_known |= one.verdict == "not_separable" and name == "distance" and _has_bends(found) and far > limit
    return is_known and (name not in _SIDES or far >= LEAST_M)


def _has_bends(found: TrialFit) -> bool:
    """Return whether the distance in bends is fitted, too, so that of straight ways is not what that makes of it."""
    return any(one.name == BEND for one in found.doubted)


def jumps(found: TrialFit) -> Iterator[tuple[Fitted, float]]:
    """Yield what is another one later in the drive, a clock or an angle of a mount, with the limit."""
    for k, one in enumerate(found.parameters if found.lost <= MOST_LOST else ()):
        (before, after), sigma = (float(half[k]) for half in found.halves), float(2.0 * found.covariance[k, k]) ** 0.5
        limit = max(_JUMPED.get(one.name, np.inf), 2.0**0.5 * SIGMAS * sigma)
        if abs(after - before) > limit:
            since = f"since {found.since_ns * 1e-9:.1f} s" if found.since_ns else "in the second half of the drive"
            then = f"at first, {one.shown(after)} {since} (sigma {one.shown(sigma)})"
            if one.name == "clock":
                code, text = (
                    "clock_jump",
                    f"sightings agree with odometry best {one.shown(before)} from their stamps {then}",
                )
            else:
                turned = f"its sensor is turned by {one.shown(before)} {_AXIS[one.name]}on the robot"
                code, text = "mount_moved", f"{turned} {then}: it was knocked, or is loose"
            yield Fitted(one, after - before, sigma, "not_reproducible", text, code), limit


def pose_shifts(found: TrialFit, covariances: Mapping[int, Array]) -> Array:
    """Root mean square (p,) by which each parameter's correction moves the poses, in their sigmas."""
    begins = {vertex: int(found.column[vertex]) for vertex in covariances if vertex < len(found.column)}
    known = {vertex: at for vertex, at in begins.items() if at >= 0}
    if not known:
        return np.zeros(len(found.parameters))
    every = np.array([covariances[vertex] for vertex in known])
    rows = np.array(list(known.values()))[:, None] + np.arange(every.shape[1])
    moved = found.sensitivity[rows] * found.values
    square = np.einsum("nip,nij,njp->np", moved, np.linalg.pinv(every, hermitian=True), moved)
    return np.asarray(np.sqrt(np.maximum(square, 0.0).mean(axis=0) / every.shape[1]))


def _too_sure(found: TrialFit, shifts: Array, sigma_per_m: float) -> list[Fitted]:
    """Odometry whose noise is so small that the fit of its factors is not believed, if it matters."""
    far = np.abs(found.values) > SIGMAS * found.sigmas
    of_odometry = [k for k, one in enumerate(found.parameters) if one.name in OF_ODOMETRY and far[k]]
    worst = max(of_odometry, key=lambda k: float(shifts[k]), default=-1)
    if worst < 0 or shifts[worst] <= MOST_SHIFT:
        return []
    text = f"odometry states {sigma_per_m:.1g} m of noise for each metre, no wheels are so good"
    more = "odometry_over_confident", float(shifts[worst]), ("odometry.noise", "motion")
    return [Fitted(found.parameters[worst], sigma_per_m, 0.0, "refused", text, *more)]


def _ranges_instead(found: TrialFit, distance: float, total: Total, setting: tuple[str, Any] | tuple[()]) -> str:
    """Return the settings by which ranges are wrong, where the distance of odometry may be right; else its own."""
    if _has_bends(found):
        return f"{next(iter(found.doubted.values()))[2]}, so no setting corrects it"
    by = {one.source: total(one.source, "range_factor") for one in found.parameters if one.name == "yaw"}
    ranges = " ".join(f"--set {name}.range_factor={now / (1.0 + distance):.4g}" for name, now in by.items())
    return f"{ranges} instead of --set {setting[0]}={setting[1]}" if ranges and setting else ranges


def _sentence(one: Parameter, value: float, sigma: float, ranges: str) -> str:
    """Say what is off, with its sigma, and for the distance of odometry, what is right if ranges are wrong."""
    if one.name == "clock":
        when, other = ("later", "late") if value > 0.0 else ("earlier", "early")
        best = f"{abs(value) * 1e3:.0f} ms {when} than stamped (sigma {sigma * 1e3:.0f} ms)"
        return f"sightings agree with odometry best {best}, or odometry is stamped as much too {other}"
    if one.name in _AXIS:
        by = f"{value / DEGREE:.1f} degrees {_AXIS[one.name]}on the robot (sigma {sigma / DEGREE:.1f})"
        return f"its sensor is turned by {by}"
    if one.name in _SIDES:
        where = _SIDES[one.name][value < 0.0]
        return f"its sensor is {abs(value):.2f} m further {where} than its mount says (sigma {sigma:.2f} m)"
    if one.name == "range_factor":
        return f"ranges are {1.0 / (1.0 + value):.3f} times the distances that odometry says (sigma {sigma:.3f})"
    if one.name == "range_offset":
        return f"ranges are {abs(value):.2f} m too {'short' if value > 0.0 else 'long'} (sigma {sigma:.2f} m)"
    what = "drives" if one.name == "distance" else "turns"
    text = f"the robot {what} {1.0 + value:.3f} times what odometry says (sigma {sigma:.3f})"
    tells = f" ({ranges}; a measured way, or the size of a tag, tells)" * bool(ranges)
    return f"{text}, or ranges are wrong by that factor{tells}" if one.name == "distance" else text


def setting_of(one: Parameter, values: Values, total: Total) -> tuple[str, Any]:
    """The parameter of the configuration, and its value with corrections; axes of one mount are corrected together."""
    source, value, before = one.source, values[one], total(one.source, one.name)
    if one.name == "clock":
        return f"{source}.offset_s", round(before + value, 3)
    if one.name in AXES:
        numbers = (total(source, axis) + values.get(Parameter(source, axis), 0.0) for axis in AXES)
        return f"{source}.mount_correction", " ".join(f"{x:.5g}" for x in numbers)
    if one.name == "range_factor":
        return f"{source}.range_factor", round(before * (1.0 + value), 4)
    if one.name == "range_offset":
        factor = 1.0 + values.get(Parameter(source, "range_factor"), 0.0)
        return f"{source}.range_offset_m", round(before * factor + value, 3)
    if one.name == "turn_bias":
        return "odometry.turn_bias_rad_s", round(before + value, 6)
    return f"odometry.{one.name}_factor", round(before * (1.0 + value), 4)
