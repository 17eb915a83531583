"""Findings of a trial fit that nothing corrects: clocks, mounts and scales that are off, and what mends them.

A parameter may be far off and harm nothing, e.g. where sightings at all sides average it. So it is told by its effect:
the poses would move. With the shift b of a pose and its covariance P, which takes the parameter for known,
b' inv(P) b is what the parameter adds to the pose's normalised error squared (NEES), of which the degrees of freedom
are expected.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graph_slam_ros.slam.calibration.decision import LEAST_SIGMA_PER_M, SIGMAS, Finding, is_certain
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import OF_ODOMETRY, Parameter, Values
from graph_slam_ros.slam.calibration.places import LEAST_M
from graph_slam_ros.slam.frontend.corrections import AXES
from graph_slam_ros.typing import Array, Index

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

MOST_SHIFT = 2.0**0.5  # sigmas of the poses: with more, their NEES is three times what is expected
_DEGREE = np.pi / 180.0
_JUMPED_S = 0.08
_SIDES = {"x": ("ahead", "back"), "y": ("to the left", "to the right")}
_AXIS = {"roll": "about the axis ahead ", "pitch": "about the axis to the left ", "yaw": ""}

Total = Callable[[str, str], float]
"""The value of a parameter of an input that measurements are corrected by at present."""


@dataclass(frozen=True, slots=True)
class Uncorrected:
    """A parameter that is off, or a noise that is too small, so that the estimate is worse than it says.

    Attributes
    ----------
    code : the finding of ``graph_slam check``
    value, sigma : of the correction, in s, rad, m, or as a part; of a noise, the stated one [m for each metre], and 0
    shift : root mean square by which it moves the poses, in their sigmas
    setting : a parameter of the configuration, and the value that mends it; empty where none does
    """

    code: str
    source: str
    value: float
    sigma: float
    shift: float
    text: str
    setting: tuple[str, Any] | tuple[()]

    def __str__(self) -> str:
        by = f"; by it the poses are off by {self.shift:.1f} times what noise does to them" if self.setting else ""
        return f"{self.code}: {self.source}: {self.text}{by}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values with six digits, because the last ones depend on the memory alignment of an array."""
        numbers = {name: float(f"{getattr(self, name):.6g}") for name in ("value", "sigma", "shift")}
        settings = dict([self.setting] if self.setting else [])
        return {"code": self.code, **numbers, "text": str(self), "settings": settings}


def uncorrected(
    found: TrialFit,
    findings: Sequence[Finding],
    covariances: Mapping[int, Array],
    total: Total,
    sigma_per_m: float,
) -> list[Uncorrected]:
    """Return what is off by more than the poses' sigmas allow, the worst first.

    Findings are of each parameter, covariances (dof, dof) of poses by vertex, ``sigma_per_m`` is that of odometry.
    """
    shifts = pose_shifts(found, covariances)
    if sigma_per_m < LEAST_SIGMA_PER_M:
        return _too_sure(found, shifts, sigma_per_m)
    off = [k for k, one in enumerate(findings) if is_off(found, one) and shifts[k] > MOST_SHIFT]
    values = {found.parameters[k]: float(found.values[k]) for k in off if found.parameters[k].name in CODES}
    out = []
    for one, value in values.items():
        sigma, shift = found.sigma(one), float(shifts[found.parameters.index(one)])
        text = sentence(one, value, sigma)
        text += ", more than its stated noise allows for (odometry.noise)" * (one.name in OF_ODOMETRY)
        setting = setting_of(one, values, total)
        out.append(Uncorrected(CODES[one.name], one.source, value, sigma, shift, text, setting))
    jumps = [
        Uncorrected("clock_jump", one.source, after - before, sigma, 0.0, jump_sentence(before, after, sigma), ())
        for one, before, after, sigma, _ in clock_jumps(found)
    ]
    return [*jumps, *sorted(out, key=lambda one: -one.shift)]


