"""The decision on a fitted parameter: four questions, and a sentence where the answer is no.

1. Is it determined? Its sigma must be below a limit.
2. Is it worth it? It must be off by four sigmas, and by more than anybody would notice.
3. Is it reproducible? Fitted on either half of the drive, it must lower the cost of the other.
4. Is it this parameter, not another? Its correlation with any other must be below 0.95, and it must lie within three
   sigmas of its prior. And neither noise of odometry nor another distance in bends explains it as well (``places``).

The sigmas of the first two hang on the noise that odometry states: where it is too small, the drift of a heading passes
for a wrong factor. So nothing is let in where odometry states less noise than any wheels have.

Landmarks without identities were identified by this odometry. So they confirm its factors, whatever these are. A factor
is refused, unless the association of these landmarks, which leaves it open, has found the same within three sigmas, it
is asked for by name, or the map was there before.

A yaw (in space a pitch, too) is measured against the direction in which odometry moves. So it is refused for a robot
that is configured to slide across that direction, and for one that only turned on the spot: there the errors of other
parameters make a direction.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import OF_ODOMETRY, Parameter

SIGMAS = 4.0
MOST_CORRELATED = 0.95
PRIOR_SIGMAS = 3.0
AGREEING_SIGMAS = 3.0
MOST_LOST = 0.2
LEAST_LANDMARKS = 3
MOST_SLIDING = 0.3  # of odometry's noise ahead: with more sideways, a turned sensor and a robot that slides are one
LEAST_SIGMA_PER_M = 1e-3  # of odometry: the noise of its position [m] for each metre
_OF_MOTION = {"yaw": 0, "pitch": 1}  # angles that are measured against the motion, and the direction across it
FOLLOWED = 0.1  # of a sigma: what is left of a correction that is used is followed from there on

Verdict = Literal["admitted", "nothing_to_correct", "not_determined", "not_reproducible", "not_separable", "refused"]


@dataclass(frozen=True, slots=True)
class Finding:
    """The judged result of a trial fit for one parameter.

    Attributes
    ----------
    value, sigma : of the correction
    verdict : whether it is let in, and else why not
    text : the verdict with its reason, for a person
    """

    parameter: Parameter
    value: float
    sigma: float
    verdict: Verdict
    text: str

    @classmethod
    def of(cls, parameter: Parameter, value: float, sigma: float, verdict: Verdict, text: str) -> "Finding":
        """Make a finding; ``{}`` in its text is the value with its sigma."""
        shown = text.replace("{}", parameter.with_sigma(value, sigma))
        return cls(parameter, value, sigma, verdict, f"{parameter}: {shown}")

    @property
    def is_determined(self) -> bool:
        """Return whether the drive determines the parameter."""
        return self.verdict in ("admitted", "nothing_to_correct")


def decide(
    found: TrialFit,
    landmarks: int,
    *,
    slides: tuple[float, float] = (0.0, 0.0),
    sigma_per_m: float = 1.0,
    by_association: Mapping[str, tuple[float, float]] | None = None,
) -> list[Finding]:
    """Answer the four questions for each parameter of a trial fit.

    Parameters
    ----------
    landmarks : how many were seen
    slides : configured noise of odometry sideways and upwards, relative to that ahead
    sigma_per_m : of odometry's position for each metre, as stated, in the middle of all steps; infinite if none moves
    by_association : odometry's factors less 1 with sigmas, as far as the association of landmarks without identities
        found them; None where landmarks have identities
    """
    void, out = _void(found, landmarks, sigma_per_m), []
    for k, one in enumerate(found.parameters):
        if one in found.doubted and not void:
            value, sigma, why = found.doubted[one]
            out.append(Finding.of(one, value, sigma, "not_separable", f"not sure ({{}}): {why}"))
            continue
        stands = _stands(one) if math.isinf(sigma_per_m) else ""
        verdict, text = _verdict(found, k, void or stands, _slides(one, slides) or _unnamed(found, by_association, k))
        out.append(Finding.of(one, float(found.values[k]), float(found.sigmas[k]), verdict, text))
    return out


def is_certain(found: TrialFit, parameter: Parameter) -> bool:
    """Return whether a parameter is off beyond doubt, however large its sigma is: the last three questions."""
    k = found.parameters.index(parameter)
    is_far = SIGMAS * found.sigmas[k] < abs(found.values[k]) <= PRIOR_SIGMAS * found.priors[k]
    is_alone = found.worst_correlation(k)[0] <= MOST_CORRELATED
    return bool(is_far and is_alone and _agree(float(found.first[k]), float(found.second[k])))


def of_association(parameter: Parameter, value: float, sigma: float, is_corrected: bool) -> Finding:
    """Judge a factor of odometry that the association of landmarks without identities has left open and found.

    The first two questions are asked. The others its search has answered: it compares whole explanations, each with
    the clocks and factors that fit it best.
    """
    least = FOLLOWED * sigma if is_corrected else max(SIGMAS * sigma, parameter.quantity.least)
    if sigma >= parameter.quantity.determined_below and not is_corrected:
        why = f"not determined ({{}}): {parameter.quantity.manoeuvre}"
        return Finding.of(parameter, value, sigma, "not_determined", why)
    if abs(value) < least:
        return Finding.of(parameter, value, sigma, "nothing_to_correct", "nothing to correct ({})")
    return Finding.of(parameter, value, sigma, "admitted", "{}")


def _void(found: TrialFit, landmarks: int, sigma_per_m: float) -> str:
    """Return why a whole fit is not used; empty if it may be."""
    if landmarks < LEAST_LANDMARKS:
        return f"{landmarks} landmark{' was' if landmarks == 1 else 's were'} seen, {LEAST_LANDMARKS} are needed"
    if found.lost > MOST_LOST:
        return f"{found.lost:.0%} of the sightings do not fit, more than {MOST_LOST:.0%}: check their ids and noise"
    if (k := absurd_range(found)) is not None:
        return f"{absurd_text(found, k)}: check ids and noise, or configure it"
    if sigma_per_m < LEAST_SIGMA_PER_M:
        stated = f"odometry states {sigma_per_m:.1g} m of noise for each metre"
        return f"{stated}, no wheels are so good: set odometry.noise=motion"
    return ""


def absurd_range(found: TrialFit) -> int | None:
    """Return a parameter of ranges, by its place, that is far beyond its prior; None where none is.

    Of ranges alone, many of which are wrong, the likeliest map may be shrunk to next to nothing. All else follows it.
    """
    of_ranges = np.array([one.name.startswith("range") for one in found.parameters], dtype=bool)
    priors = np.maximum(found.priors, [one.quantity.prior for one in found.parameters])
    far = of_ranges * np.abs(found.values) / priors
    return int(far.argmax()) if len(far) and far.max() > PRIOR_SIGMAS else None


def absurd_text(found: TrialFit, k: int) -> str:
    """Say how far off a parameter would be."""
    one = found.parameters[k]
    most = PRIOR_SIGMAS * max(float(found.priors[k]), one.quantity.prior)
    return f"{one} would be off by {one.shown(float(found.values[k]), 3)}, more than {one.shown(most)}"


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
    halves = float(found.first[k]), float(found.second[k])
    if not _agree(*halves):
        first, second = (parameter.shown(half, 3) for half in halves)
        return "not_reproducible", f"not used ({{}}): {first} in one half of the drive, {second} in the other"
    return "admitted", "{}"


def _stands(parameter: Parameter) -> str:
    """Return why an angle is not measured where odometry only turns; empty if it is."""
    is_of_motion = parameter.name in _OF_MOTION
    return f"odometry does not move: {parameter.quantity.manoeuvre}" if is_of_motion else ""


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


def _unnamed(found: TrialFit, by_association: Mapping[str, tuple[float, float]] | None, k: int) -> str:
    """Return why a factor of odometry is not believed of landmarks without identities; empty if it may be."""
    parameter = found.parameters[k]
    if by_association is None or parameter.name not in OF_ODOMETRY:
        return ""
    remedy = f"Use ids, or ask for it: graph_slam calibrate --groups {parameter.quantity.group}"
    if parameter.name not in by_association:
        return f"landmarks without ids were identified by this odometry. {remedy}"
    value, sigma = by_association[parameter.name]
    if abs(value - float(found.values[k])) <= AGREEING_SIGMAS * math.hypot(sigma, float(found.sigmas[k])):
        return ""
    has = parameter.with_sigma(value, sigma)
    return f"the association of landmarks without ids, which leaves it open, has {has}. {remedy}"


def _agree(first: float, second: float) -> bool:
    """Return whether each half's estimate lowers the cost of the other half, taken as a parabola."""
    return 0.0 < first / second < 2.0 and 0.0 < second / first < 2.0 if first and second else False
