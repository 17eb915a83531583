"""Parameters of outlier rejection."""

from dataclasses import dataclass

from graph_slam_ros.config.loss import LEAST_LOSS_SCALE, LOSSES
from graph_slam_ros.config.parameter import setting


@dataclass(frozen=True, slots=True)
class RobustConfig:
    """Outlier rejection of closures, sightings and fixes."""

    decide: bool = setting(
        True, "true: unlikely measurements are held back and outliers removed; false: only the robust loss protects"
    )
    gate: float = setting(
        0.9999,
        "a measurement is held back if its innovation is outside this probability of the chi2 distribution",
        "probability",
        low=0.5,
        high=1.0 - 1e-12,
    )
    noise_factor: float = setting(
        2.0,
        "the gate allows for noise this many times larger than stated, or than residuals show where these are smaller",
        "times",
        low=1.0,
    )
    noise_scale: str = setting(
        "estimated",
        "noise of all inputs: estimated: as messages and parameters state it, times factors from the residuals, for "
        "each input and class of edges, from 50 keyframes on; configured: without factors",
        choices=("configured", "estimated"),
    )
    loss: str = setting(
        "dcs", "robust loss of closures and fixes; geman_mcclure and dcs give outliers no weight", choices=LOSSES[:5]
    )
    loss_scale: float = setting(
        2.0,
        "residuals of closures and fixes well below this many standard deviations keep their full weight",
        "sigma",
        low=LEAST_LOSS_SCALE,
    )
    second_look_after: int = setting(
        10,
        "a search for better hypotheses starts in the background when so many more measurements are "
        "rejected than at the last, and half as many again; 0: only at the end or on request",
        "edges",
        low=0,
        high=1_000_000,
    )
    apply_after_keyframes: int = setting(
        20,
        "the result of a search for better hypotheses is adopted this many keyframes after it started",
        "keyframes",
        low=1,
        high=1_000_000,
    )
