"""The calibration of a recording: replays in memory, each with what the last one found, until nothing changes.

From the last correction by more than a sigma on, a replay is as one with these settings. So it is enough to replay what
came before once more. Where that part finds more, or believes fewer of the measurements, all is replayed.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graph_slam_ros.check.checks import worst_of_replay
from graph_slam_ros.check.columns import Collector
from graph_slam_ros.check.finding import Finding
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.messages.inputs import recorded_uses
from graph_slam_ros.messages.survey import with_survey
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import END, RecordedRuns
from graph_slam_ros.runs.suggested_inputs import SuggestedInputs
from graph_slam_ros.runs.tables import account
from graph_slam_ros.slam import Config, Counters, GraphSlam
from graph_slam_ros.slam.calibration.parameters import OF_ODOMETRY, QUANTITIES, Parameter
from graph_slam_ros.slam.calibration.uncorrected import CODES
from graph_slam_ros.warmup import warmup

_ROUNDS = 4  # replays; a large clock needs two or three
_MOST_REPEATED = 0.8  # of the keyframes: of more, all are
_STILL_ACCEPTED = 0.9  # of the part that was accepted before: with less, what was found does harm

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The outcome of a calibration.

    Attributes
    ----------
    settings : parameters to be set, by dotted name
    parameters : of the last replay, as ``calibration`` in ``run.json``
    command : the replay with them
    rounds : replays, that of a part included
    is_complete : whether the last replay found nothing more
    refused : why what was found is not among the settings; empty if it is
    fault : the worst that ``check`` finds without a fit; with an error nothing is among the settings
    losses, warnings : what could not be read
    """

    settings: dict[str, float | str]
    parameters: list[dict[str, Any]]
    command: str
    rounds: int
    is_complete: bool
    refused: str
    fault: Finding | None
    losses: list[str]
    warnings: list[str]


def calibrate(
    path: Path | str,
    settings: Mapping[str, Any] | None = None,
    *,
    odometry: str | None = None,
    landmarks: str | None = None,
    progress: Progress = lambda items, total: items,
) -> Calibrated:
    """Estimate corrections of odometry's scale, clocks and mounts. Nothing is written.

    Parameters
    ----------
    settings : parameters by dotted name, which come before those that ``graph_slam info`` chooses; of
        ``calibrate.groups`` the default is ``auto``
    odometry, landmarks : topics, instead of those that ``info`` chooses
    progress : wraps the sequence of messages

    Raises
    ------
    GraphSlamError
        The recording or an input cannot be used, or has no keyframe.
    """
    path, bag, found = Path(path), open_bag(Path(path)), dict[str, float | str]()
    suggested = SuggestedInputs(bag, path, {"calibrate.groups": "auto"} | dict(settings or {}), odometry, landmarks)
    config = _config(suggested.settings)
    inputs = suggested.inputs(config)
    warmup(dimensions=config.world.dimensions)
    total = sum(bag.topics[topic].count for topic in inputs.by_topic())
    report: Mapping[str, Any] = {"settings": {"": 0.0}}
    fault: Finding | None = None
    rounds, kept, before, refused, has_nothing_left = 0, dict[str, float | str](), (0, 0), "", False
    columns, counters = Collector(config, inputs.topics), Counters()
    while report["settings"] and rounds < _ROUNDS:
        rounds, now = rounds + 1, config.changed(found)
        counted, collected = (counters, columns) if rounds == 1 else (Counters(), None)
        slam = _replayed(progress(RecordedRuns(bag, inputs, now, counted, columns=collected), total), now)
        if not slam.keyframes:
            raise GraphSlamError(f"{path}: no odometry of it could be used: graph_slam info {path}")
        accepted = _accepted(slam)
        if _is_less(accepted, before):
            refused, found = _harm(found, kept, before, accepted), kept
            break
        report, kept, before = slam.calibration_report, dict(found), accepted
        fault = worst_of_replay(columns.columns(counters)) if rounds == 1 else fault
        if refused := _wrong(fault) or _misplaced(slam, now):
            report, found = {"settings": {}, "parameters": []}, {}
            break
        found |= report["settings"]
        part = (slam.calibrated_since + 1) / len(slam.keyframes)
        if report["settings"] and rounds < _ROUNDS and part < _MOST_REPEATED:
            rounds, again = rounds + 1, config.changed(found)
            runs = progress(RecordedRuns(bag, inputs, again, Counters()), round(part * total))
            begun = _replayed(runs, again, slam.calibrated_since + 1)
            if has_nothing_left := _leaves_nothing(begun, accepted):
                break
    parameters = report["parameters"] or ([] if refused else list(_undriven(config, len(slam.keyframes))))
    command = suggested.suggestion.command(found | dict(settings or {}) | found)
    complete = (has_nothing_left or not report["settings"]) and not refused
    notes = _once(bag.losses), _once(bag.warnings)
    return Calibrated(found, parameters, command, rounds, complete, refused, fault, *notes)


