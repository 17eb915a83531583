"""The settings of the solver. Parameters import them alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeAlias

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.losses import Loss

METHODS = ("gn", "lm", "dogleg")
_STILL = 1e-8  # m and rad
LossKey: TypeAlias = str | tuple[str, str]
"""A label of edges, or a label and the source of the edges."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the solver, online and in batch.

    Attributes
    ----------
    method : of ``optimize``: ``gn`` (damped only after it fails to converge), ``lm`` or ``dogleg``
    max_iterations : of each stage
    step_tolerance : converged when no component of a step is larger [m, rad]
    cost_tolerance : converged when the cost changes by a smaller fraction
    losses : by label, or by (label, source) for the edges of one source: the stages of the loss. Each is minimised, the
        last until converged; a loss with fewer stages keeps its last. Online an edge has the first at its first update
        and the last from then on
    relinearize_above : online, a vertex is linearised anew when a component of its step is larger [m, rad]; the
        position of a pose in units of the typical motion between two, if that is longer than a metre
    relinearize_error : or when its step squared is more than so many standard deviations of its strongest measurement
    relinearize_every : that is looked for at every so many updates, or after two thirds of these at one that closes a
        loop. Steps ten times as large are looked for at any update
    relinearize_neglected : and so are turns whose square is more than this part of the expected chi2, as in a small
        graph; inf: they wait, and the thresholds do not follow what linearisation neglects
    relinearize_passes : how often at most within one update; after the first time for such steps
    tolerance : online, changes of a step up to this are not followed [m, rad]
    tolerance_sigmas : nor are those up to so many standard deviations of the vertex given its neighbours
    at_once : an update computes the estimates of all vertices that it moves. Else those that nobody reads wait; then
        what is read, and when, decides digits below the tolerances
    """

    method: str = "gn"
    max_iterations: int = 50
    step_tolerance: float = 1e-6
    cost_tolerance: float = 1e-6
    losses: Mapping[Any, Sequence[Loss]] = field(default_factory=dict)
    relinearize_above: float = 0.05
    relinearize_error: float = 0.1
    relinearize_every: int = 10
    relinearize_neglected: float = 5e-5
    relinearize_passes: int = 1
    tolerance: float = 1e-5
    tolerance_sigmas: float = 1e-3
    at_once: bool = False

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise GraphSlamError(f"method {self.method!r}: choose {', '.join(METHODS[:-1])} or {METHODS[-1]}")
        for name in [one.name for one in fields(self) if one.name not in ("method", "losses", "at_once")]:
            least = 1 if name == "relinearize_every" else 0
            if not getattr(self, name) >= least:  # nor is NaN
                raise GraphSlamError(f"{name} {getattr(self, name)}: must be a number >= {least}")
        if not isinstance(self.losses, Mapping):
            raise GraphSlamError(f"losses {self.losses!r}: must be a dict")
        for label, stages in self.losses.items():
            if not isinstance(stages, Sequence) or {type(stage) for stage in stages} != {Loss}:
                raise GraphSlamError(f"losses: {label!r} has {stages!r}: leave it out, or give it a list of Loss")

    def last_loss(self, label: str, source: str) -> Loss:
        """The loss of the last stage of an edge."""
        stages = self.losses.get((label, source)) or self.losses.get(label)
        return stages[-1] if stages else Loss()

    def stages(self) -> list[dict[LossKey, Loss]]:
        """One loss for each key of ``losses``, for each stage."""
        count = max((len(stages) for stages in self.losses.values()), default=1)
        return [{name: s[min(k, len(s) - 1)] for name, s in self.losses.items()} for k in range(count)]

    def until_still(self) -> "Settings":
        """Return settings for an estimate near the optimum: the last stage alone, until no vertex moves."""
        last = {label: stages[-1:] for label, stages in self.losses.items()}
        return replace(self, losses=last, step_tolerance=_STILL, cost_tolerance=0.0)
