"""Parameters of what is believed."""

from dataclasses import dataclass

from graph_slam_ros.config.parameter import setting
from graph_slam_ros.graph import Loss

_WIDE = 2.3  # times as wide in the end: 4.6 standard deviations, the gate of three numbers
LOSSES = ("none", "huber", "cauchy", "geman_mcclure", "dcs")


@dataclass(frozen=True, slots=True)
class RobustConfig:
    """Which closures, sightings and fixes are believed."""

    decide: bool = setting(True, "whether measurements are held back and taken out; false: the loss alone protects")
    gate: float = setting(
        0.9999,
        "a measurement that is less likely than all but this part, given what is known, is held back",
        "probability",
        low=0.5,
        high=1.0 - 1e-12,
    )
    noise_factor: float = setting(
        2.0,
        "noise may be so many times worse than it is said to be, or than residuals show where they are smaller",
        "times",
        low=1.0,
    )
    loss: str = setting(
        "dcs", "of closures and fixes; geman_mcclure and dcs let go of what does not fit", choices=LOSSES
    )
    loss_scale: float = setting(2.0, "residuals well below this many standard deviations count fully", "sigma", low=0.1)
    out_below: float = setting(
        0.01,
        "what pulls with a smaller part of its weight is taken out",
        "part of weight",
        low=0.0,
        high=1.0,
    )
    review_every_keyframes: int = setting(
        20,
        "verdicts, the newest and others in turn, are looked at again after this many keyframes",
        "keyframes",
        low=1,
        high=1_000_000,
    )
    retests: int = setting(
        10, "held back, so many are compared with what is known then, in turn", "edges", low=0, high=1_000_000
    )
    rounds: int = setting(10, "of solving everything and looking at all verdicts again", "rounds", low=1, high=1000)
    second_look_after: int = setting(
        10,
        "in the background everything is explained anew when so many more are held back or taken out than at the last,"
        " and half as many again; 0: only at the end or when asked to",
        "edges",
        low=0,
        high=1_000_000,
    )
    apply_after_keyframes: int = setting(
        20, "what that finds is taken over so many keyframes later", "keyframes", low=1, high=1_000_000
    )

    @property
    def stages(self) -> list[Loss]:
        """The loss of closures and fixes: close at first, so that what is far off bends nothing; then wide.

        What fits so well that the gate lets it pass counts fully then: without outliers the optimum is the plain one.
        """
        return [Loss.named(self.loss, self.loss_scale), Loss.named(self.loss, _WIDE * self.loss_scale)]