def _once(lines: Iterable[str]) -> list[str]:
    """Return lines without repetitions."""
    return list(dict.fromkeys(lines))


def _leaves_nothing(slam: GraphSlam, accepted: tuple[int, int]) -> bool:
    """Return whether a replay with corrections finds no others, and accepts at least as much."""
    return not slam.calibration_report["settings"] and not _is_less(_accepted(slam), accepted)


def _undriven(config: Config, keyframes: int) -> Iterator[dict[str, Any]]:
    """Yield each parameter with what to drive, where there was nothing to fit."""
    uses = recorded_uses(config)
    for name, quantity in QUANTITIES.items():
        if quantity.group not in config.calibrate.asked or (
            name in ("roll", "pitch", "z") and config.world.dimensions == 2
        ):
            continue
        use = "odometry" if name in OF_ODOMETRY else "landmarks"
        for source in (one for one, used in uses.items() if used == use):
            why = f"not determined (the robot stood: {keyframes} keyframe{'' if keyframes == 1 else 's'})"
            text = f"{Parameter(source, name)}: {why}: {quantity.manoeuvre}"
            yield {"source": source, "name": name, "verdict": "not_determined", "text": text}


def _config(given: Mapping[str, Any]) -> Config:
    config = with_survey(Config.from_mapping(given))
    if not config.calibrate.is_on:
        groups = config.calibrate.groups
        raise GraphSlamError(f"calibrate.groups: {groups} leaves nothing to fit here; without this setting it is auto")
    if config.calibrate.drift:
        raise GraphSlamError("calibrate.drift: settings are constant; graph_slam replay with it corrects what changes")
    return config


def _replayed(runs: Iterable[Any], config: Config, most: int | None = None) -> GraphSlam:
    """Replay in memory, all or until there are so many keyframes."""
    slam = GraphSlam(config)
    for _, some in runs:
        if most is not None and len(slam.keyframes) >= most:
            break
        for one in some:
            slam.process(one)
    for event in END:
        slam.process(event)
    return slam


def _wrong(fault: Finding | None) -> str:
    """Return why nothing is used of a recording that has an error: what is fitted to it means nothing."""
    if fault is None or fault.severity != "error":
        return ""
    return f"nothing is calibrated: mend {fault.code} first"


def _misplaced(slam: GraphSlam, config: Config) -> str:
    """Return why nothing is used where a sensor is elsewhere on the robot: that passes for scale and yaw."""
    off = next((one for one in slam.uncorrected() if one.code == CODES["x"]), None)
    if off is None or not off.setting:
        return ""
    source = next(one for one in config.sources if one.name == off.source)
    key, value = off.setting
    turn = source.numbers("mount_correction", 6)[3:] or (0.0, 0.0, 0.0)
    mount = " ".join((*str(value).split()[:3], *(f"{angle:.5g}" for angle in turn)))
    return f"nothing is calibrated, for what is found hides this: {off}. Measure it, or --set {key}='{mount}'"


def _accepted(slam: GraphSlam) -> tuple[int, int]:
    """Count the measurements that the estimate uses, and all; odometry is in neither."""
    of_inputs = [one for one in account(slam, slam.counters)["inputs"].values() if one["use"] != "odometry"]
    return sum(one["believed"] or 0 for one in of_inputs), sum(one["used"] for one in of_inputs)


def _is_less(accepted: tuple[int, int], before: tuple[int, int]) -> bool:
    """Return whether clearly fewer of the measurements are accepted than before."""
    return accepted[0] * before[1] < _STILL_ACCEPTED * before[0] * accepted[1]


def _harm(
    found: Mapping[str, float | str],
    kept: Mapping[str, float | str],
    before: tuple[int, int],
    accepted: tuple[int, int],
) -> str:
    """Return why settings are not used with which fewer measurements are accepted than without."""
    lines = ", ".join(f"{name}={value}" for name, value in found.items() if kept.get(name) != value)
    return (
        f"not used: {lines}: with it {accepted[0]} of {accepted[1]} measurements are accepted, "
        f"without it {before[0]} of {before[1]}"
    )
