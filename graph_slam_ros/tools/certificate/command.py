"""The part of the command ``optimize`` that certifies a solution."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from graph_slam_ros.cli import console
from graph_slam_ros.cli.optimize import STARTS
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.optimization import optimize
from graph_slam_ros.tools.certificate import CERTIFIED, NOT_CERTIFIED, Certificate, certify, other_start

if TYPE_CHECKING:
    from graph_slam_ros.optimization import Solution
    from graph_slam_ros.solver import Settings

_SAME = 1e-6  # of chi2: what one optimum may differ by from another run to it


@dataclass(frozen=True, slots=True)
class Proof:
    """The certificate of a solution, and the outcome of a second start if the first was not certified."""

    first: "Certificate"
    start: str = ""
    second: "Certificate | None" = None
    failure: str = ""

    @property
    def code(self) -> int:
        """The exit code."""
        codes = {CERTIFIED: console.DONE, NOT_CERTIFIED: console.NOT_CERTIFIED}
        return codes.get(self.first.verdict, console.NOT_APPLICABLE)

    def as_dict(self) -> dict[str, Any]:
        """The certificates for JSON."""
        again = {"start": self.start, "failure": self.failure} | (self.second.as_dict() if self.second else {})
        return self.first.as_dict() | {"second_start": again if self.start else None}

    def text(self, chi2: float) -> Iterable[str]:
        """Yield the lines for a person."""
        yield from str(self.first).splitlines()
        if self.failure:
            yield f"a second start, {STARTS[self.start]}, fails: {self.failure}"
        elif self.second:
            lower = self.second.chi2 < chi2 * (1.0 - _SAME)
            much = f"which is lower: --init {self.start} takes it" if lower else "which is no lower"
            yield f"a second start, {STARTS[self.start]}, comes to chi2 {self.second.chi2:.6f}, {much}"
            yield from ("  " + line for line in str(self.second).splitlines())


def certified(solution: "Solution", settings: "Settings") -> Proof:
    """Compute the certificate. If it fails and could succeed from another start, try that one."""
    first = certify(solution)
    if first.verdict == CERTIFIED or not first.computed:
        return Proof(first)
    start = other_start(solution.start)
    try:
        return Proof(first, start, certify(optimize(solution.file, settings, init=start)))
    except GraphSlamError as error:
        return Proof(first, start, failure=str(error))
