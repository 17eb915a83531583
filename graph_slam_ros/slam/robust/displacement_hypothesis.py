"""A pose at which the robot may be instead of where odometry has it, and the evidence for it."""

from dataclasses import dataclass

from graph_slam_ros.typing import Numbers


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
