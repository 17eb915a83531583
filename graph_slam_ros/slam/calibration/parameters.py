"""The parameters that may be calibrated, each with its unit, its limits, and the manoeuvre that determines it.

All values are corrections: 0 is what is configured. Factors are 1 plus the correction.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

DEFAULT_GROUPS = ("factors", "clock", "yaw")
DEGREE = math.pi / 180.0


@dataclass(frozen=True, slots=True)
class Quantity:
    """A kind of parameter.

    Attributes
    ----------
    group : what it is asked for by
    unit : of its value, for a person
    shown : so many of that unit are one of the estimate's
    prior : sigma of what a driver or a ruler gets wrong, where nothing else is configured
    determined_below : its sigma must be below
    least : a smaller correction is not worth it
    manoeuvre : what to drive where it is not determined
    """

    group: str
    unit: str
    shown: float
    prior: float
    determined_below: float
    least: float
    manoeuvre: str


_LENGTH = ("m", 1.0, 0.05, 0.02, 0.01)
_NEAR = "turn on the spot between landmarks, some of them to the sides"
_ANGLE = ("deg", 1.0 / DEGREE, 0.5, DEGREE, 0.5 * DEGREE)
_AHEAD = "drive 10 m straight past landmarks, twice"
_SCALE = ("%", 100.0, 0.2, 0.03, 0.01)
_NEAR_AND_FAR = "pass landmarks near and far, within one drive"

QUANTITIES = {
    "distance": Quantity("factors", *_SCALE, "drive 10 m and back in sight of the same landmarks"),
    "turn": Quantity("factors", *_SCALE, "drive a figure of eight, so that the same landmarks are seen after turns"),
    "bend": Quantity("", "%", 100.0, 0.3, 0.03, 0.01, "drive straight and in bends"),
    "turn_bias": Quantity("turn_bias", "rad/s", 1.0, 0.05, 0.002, 0.001, "drive straight and turn both ways"),
    "clock": Quantity("clock", "s", 1.0, 0.5, 0.03, 0.01, "turn on the spot, to and fro, in sight of landmarks"),
    "roll": Quantity("yaw", *_ANGLE, _AHEAD),
    "pitch": Quantity("yaw", *_ANGLE, _AHEAD),
    "yaw": Quantity("yaw", *_ANGLE, _AHEAD),
    "x": Quantity("mount", *_LENGTH, _NEAR),
    "y": Quantity("mount", *_LENGTH, _NEAR),
    "z": Quantity("mount", *_LENGTH, "drive up a ramp and down, so that the robot tilts in sight of landmarks"),
    "range_offset": Quantity("range_offset", "m", 1.0, 0.5, 0.1, 0.02, _NEAR_AND_FAR),
    "range_factor": Quantity("range_factor", *_SCALE, _NEAR_AND_FAR),
}
GROUPS = tuple(dict.fromkeys(quantity.group for quantity in QUANTITIES.values() if quantity.group))
AUTO = "auto"
"""The groups of ``DEFAULT_GROUPS``; where all landmarks have ranges alone, these instead of odometry's distance."""
FACTORS = ("distance", "turn")
BEND = "bend"
"""What odometry's distance is wrong by in bends alone. No setting corrects it, but other parameters absorb it."""
OF_ODOMETRY = (*FACTORS, BEND, "turn_bias")
IN_SPACE = ("roll", "pitch", "z")
"""Corrections of a mount that only space has."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter: a quantity of an input, with a name of ``QUANTITIES``."""

    source: str
    name: str

    @property
    def quantity(self) -> Quantity:
        """Return the row of its quantity."""
        return QUANTITIES[self.name]

    def shown(self, value: float, digits: int = 2) -> str:
        """A value of it in its unit, as text."""
        unit = self.quantity.unit
        return f"{value * self.quantity.shown:.{digits}g}{' ' * bool(unit)}{unit}"

    def with_sigma(self, value: float, sigma: float) -> str:
        """A value of it with its sigma, as text."""
        return f"{self.shown(value, 3)}, sigma {self.shown(sigma)}"

    def __str__(self) -> str:
        return f"{self.name.replace('_', ' ')} of {self.source}"


Values = Mapping[Parameter, float]


def parameters_of(
    odometries: Collection[str],
    kinds: Mapping[str, Collection[str]],
    groups: Collection[str],
    *,
    dimensions: int,
    has_scale: bool,
) -> list[Parameter]:
    """The parameters of some groups that edges depend on.

    With ``auto``, where all inputs of landmarks have ranges alone, these have an offset and a factor, as radios do, and
    odometry keeps its scale: one of the two must. So does it where bearings alone tell no scale.

    Parameters
    ----------
    odometries, kinds : inputs of odometry; the kinds of edges of each input of landmarks
    has_scale : whether something besides odometry and new landmarks has a scale
    """
    excluded = set() if dimensions == 3 else set(IN_SPACE)
    if AUTO in groups:
        groups = {*groups, *DEFAULT_GROUPS}
        if kinds and all(map(only_ranges, kinds.values())):
            groups |= {"range_factor", "range_offset"}
            excluded.add("distance")
        if kinds and all(kind.startswith("bearing") for some in kinds.values() for kind in some) and not has_scale:
            excluded.add("distance")
    if any("offset" in kind for some in kinds.values() for kind in some):
        excluded.add("range_offset")  # it is an unknown of the graph
    found = []
    for name, quantity in QUANTITIES.items():
        if quantity.group not in groups or name in excluded:
            continue
        if name in OF_ODOMETRY:
            found += [Parameter(source, name) for source in odometries if len(odometries) == 1]
        elif quantity.group == "yaw":
            found += [Parameter(source, name) for source, some in kinds.items() if not only_ranges(some)]
        elif name.startswith("range"):
            found += [Parameter(source, name) for source, some in kinds.items() if "range" in " ".join(some)]
        else:
            found += [Parameter(source, name) for source in kinds]
    return found


def only_ranges(kinds: Collection[str]) -> bool:
    """Return whether kinds of edges measure distances alone."""
    return all(kind.startswith("range") and kind != "range and bearing" for kind in kinds)
