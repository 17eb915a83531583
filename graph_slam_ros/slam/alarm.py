"""An alarm: a time when the landmarks said that the robot was elsewhere than odometry."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Alarm:
    """A time when the landmarks said that the robot was elsewhere than odometry.

    Attributes
    ----------
    began_ns, ended_ns : stamps of odometry; None while it goes on
    evidence : sightings more for another pose than for odometry's, at most; 0 where none was found
    segment : the keyframe, by its index, at which a segment begins since it was decided so; None where it was not
    distance_m, angle_rad : how far the robot was moved there, against odometry
    held_back, tested : when it began, of the newest sightings how many were held back, and all
    determines_pose : whether what is held back can tell a pose; ranges and bearings alone do not
    outcome : what came of it otherwise: it ended undecided since a segment began, or what was decided was taken back
    """

    began_ns: int
    evidence: int
    ended_ns: int | None = None
    segment: int | None = None
    distance_m: float = 0.0
    angle_rad: float = 0.0
    held_back: int = 0
    tested: int = 0
    determines_pose: bool = True
    outcome: str = ""

    def __str__(self) -> str:
        at = f"{self.began_ns * 1e-9:.1f} s"
        if self.segment is not None:
            moved = f"{self.distance_m:.2f} m and {np.rad2deg(self.angle_rad):.1f} degrees"
            return (
                f"the landmarks said at {at} that the robot is elsewhere, {moved} from where odometry had it: "
                f"a segment begins at keyframe {self.segment}{self.outcome and '; '}{self.outcome}"
            )
        why = f"{self.evidence} sightings more than not"
        if not self.evidence:
            why = f"{self.held_back} of the last {self.tested} sightings contradict odometry"
            why = why if self.held_back else "what should be seen there is not"
        if self.ended_ns is None:
            remedy = (
                "" if self.determines_pose else "; ranges or bearings alone do not determine the pose: give initialpose"
            )
            return f"the landmarks say since {at} that the robot is elsewhere ({why}){remedy}"
        until = f"{self.ended_ns * 1e-9:.1f} s"
        outcome = self.outcome or "it was not so"
        return f"from {at} to {until} the landmarks said that the robot is elsewhere ({why}); {outcome}"
