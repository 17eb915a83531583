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
from graph_slam_ros.measurements.types import END
from graph_slam_ros.messages.inputs import recorded_uses
from graph_slam_ros.messages.survey import with_survey
from graph_slam_ros.recordings.bag import Bag, open_bag
from graph_slam_ros.runs.chosen_inputs import Inputs
from graph_slam_ros.runs.replay import RecordedRuns
from graph_slam_ros.runs.suggested_inputs import SuggestedInputs
from graph_slam_ros.runs.tables import account
from graph_slam_ros.slam import Config, Counters, GraphSlam
from graph_slam_ros.slam.calibration.decision import amount
from graph_slam_ros.slam.calibration.parameters import OF_ODOMETRY, QUANTITIES, Parameter
from graph_slam_ros.slam.calibration.uncorrected import CODES
from graph_slam_ros.warmup import warmup

_HIDES = "nothing is calibrated, for what is found hides this"
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
    command : the replay with them; the next calibration, where one setting is to be made before
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
    path, bag = Path(path), open_bag(Path(path))
    suggested = SuggestedInputs(bag, path, {"calibrate.groups": "auto"} | dict(settings or {}), odometry, landmarks)
    config = _config(suggested.settings)
    warmup(dimensions=config.world.dimensions)
    rounds = _Rounds(bag, suggested.inputs(config), config, progress)
    rounds.run()
    if not rounds.keyframes:
        raise GraphSlamError(f"{path}: no odometry of it could be used: graph_slam info {path}")
    found, refused = rounds.found, rounds.refused
    parameters = rounds.parameters or ([] if refused else list(_undriven(config, rounds.keyframes)))
    name = "calibrate" if rounds.named else "replay"
    command = suggested.suggestion.command(found | dict(settings or {}) | found | rounds.named, name=name)
    outcome = parameters, command, rounds.count, rounds.is_complete, refused, rounds.fault
    return Calibrated(found, *outcome, _once(bag.losses), _once(bag.warnings))


class _Rounds:
    """Replays, each with the corrections that were found so far.

    Attributes
    ----------
    found, parameters, refused, fault, is_complete : as of ``Calibrated``
    named : the setting that is to be made first, if ``refused`` names one
    count : replays so far
    keyframes : of the last replay of the whole recording
    """

    def __init__(self, bag: Bag, inputs: Inputs, config: Config, progress: Progress) -> None:
        self.found: dict[str, float | str] = {}
        self.parameters: list[dict[str, Any]] = []
        self.refused, self.is_complete = "", False
        self.named: dict[str, float | str] = {}
        self.fault: Finding | None = None
        self.count = self.keyframes = 0
        self._bag, self._inputs, self._config, self._progress = bag, inputs, config, progress
        self._corrected = set[Parameter]()
        self._total = sum(bag.topics[topic].count for topic in inputs.by_topic())

    def run(self) -> None:
        """Replay until nothing more is found, or what was found does harm, or is refused."""
        kept, before = dict[str, float | str](), (0, 0)
        while not self.is_complete and self.count < _ROUNDS:
            slam = self._replayed()
            if not self.keyframes:
                return
            accepted = _accepted(slam)
            if _is_less(accepted, before):
                self.refused, self.found = _harm(self.found, kept, before, accepted), kept
                return
            self.refused = _wrong(self.fault)
            if not self.refused:
                self.refused, self.named = _misplaced(slam, slam.config)
            if self.refused:
                self.found, self.parameters = {}, []
                return
            report, kept, before = slam.calibration_report, dict(self.found), accepted
            self._corrected |= {one.parameter for one in slam.corrected}
            self.parameters = [self._left(one) for one in report["parameters"]]
            self.found |= report["settings"]
            self.is_complete = not report["settings"] or self._finds_nothing_in(slam.calibrated_since + 1, accepted)

    def _left(self, one: dict[str, Any]) -> dict[str, Any]:
        """Say of a parameter that was corrected that its value is what is left of it."""
        parameter = Parameter(one["source"], one["name"])
        if one["verdict"] != "nothing_to_correct" or parameter not in self._corrected:
            return one
        left = f"{amount(parameter, one['value'], 3)}, sigma {amount(parameter, one['sigma'])}"
        return one | {"text": f"{parameter}: corrected, {left} is left"}

    def _replayed(self) -> GraphSlam:
        """Replay the whole recording. The first replay collects what ``check`` needs."""
        self.count += 1
        config, counters = self._config.changed(self.found), Counters()
        columns = Collector(config, self._inputs.topics) if self.count == 1 else None
        runs = RecordedRuns(self._bag, self._inputs, config, counters, columns=columns)
        slam = _replayed(self._progress(runs, self._total), config)
        self.keyframes = len(slam.keyframes)
        if columns is not None and self.keyframes:
            self.fault = worst_of_replay(columns.columns(counters))
        return slam

    def _finds_nothing_in(self, keyframes: int, accepted: tuple[int, int]) -> bool:
        """Return whether a replay of the beginning, which ends where the last correction was made, is enough.

        It is where that part finds nothing more, and accepts at least as much as all did.
        """
        part = keyframes / self.keyframes
        if self.count >= _ROUNDS or part >= _MOST_REPEATED:
            return False
        self.count += 1
        config = self._config.changed(self.found)
        runs = RecordedRuns(self._bag, self._inputs, config, Counters())
        slam = _replayed(self._progress(runs, round(part * self._total)), config, keyframes)
        return not slam.calibration_report["settings"] and not _is_less(_accepted(slam), accepted)


def _once(lines: Iterable[str]) -> list[str]:
    """Return lines without repetitions."""
    return list(dict.fromkeys(lines))


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


def _misplaced(slam: GraphSlam, config: Config) -> tuple[str, dict[str, float | str]]:
    """Return why nothing is used where a sensor is elsewhere on the robot, or its ranges have an offset; the setting.

    That passes for scale and yaw. The offset of ranges alone is fitted with the scale, and hides nothing.
    """
    fitted = {one["source"] for one in slam.calibration_report["parameters"] if one["name"] == "range_offset"}
    for off in slam.uncorrected():
        if not off.setting:
            continue
        key, value = off.setting
        if key == f"{off.source}.range_offset_m" and off.source not in fitted:
            return f"{_HIDES}: {off}. Set it, and calibrate again: --set {key}={value}", {key: value}
        if off.code == CODES["x"]:
            source = next(one for one in config.sources if one.name == off.source)
            turn = source.numbers("mount_correction", 6)[3:] or (0.0, 0.0, 0.0)
            mount = " ".join((*str(value).split()[:3], *(f"{angle:.5g}" for angle in turn)))
            text = f"{_HIDES}: {off}. Measure it, or calibrate again with --set {key}='{mount}'"
            return text, {key: mount}
    return "", {}


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
