"""A change of what was solved, as data: what a policy proposes. ``Backend.apply`` is the only place that does it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.slam.noise.factors import Key
from graph_slam_ros.slam.robust.ledger import Ledger, Reason
from graph_slam_ros.solver import Report, Settings
from graph_slam_ros.typing import Array, Index, Numbers


@dataclass(frozen=True, slots=True)
class Replacement:
    """An edge of odometry that is out, and the motion and noise of the edge that takes its place."""

    edge: int
    motion: Numbers | Array
    noise: Gaussian


@dataclass(frozen=True, slots=True)
class Remeasured:
    """Other measurements (n, p) and square roots of information of some rows of a table."""

    table: EdgeTable
    rows: Index
    measured: Array
    sqrt_information: Array


@dataclass(frozen=True, slots=True)
class Revision:
    """A change of what was solved. Its parts take effect in this order.

    Attributes
    ----------
    noise : factors of the configured sigmas, by group of edges
    remeasured : what edges measured
    withdrawn : edges that are out for good, for ``reason``; and a ``vertex`` that goes with them
    replaced : edges of odometry, for ``reason``
    restored : edges that were withdrawn or replaced and are used again, each with what took its place, or -1
    verdicts : a ledger whose verdicts on the edges that it has are taken over
    values : stored numbers of all vertices to go on from
    is_judged_anew : whether all candidates are judged at these values
    accepted, rejected : candidates; solved until those that are accepted fit
    compared : candidates that are compared with all that is known
    solves : what is solved then: all of it, what is new, or nothing
    settings : of a solve of all; None: those of the solver
    reason, evidence, threshold : noted of edges that are replaced or restored
    """

    noise: Mapping[Key, float] | None = None
    remeasured: Sequence[Remeasured] = ()
    withdrawn: Sequence[int] = ()
    vertex: int | None = None
    replaced: Sequence[Replacement] = ()
    restored: Sequence[tuple[int, int]] = ()
    verdicts: Ledger | None = None
    values: Array | None = None
    is_judged_anew: bool = False
    accepted: Sequence[int] = ()
    rejected: Sequence[int] = ()
    compared: Sequence[int] = ()
    solves: Literal["all", "new", "nothing"] = "new"
    settings: Settings | None = None
    reason: Reason = Reason.NONE
    evidence: float = 0.0
    threshold: float | None = None


@dataclass(frozen=True, slots=True)
class Applied:
    """A revision that took effect.

    Attributes
    ----------
    replaced : edges that are out, each with what took its place: ``restored`` of the revision that undoes this
    report : of a solve of all
    """

    replaced: tuple[tuple[int, int], ...] = ()
    report: Report | None = None
