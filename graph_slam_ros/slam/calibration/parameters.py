"""The parameters that may be calibrated, each with its unit, its limits, and the manoeuvre that determines it.

All values are corrections: 0 is what is configured. Factors are 1 plus the correction.
"""

import math
from dataclasses import dataclass

DEFAULT_GROUPS = ("factors", "clock", "yaw")
_DEGREE = math.pi / 180.0


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
    probe : step of its numerical derivative
    manoeuvre : what to drive where it is not determined
    """

    group: str
    unit: str
    shown: float
    prior: float
    determined_below: float
    least: float
    probe: float
    manoeuvre: str


_LENGTH = ("m", 1.0, 0.05, 0.02, 0.01, 1e-4)
_NEAR = "turn on the spot between landmarks, some of them to the sides"
_ANGLE = ("deg", 1.0 / _DEGREE, 0.5, _DEGREE, 0.5 * _DEGREE, 1e-4)
_AHEAD = "drive 10 m straight past landmarks, twice"
_SCALE = ("%", 100.0, 0.2, 0.03, 0.01, 1e-4)

QUANTITIES = {
    "distance": Quantity("factors", *_SCALE, "drive 10 m and back in sight of the same landmarks"),
    "turn": Quantity("factors", *_SCALE, "drive a figure of eight, so that the same landmarks are seen after turns"),
    "bend": Quantity("", "%", 100.0, 0.3, 0.03, 0.01, 1e-4, "drive straight and in bends"),
    "turn_bias": Quantity("turn_bias", "rad/s", 1.0, 0.05, 0.002, 0.001, 1e-4, "drive straight and turn both ways"),
    "clock": Quantity("clock", "s", 1.0, 0.5, 0.03, 0.01, 0.02, "turn on the spot, to and fro, in sight of landmarks"),
    "roll": Quantity("yaw", *_ANGLE, _AHEAD),
    "pitch": Quantity("yaw", *_ANGLE, _AHEAD),
    "yaw": Quantity("yaw", *_ANGLE, _AHEAD),
    "x": Quantity("mount", *_LENGTH, _NEAR),
    "y": Quantity("mount", *_LENGTH, _NEAR),
    "z": Quantity("mount", *_LENGTH, "drive up a ramp and down, so that the robot tilts in sight of landmarks"),
    "range_offset": Quantity(
        "range_offset", "m", 1.0, 0.5, 0.1, 0.02, 1e-4, "pass landmarks near and far, within one drive"
    ),
    "range_factor": Quantity("range_factor", *_SCALE, "pass landmarks near and far, within one drive"),
}
GROUPS = tuple(dict.fromkeys(quantity.group for quantity in QUANTITIES.values() if quantity.group))
AUTO = "auto"
"""The groups of ``DEFAULT_GROUPS``; where all landmarks have ranges alone, these instead of odometry's distance."""
FACTORS = ("distance", "turn")
BEND = "bend"
"""What odometry's distance is wrong by in bends alone. No setting corrects it, but other parameters absorb it."""
OF_ODOMETRY = (*FACTORS, BEND, "turn_bias")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter: a quantity of an input, with a name of ``QUANTITIES``."""

    source: str
    name: str

    @property
    def quantity(self) -> Quantity:
        """Return the row of its quantity."""
        return QUANTITIES[self.name]

    def __str__(self) -> str:
        return f"{self.name.replace('_', ' ')} of {self.source}"
