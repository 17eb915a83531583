"""Names of topics tell which robot of a recording they are of, and which are the truth."""

import re
from collections.abc import Sequence

WORD = r"(^|[/_])({})([/_\d]|$)"
_TRUTH = re.compile(
    WORD.format(r"ground_?truth|groundtruth|truth|true|gt|reference|vicon|vrpn\w*|mocap|optitrack|qualisys|p3d|leica"),
    re.IGNORECASE,
)


def is_truth(topic: str) -> bool:
    """Return whether a topic has the truth, by its name: no sensor of the robot measured it."""
    return _TRUTH.search(topic) is not None


def landmarks_of_other_robots(odometry: str, odometries: Sequence[str], landmarks: Sequence[str]) -> dict[str, str]:
    """Return topics of landmarks in the namespace of another odometry, each with the reason to leave it out.

    Parameters
    ----------
    odometry : the topic in use; if no landmarks are in its namespace, all may be of its robot
    odometries, landmarks : all topics
    """
    own, out = _namespace(odometry), dict[str, str]()
    if not own or all(_namespace(name) != own for name in landmarks):
        return out
    for other in odometries:
        for name in landmarks:
            if _namespace(name) == _namespace(other) != own:
                out[name] = f"of the robot of {other}: --odom {other} --landmarks {name} replay that one"
    return out


def _namespace(topic: str) -> str:
    """The first part of a topic's name; empty where it has only one."""
    return topic.lstrip("/").partition("/")[0] if topic.count("/") > 1 else ""
