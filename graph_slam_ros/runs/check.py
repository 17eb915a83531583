"""The check of a recording: choose its inputs, read it once, collect all findings."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.check.checks import check_columns, with_inputs
from graph_slam_ros.check.columns import Columns
from graph_slam_ros.check.gyro import of_gyro_or_wheels
from graph_slam_ros.check.moving_landmarks import moving_names, without
from graph_slam_ros.check.trial import check_doubted, check_trial, replayed
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.findings.finding import Finding, Severity, in_order, with_one_value
from graph_slam_ros.measurements.types import Measured, Sightings
from graph_slam_ros.messages.inputs import known_types
from graph_slam_ros.messages.inputs.transforms import MAP_FRAMES
from graph_slam_ros.overview.suggested_odometry import ODOMETRY
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import Progress, RecordedRuns
from graph_slam_ros.runs.suggestion import OF_LANDMARKS, Suggestion
from graph_slam_ros.slam import Config, Control
from graph_slam_ros.warmup import warmup

_UNNAMED_NS = 120_000_000_000
Measurements = list[Measured | Control]


@dataclass(frozen=True, slots=True)
class Checked:
    """The outcome of a check.

    Attributes
    ----------
    findings : the most severe first
    suggestion : of the replay that was checked; None where there is none
    losses, warnings : what could not be read
    """

    findings: list[Finding]
    suggestion: Suggestion | None
    losses: list[str]
    warnings: list[str]

    @property
    def is_clean(self) -> bool:
        """Return whether nothing is above a note."""
        return all(one.severity == "note" for one in self.findings)


def check(
    path: Path | str,
    settings: Mapping[str, Any] | None = None,
    *,
    odometry: str | None = None,
    landmarks: str | None = None,
    quick: bool = False,
    progress: Progress = lambda items, total: items,
) -> Checked:
    """Check a recording as a replay with the settings of ``graph_slam info`` would use it.

    Parameters
    ----------
    settings : parameters by dotted name, which come before those that ``info`` chooses
    odometry, landmarks : topics, instead of those that ``info`` chooses
    quick : leave out what needs a replay and a fit
    progress : wraps the sequence of messages
    """
    path, settings = Path(path), dict(settings or {})
    bag = open_bag(path)
    suggestion = Suggestion(bag, path, odometry, landmarks, settings)
    found = list(_unused(suggestion, has_landmarks=landmarks is not None))
    if suggestion.trouble and odometry is None and not settings:
        if all(one.severity != "error" for one in found):  # which say why
            text = f"not ready for replay: {suggestion.trouble}"
            found.append(Finding("no_odometry", "error", 0, 1, "topics", text))
        return Checked(in_order(found), None, bag.losses, bag.warnings)
    config = Config.from_mapping(suggestion.assumed | settings)
    inputs = suggestion.inputs(config)
    runs = RecordedRuns(bag, inputs, config, assumed=suggestion.assumed)
    measured = [(number, some) for number, some in progress(runs, runs.count) if some and not quick]
    columns = runs.columns()
    found += [Finding("damaged", "error", 1, 0, "parts", loss) for loss in dict.fromkeys(bag.losses)]
    found += check_columns(columns)
    if not quick and not any(one.ends or one.forbids_replay for one in found):
        moving = moving_names(columns)
        some = _for_trial(columns, [some for number, some in measured if number == 0])
        some = [_without(one, moving) for one in some] if moving else some
        found += with_inputs(columns, _trial(without(columns, moving), some))
    perhaps = [f"{name}: {suggestion.unused[name]}" for name in suggestion.perhaps]  # which may have landmarks
    found = [replace(f, text="; ".join([f.text, *perhaps])) if f.code == "no_landmarks" else f for f in found]
    found = with_one_value(in_order(dict.fromkeys(of_gyro_or_wheels(found, config.gyro_input))))
    return Checked(found, None if suggestion.trouble else suggestion, bag.losses, bag.warnings)


def _for_trial(columns: Columns, measured: list[Measurements]) -> list[Measurements]:
    """Return what is replayed in memory: the beginning, where landmarks have no identity and association is slow."""
    seen = [s for s in columns.sightings if len(s.name)]
    unnamed = sum(np.count_nonzero(s.name == s.names.index("")) for s in seen if "" in s.names)
    if unnamed <= 0.5 * sum(len(s.name) for s in seen):
        return measured
    end_ns = min(int(s.stamp_ns.min()) for s in seen) + _UNNAMED_NS
    return [some for some in measured if all(getattr(m, "stamp_ns", 0) <= end_ns for m in some)]


def _without(measured: Measurements, moving: Mapping[str, Collection[str]]) -> Measurements:
    """Return measurements without sightings of what moves."""
    return [
        replace(m, sightings=tuple(one for one in m.sightings if one.id not in moving.get(m.topic, ())))
        if isinstance(m, Sightings)
        else m
        for m in measured
    ]


def _trial(columns: Columns, measured: list[Measurements]) -> list[Finding]:
    """Findings of a replay in memory; none if the pipeline fails with such measurements, which a replay reports."""
    warmup(dimensions=columns.config.world.dimensions)
    found = list[Finding]()
    try:
        with np.errstate(all="ignore"):
            slam = replayed(columns.config, (m for some in measured for m in some))
            found += check_doubted(columns, slam.view.gyro)
            found += check_trial(columns, slam.view)  # one by one: what was found before an error stays
    except GraphSlamError as error:
        found.append(Finding("fit_unsure", "warning", 1, 0, "replays", f"a replay fails: {error}"))
    return found


def _unused(suggestion: Suggestion, *, has_landmarks: bool) -> Iterator[Finding]:
    """Topics that are meant as landmarks or odometry, and that cannot be used."""
    has_landmarks = has_landmarks or any(name not in ("odom", "gps", "imu", "pose") for name in suggestion.names)
    for name, why in suggestion.unused.items():
        one = suggestion.recording.topics[name]
        is_landmark = one.topic.type in OF_LANDMARKS and one.topic.type in known_types()
        if one.topic.type == ODOMETRY and one.frame in MAP_FRAMES:
            text = f"{name} is {why}"
            severity: Severity = "note" if "odom" in suggestion.topics else "error"
            yield Finding("odometry_in_map", severity, 1, 0, "topics", text, name, count=one.topic.count)
        elif (is_landmark or one.topic.type == ODOMETRY) and (one.trouble or one.is_zero):
            code = "zero_stamp" if one.is_zero else "input_unused"
            text = f"{name} is not used: {why}"
            severity = "note" if has_landmarks and is_landmark else "error"
            yield Finding(code, severity, 1, 0, "topics", text, name, count=one.topic.count)
