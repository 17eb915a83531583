"""Odometry in doubt: its links, what is doubted of it, and displacements that were decided."""

from dataclasses import dataclass

import numpy as np

from graph_slam_ros.typing import Array, Numbers

DOUBT = "odometry"
"""The source that changes of the past for odometry's sake are counted under where they fail."""
ELSEWHERE = "elsewhere"
SLIPS = ("translation", "rotation")


@dataclass(frozen=True, slots=True)
class Doubt:
    """A time when what was seen contradicted odometry.

    Attributes
    ----------
    began_ns, ended_ns : stamps of odometry; None while it goes on
    evidence : of a slip, twice the logarithm of the likelihood ratio to none. Else the sightings more for another pose
        than for odometry's, at most; 0 where none was found
    kind : ``elsewhere``: the robot is elsewhere than odometry; ``translation`` or ``rotation``: that part of it slipped
    segment : the keyframe, by its index, at which a segment begins since it was decided so; None where it was not
    distance_m, angle_rad : how far the robot was moved there, against odometry
    held_back, tested : when it began, of the newest sightings how many were held back, and all
    determines_pose : whether what is held back can tell a pose; ranges and bearings alone do not
    outcome : what came of it otherwise: it ended undecided since a segment began, or what was decided was taken back
    decided_ns, landmarks, edges : of a slip: when, how many landmarks and other classes of edges contradict odometry,
        and how many edges of odometry count for less
    """

    began_ns: int
    evidence: float
    ended_ns: int | None = None
    segment: int | None = None
    distance_m: float = 0.0
    angle_rad: float = 0.0
    held_back: int = 0
    tested: int = 0
    determines_pose: bool = True
    outcome: str = ""
    kind: str = ELSEWHERE
    decided_ns: int | None = None
    landmarks: int = 0
    edges: int = 0

    def __str__(self) -> str:
        began, until = f"{self.began_ns * 1e-9:.1f} s", f"{(self.ended_ns or 0) * 1e-9:.1f} s"
        if self.kind != ELSEWHERE:
            why = f"{self.landmarks} landmarks or other inputs contradict it, evidence {self.evidence:.0f}"
            if self.ended_ns is None:
                return f"odometry in doubt since {began}: its {self.kind} is wrong ({why}); it counts for less"
            outcome = self.outcome or f"{self.edges} edges of odometry count for less"
            return f"odometry was in doubt from {began} to {until}: its {self.kind} was wrong ({why}); {outcome}"
        if self.segment is not None:
            moved = f"{self.distance_m:.2f} m and {np.rad2deg(self.angle_rad):.1f} degrees"
            return (
                f"the landmarks said at {began} that the robot is elsewhere, {moved} from where odometry had it: "
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
            return f"the landmarks say since {began} that the robot is elsewhere ({why}){remedy}"
        outcome = self.outcome or "it was not so"
        return f"from {began} to {until} the landmarks said that the robot is elsewhere ({why}); {outcome}"


@dataclass(slots=True)
class Link:
    """Odometry from one keyframe to the next: the edge ``own``, or ``edge`` that replaces it in the problem.

    Attributes
    ----------
    pose : of the later keyframe by odometry alone, in a frame of its own
    drift : variances [m^2, rad^2] of odometry up to it since that frame began
    """

    edge: int
    own: int
    vertices: tuple[int, int]
    stamps_ns: tuple[int, int]
    pose: Numbers
    drift: Array

    @property
    def seconds(self) -> float:
        """The time that it took."""
        return (self.stamps_ns[1] - self.stamps_ns[0]) * 1e-9


@dataclass(frozen=True, slots=True)
class DisplacementHypothesis:
    """Another pose of the robot, and the evidence for it.

    Attributes
    ----------
    first : the keyframe's vertex from which on the robot is there
    seen_from : that of the oldest sighting that was compared; from ``first`` to there landmarks tell nothing
    T_map_chain : where the evidence's own frame of odometry lies then in map
    evidence : sightings that are held back and fit it, minus those that are believed and do not
    landmarks, keyframes : how many are in agreement
    has_headings : whether the landmarks were seen with their headings, which agree, too
    fitting, contradicting : edges of sightings from ``first`` on that fit and that do not
    rival : the evidence for a pose that differs from it
    """

    first: int
    seen_from: int
    T_map_chain: Numbers
    evidence: int
    landmarks: int
    keyframes: int
    has_headings: bool
    fitting: tuple[int, ...]
    contradicting: tuple[int, ...]
    rival: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """A displacement that was decided.

    Attributes
    ----------
    first : vertex of the keyframe at which the segment begins
    index : of that keyframe; None where a segment began there before
    link, replacement : odometry's edge to it, which is out, and the edge with very large noise that replaces it
    T_map_chain_before, T_map_chain : where the frame of odometry lay before, and lies since
    to_first : odometry to that keyframe, in that frame
    doubt : its index
    """

    first: int
    index: int | None
    link: int
    replacement: int
    T_map_chain_before: Numbers
    T_map_chain: Numbers
    to_first: Link
    doubt: int
