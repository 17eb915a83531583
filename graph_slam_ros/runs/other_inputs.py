"""Inputs that a recording has beside the usual ones, or in place of them."""

from collections.abc import Collection
from pathlib import Path

from graph_slam_ros.messages.from_msg import TF, TF_STATIC
from graph_slam_ros.messages.inputs.landmark_types import LANDMARK_TYPES
from graph_slam_ros.recordings.bag import BagError, open_bag
from graph_slam_ros.recordings.contents import recording_of
from graph_slam_ros.runs.chosen_inputs import choose_inputs
from graph_slam_ros.runs.namespaces import is_truth
from graph_slam_ros.runs.suggestion import DETECTIONS, GNSS, ODOMETRY, Suggestion
from graph_slam_ros.slam import Config

_MEASURED = (ODOMETRY, DETECTIONS, GNSS, *LANDMARK_TYPES)


def suggestion_without_landmarks(path: Path, config: Config, odometry: str | None) -> Suggestion | None:
    """Return how to replay a recording that has no landmarks of the usual type, but others, or fixes.

    None where it has, where other inputs are configured, where there is nothing else in it, or where it would be with
    another odometry.

    Parameters
    ----------
    odometry : its topic; None: the suggested one

    Raises
    ------
    BagError
        It cannot be read.
    """
    if config.inputs.names != Config().inputs.names:
        return None
    bag = open_bag(path)
    try:
        if any(name not in ("odom", TF, TF_STATIC) for name in choose_inputs(bag, config, odometry).topics):
            return None
    except BagError:  # which the replay says
        return None
    found = Suggestion(bag, recording_of(bag), path)
    is_other = odometry is not None and found.topics.get("odom") != odometry  # its frames are those of another
    return None if found.trouble or len(found.names) < 2 or is_other else found


def unused_topics(path: Path, used: Collection[str]) -> list[str]:
    """Topics of a recording that have odometry, landmarks or fixes by their type, and that no input was read from.

    Parameters
    ----------
    used : topics of the inputs
    """
    topics = (one for one in open_bag(path).topics.values() if one.count and one.type in _MEASURED)
    return sorted(f"{one.name} ({one.type})" for one in topics if one.name not in used and not is_truth(one.name))