def is_off(found: TrialFit, one: Finding) -> bool:
    """Return whether a parameter is off beyond doubt, though its sigma may be too large to correct it."""
    is_known = one.verdict == "admitted" or (one.verdict == "not_determined" and is_certain(found, one.parameter))
    return is_known and (one.parameter.name not in _SIDES or abs(one.value) >= LEAST_M)


def clock_jumps(found: TrialFit) -> Iterator[tuple[Parameter, float, float, float, float]]:
    """Yield the clocks that differ in both halves of the drive, with both values, their sigma, and the limit [s]."""
    sigmas = np.sqrt(np.diag(found.covariance))
    for k, one in enumerate(found.parameters):
        before, after, sigma = float(found.first[k]), float(found.second[k]), 2.0**0.5 * float(sigmas[k])
        limit = max(_JUMPED_S, 2.0**0.5 * SIGMAS * sigma)
        if one.name == "clock" and abs(after - before) > limit:
            yield one, before, after, sigma, limit


def jump_sentence(before: float, after: float, sigma: float) -> str:
    """Say what a clock is in either half of the drive."""
    return (
        f"sightings agree with odometry best {before * 1e3:+.0f} ms from their stamps in one half of the drive, "
        f"{after * 1e3:+.0f} ms in the other (sigma {sigma * 1e3:.0f} ms)"
    )


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


def _too_sure(found: TrialFit, shifts: Array, sigma_per_m: float) -> list[Uncorrected]:
    """Odometry whose noise is so small that the fit of its factors is not believed, if it matters."""
    far = np.abs(found.values) > SIGMAS * found.sigmas
    of_odometry = [k for k, one in enumerate(found.parameters) if one.name in OF_ODOMETRY and far[k]]
    worst = max(of_odometry, key=lambda k: float(shifts[k]), default=-1)
    if worst < 0 or shifts[worst] <= MOST_SHIFT:
        return []
    source = found.parameters[worst].source
    text = f"odometry states {sigma_per_m:.1g} m of noise for each metre, no wheels are so good"
    more = ("odometry_over_confident", source, sigma_per_m, 0.0, float(shifts[worst]), text)
    return [Uncorrected(*more, ("odometry.noise", "motion"))]


def sentence(one: Parameter, value: float, sigma: float) -> str:
    """Say what is off, with its sigma."""
    if one.name == "clock":
        when, other = ("later", "late") if value > 0.0 else ("earlier", "early")
        best = f"{abs(value) * 1e3:.0f} ms {when} than stamped (sigma {sigma * 1e3:.0f} ms)"
        return f"sightings agree with odometry best {best}, or odometry is stamped as much too {other}"
    if one.name in _AXIS:
        return (
            f"its sensor is turned by {value / _DEGREE:.1f} degrees {_AXIS[one.name]}on the robot "
            f"(sigma {sigma / _DEGREE:.1f})"
        )
    if one.name in _SIDES:
        where = _SIDES[one.name][value < 0.0]
        return f"its sensor is {abs(value):.2f} m further {where} than its mount says (sigma {sigma:.2f} m)"
    if one.name == "range_factor":
        return f"ranges are {1.0 / (1.0 + value):.3f} times the distances that odometry says (sigma {sigma:.3f})"
    if one.name == "range_offset":
        return f"ranges are {abs(value):.2f} m too {'short' if value > 0.0 else 'long'} (sigma {sigma:.2f} m)"
    what = "drives" if one.name == "distance" else "turns"
    text = f"the robot {what} {1.0 + value:.3f} times what odometry says (sigma {sigma:.3f})"
    return f"{text}, or ranges are wrong by that factor" if one.name == "distance" else text


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


def sampled(vertices: Index, most: int) -> Index:
    """Some of the vertices, evenly, at most so many."""
    return vertices[:: max(1, -(-len(vertices) // most))]
