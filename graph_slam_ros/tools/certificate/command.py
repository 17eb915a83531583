"""The part of the command ``optimize`` that certifies a solution."""

from typing import TYPE_CHECKING

from graph_slam_ros.cli import console
from graph_slam_ros.tools.certificate import CERTIFIED, NOT_CERTIFIED, Certificate, certify

if TYPE_CHECKING:
    from graph_slam_ros.optimization import Solution


def certified(solution: "Solution") -> tuple[Certificate, int, str]:
    """Return the certificate of a solution, its exit code, and its lines for a person."""
    found = certify(solution)
    codes = {CERTIFIED: console.DONE, NOT_CERTIFIED: console.NOT_CERTIFIED}
    again = found.verdict == NOT_CERTIFIED and solution.start != "chordal"
    more = "\nanother start may lead to a lower optimum: --init chordal" if again else ""
    return found, codes.get(found.verdict, console.NOT_APPLICABLE), f"{found}{more}"
