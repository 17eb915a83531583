"""The inputs of a recording as ``graph_slam info`` suggests them, with what the user has chosen."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from graph_slam_ros.config import Config
from graph_slam_ros.config.inputs import default_input
from graph_slam_ros.messages.from_msg import TF, TF_STATIC
from graph_slam_ros.messages.inputs.landmark_types import LANDMARK_TYPES
from graph_slam_ros.overview.chosen_inputs import Inputs, choose_inputs, is_truth
from graph_slam_ros.overview.contents import recording_of
from graph_slam_ros.overview.suggested_odometry import DETECTIONS, ODOMETRY
from graph_slam_ros.recordings.bag import Bag, BagError, open_bag
from graph_slam_ros.runs.suggestion import CLOUD, GNSS, Suggestion

OF_LANDMARKS = frozenset({DETECTIONS, CLOUD, *LANDMARK_TYPES})
"""Types of messages that have landmarks."""

_MEASURED = (ODOMETRY, DETECTIONS, GNSS, *LANDMARK_TYPES)


class SuggestedInputs:
    """The suggestion for a recording, and what of it holds where the user has chosen some parameters and topics.

    Parameters
    ----------
    given : parameters by dotted name, which come before those that are suggested
    odometry, landmarks : topics; the suggestion is that for a recording in which they are the only ones of their kinds

    Attributes
    ----------
    suggestion : for the recording
    assumed : the suggested parameters that the user has not chosen; none where the inputs are given
    settings : these and the given ones
    """

    def __init__(
        self,
        bag: Bag,
        path: Path,
        given: Mapping[str, Any] | None = None,
        odometry: str | None = None,
        landmarks: str | None = None,
    ) -> None:
        given = given or {}
        self._bag, self._has_names = bag, "inputs.names" in given
        if not self._has_names:
            odometry, landmarks = odometry or _topic_of(given, "odom"), landmarks or _topic_of(given, "detections")
        self._odometry, self._landmarks = odometry, landmarks
        self.recording = recording_of(bag)
        topics = dict(self.recording.topics)
        if odometry in topics:
            kind = topics[odometry].topic.type
            topics = {name: one for name, one in topics.items() if name == odometry or one.topic.type != kind}
        if landmarks in topics:
            topics = {n: one for n, one in topics.items() if n == landmarks or one.topic.type not in OF_LANDMARKS}
        self.suggestion = Suggestion(bag, replace(self.recording, topics=topics), path)
        is_suggested = not self.suggestion.trouble and not self._has_names
        suggested = self.suggestion.settings if is_suggested else {}
        self.assumed = {name: value for name, value in suggested.items() if name not in given}
        self.settings = self.assumed | dict(given)

    def inputs(self, config: Config) -> Inputs:
        """The topics of the inputs of a configuration: named, suggested, configured, or the only ones of their types.

        Raises
        ------
        BagError
            A topic does not exist or has another type, or there is none.
        """
        odometry, landmarks = self._odometry or self._topic("odom", config), self._topic("detections", config)
        return choose_inputs(self._bag, config, odometry, self._landmarks or landmarks)

    def _topic(self, name: str, config: Config) -> str | None:
        if self._has_names or self.suggestion.trouble:
            return None
        is_used = any(one.name == name and one.use != "none" for one in config.sources)
        return self.suggestion.topics.get(name) if is_used else None


def _topic_of(given: Mapping[str, Any], name: str) -> str | None:
    """The topic that somebody has given an input, with its slash."""
    topic = given.get(f"{name}.topic")
    return None if topic is None else f"/{str(topic).lstrip('/')}"


def suggestion_for_other_types(path: Path, config: Config, odometry: str | None = None) -> Suggestion | None:
    """Return how to replay a recording whose odometry or landmarks are of other types than the usual, or are fixes.

    None where they are usual, where other inputs are configured, or where there is nothing else in it.

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
        is_usual = next(one for one in config.sources if one.name == "odom") == default_input("odom")
        if odometry or not is_usual or any(topic.type == ODOMETRY for topic in bag.topics.values()):
            return None
    found = SuggestedInputs(bag, path, odometry=odometry).suggestion
    return None if found.trouble or len(found.names) < 2 else found


def unused_topics(path: Path, used: Collection[str]) -> list[str]:
    """Topics of a recording that have odometry, landmarks or fixes by their type, and that no input was read from.

    Parameters
    ----------
    used : topics of the inputs
    """
    topics = (one for one in open_bag(path).topics.values() if one.count and one.type in _MEASURED)
    return sorted(f"{one.name} ({one.type})" for one in topics if one.name not in used and not is_truth(one.name))
