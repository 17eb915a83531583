"""Robust losses rho(s) of the squared whitened residual s = r' Omega r, used as IRLS weights rho'(s).

Huber 1964; Cauchy and Geman-McClure as in Black and Rangarajan 1996; dynamic covariance scaling (DCS), Agarwal et al.,
ICRA 2013, with Phi = scale^2. The last two redescend: what fits badly enough does not pull at all. With loss ``none``
the cost is chi2 itself.
"""

from dataclasses import dataclass

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie.jit import jitable

NONE, HUBER, CAUCHY, GEMAN_MCCLURE, DCS = range(5)
NAMES = {"none": NONE, "huber": HUBER, "cauchy": CAUCHY, "geman_mcclure": GEMAN_MCCLURE, "dcs": DCS}


@dataclass(frozen=True, slots=True)
class Loss:
    """A loss and its scale in standard deviations: residuals well below it count fully."""

    kind: int = NONE
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in NAMES.values() or not 0.0 < self.scale < np.inf:
            raise GraphSlamError(f"loss {self.kind} of scale {self.scale}: no such loss, or not a positive scale")

    @classmethod
    def named(cls, name: str, scale: float = 1.0) -> "Loss":
        """Make a loss from its name, one of ``NAMES``."""
        if name not in NAMES:
            raise GraphSlamError(f"loss {name!r}: choose {', '.join(NAMES)}")
        return cls(NAMES[name], scale)


@jitable
def weight_and_cost(kind: int, scale: float, s: float) -> tuple[float, float]:
    """(rho'(s), rho(s)) for one squared residual."""
    if kind == HUBER and s > scale * scale:
        root = np.sqrt(s)
        return scale / root, scale * (2.0 * root - scale)
    if kind == CAUCHY:
        ratio = s / (scale * scale)
        return 1.0 / (1.0 + ratio), scale * scale * np.log1p(ratio)
    if kind == GEMAN_MCCLURE:
        root = 1.0 / (1.0 + s / (scale * scale))
        return root * root, root * s
    if kind == DCS and s > scale * scale:
        phi = scale * scale
        root = 2.0 * phi / (phi + s)
        return root * root, phi * (3.0 * s - phi) / (phi + s)
    return 1.0, s
