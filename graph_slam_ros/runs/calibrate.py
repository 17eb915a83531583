"""The calibration of a recording: replays in memory, each with what was found so far, until nothing more is.

Fits are made after 50, 100, 200 and so on keyframes, and at the end. What one finds is set, and the replay begins anew:
a map that is driven to its end with a wrong scale has learnt noise that hides it.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from graph_slam_ros.check.checks import refused_odometry, worst_of_replay
from graph_slam_ros.config.config import with_survey
from graph_slam_ros.errors import GraphSlamError, SingularError
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.measurements.types import END
from graph_slam_ros.messages.inputs import recorded_uses
from graph_slam_ros.overview.chosen_inputs import Inputs
from graph_slam_ros.recordings.bag import Bag, open_bag
from graph_slam_ros.runs.replay import Progress, RecordedRuns
from graph_slam_ros.runs.suggestion import Suggestion
from graph_slam_ros.runs.tables import account
from graph_slam_ros.slam import Config, GraphSlam, MapView
from graph_slam_ros.slam.calibration.answers import CODES, Fitted, setting_of
from graph_slam_ros.slam.calibration.parameters import AUTO, GROUPS, Parameter, parameters_of
from graph_slam_ros.slam.noise.factors import FIRST_DUE
from graph_slam_ros.warmup import warmup

_HIDES = "nothing is calibrated, for what is found hides this"
_ROUNDS = 4  # replays; a large clock needs two or three
_STILL_ACCEPTED = 0.9  # of the part that was accepted before: with less, what was found does harm


@dataclass(slots=True)
class Calibrated:
    """The outcome of a calibration.

    Attributes
    ----------
    settings : parameters to be set, by dotted name
    parameters : of the last replay: ``source``, ``name``, ``value``, ``sigma``, ``verdict`` and ``text`` of each
    command : the replay with them; the next calibration, where one setting is to be made before
    rounds : replays
    is_complete : whether the last replay found nothing more
    refused : why what was found is not among the settings; empty if it is
    fault : the worst that ``check`` finds without a fit; with an error nothing is among the settings
    losses, warnings : what could not be read
    """

    settings: dict[str, float | str] = field(default_factory=dict)
    parameters: list[dict[str, Any]] = field(default_factory=list)
    command: str = ""
    rounds: int = 0
    is_complete: bool = False
    refused: str = ""
    fault: Finding | None = None
    losses: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def calibrate(
    path: Path | str,
    settings: Mapping[str, Any] | None = None,
    *,
    groups: str = "auto",
    odometry: str | None = None,
    landmarks: str | None = None,
    progress: Progress = lambda items, total: items,
) -> Calibrated:
    """Estimate corrections of odometry's scale, clocks and mounts. Nothing is written.

    Parameters
    ----------
    settings : parameters by dotted name, which come before those that ``graph_slam info`` chooses
    groups : what is estimated, words of ``GROUPS`` or ``auto``
    odometry, landmarks : topics, instead of those that ``info`` chooses
    progress : wraps the sequence of messages
    """
    path, bag = Path(path), open_bag(Path(path))
    settings = dict(settings or {})
    suggestion = Suggestion(bag, path, odometry, landmarks, settings)
    config = with_survey(Config.from_mapping(suggestion.assumed | settings))
    words = _words(groups, config)
    warmup(dimensions=config.world.dimensions)
    rounds = _Rounds(bag, suggestion.inputs(config), config, words, progress)
    rounds.run()
    if not rounds.keyframes:
        raise GraphSlamError(f"{path}: no odometry of it could be used: graph_slam info {path}")
    done, named = rounds.out, rounds.named
    if not done.parameters and not done.refused:
        done.parameters = list(_undriven(config, words, rounds.keyframes))
    wanted = done.settings | settings | done.settings | named
    done.command = suggestion.command(wanted, name="calibrate" if named else "replay")
    done.losses, done.warnings = list(dict.fromkeys(bag.losses)), list(dict.fromkeys(bag.warnings))
    return done


class _Rounds:
    """Replays, each with the corrections that were found so far.

    Attributes
    ----------
    out : the outcome, as far as the replays give it
    named : the setting that is to be made first, if it is refused for one
    keyframes : of the last replay of the whole recording
    """

    def __init__(self, bag: Bag, inputs: Inputs, config: Config, words: Sequence[str], progress: Progress) -> None:
        self.out, self.keyframes = Calibrated(), 0
        self.named: dict[str, float | str] = {}
        self._config = config.changed({"map.condense": False})  # a fit is of all keyframes
        self._bag, self._inputs, self._words, self._progress = bag, inputs, words, progress
        self._corrected = set[Parameter]()
        self._withdrawn = set[Parameter]()
        self._kept, self._accepted = dict[str, float | str](), (0, 0)  # by the replay before

    def run(self) -> None:
        """Replay until nothing more is found, or what was found does harm, or is refused."""
        for k in range(_ROUNDS):
            slam = self._replayed(math.inf if k else FIRST_DUE)
            if not self.keyframes or self._does_harm(slam):
                return
            findings = self._fitted(slam.view)
            if self.out.fault is not None and self.out.fault.severity == "error":  # what is fitted to it means nothing
                self.out.refused = f"nothing is calibrated: mend {self.out.fault.code} first"
            else:
                self.out.refused, self.named = _misplaced(slam.view, self._config, findings)
            if self.out.refused:
                self.out.settings, self.out.parameters = {}, []
                return
            self.out.parameters = [self._said(one) for one in findings]
            self.out.is_complete = not self._set(slam.view, findings, are_followed=True)
            if self.out.is_complete:
                return

    def _replayed(self, due: float) -> GraphSlam:
        """Replay the whole recording; anew where a fit after ``due``, 2, 4 times as many keyframes finds more."""
        while True:
            self.out.rounds += 1
            config = self._config.changed(self.out.settings)
            slam, runs = GraphSlam(config), RecordedRuns(self._bag, self._inputs, config)
            for _, some in self._progress(runs, runs.count):
                for one in some:
                    slam.process(one)
                if len(slam.view.keyframes) >= due and slam.view.is_solved and not slam.view.backend.holds_back:
                    due *= 2
                    if self._set(slam.view, self._fitted(slam.view), are_followed=False):
                        break
            else:
                break
        for event in END:
            slam.process(event)
        self.keyframes = len(slam.view.keyframes)
        if self.keyframes and due < math.inf:
            read = runs.columns()
            self.out.fault = next(iter(refused_odometry(read)), None) or worst_of_replay(read)
        return slam

    def _does_harm(self, slam: GraphSlam) -> bool:
        """Return whether clearly fewer measurements are accepted than in the replay before; then all is as it was."""
        of_inputs = [one for one in account(slam, slam.counters)["inputs"].values() if one["use"] != "odometry"]
        accepted, every = sum(one["believed"] or 0 for one in of_inputs), sum(one["used"] for one in of_inputs)
        (before, of), kept = self._accepted, self._kept
        if accepted * of >= _STILL_ACCEPTED * before * every:
            self._accepted, self._kept = (accepted, every), dict(self.out.settings)
            return False
        lines = ", ".join(f"{name}={value}" for name, value in self.out.settings.items() if kept.get(name) != value)
        self.out.refused = (
            f"not used: {lines}: with it {accepted} of {every} measurements are accepted, without it {before} of {of}"
        )
        self.out.settings = kept
        return True

    def _set(self, view: MapView, findings: Iterable[Fitted], *, are_followed: bool) -> bool:
        """Set what was found, withdraw what the whole drive does not bear out. Returns whether it was anything.

        With ``are_followed`` a parameter that was set is set again where it is off by its sigma, though not by four.
        """
        values = {
            one.parameter: one.value
            for one in findings
            if (one.verdict == "admitted" and one.parameter not in self._withdrawn)
            or (are_followed and one.is_determined and one.parameter in self._corrected and abs(one.value) > one.sigma)
        }
        more = view.corrections.lines() | dict(setting_of(one, values, view.corrections.total) for one in values)
        doubted = {one.parameter for one in findings if are_followed and not one.is_determined} & self._corrected
        for one in doubted:
            self.out.settings.pop(setting_of(one, {one: 0.0}, view.corrections.total)[0], None)
        self._withdrawn |= doubted
        self._corrected = (self._corrected | values.keys()) - doubted
        before, self.out.settings = self.out.settings, self.out.settings | more
        return bool(doubted) or self.out.settings != before

    def _fitted(self, view: MapView) -> list[Fitted]:
        """Fit the parameters of the groups; none where the edges do not determine the estimate."""
        try:
            return view.trial_fit(self._words, is_to_correct=True)[1]
        except SingularError:
            return []

    def _said(self, one: Fitted) -> dict[str, Any]:
        """A finding as plain values. Of a parameter that was corrected its value is what is left of it."""
        parameter, text = one.parameter, one.text
        if one.verdict == "nothing_to_correct" and parameter in self._corrected:
            text = f"{parameter}: corrected, {parameter.with_sigma(one.value, one.sigma)} is left"
        factor = self._config.odometry.distance_factor / float(self.out.settings.get("odometry.distance_factor", 1.0))
        if parameter.name == "distance" and parameter in self._corrected and not self._config.survey:
            text += f"; if a measured way tells that ranges are wrong instead: range_factor={factor:.4g}"
        numbers = {"value": one.value, "sigma": one.sigma, "verdict": one.verdict, "text": text}
        return {"source": parameter.source, "name": parameter.name, **numbers}


def _undriven(config: Config, words: Sequence[str], keyframes: int) -> Iterator[dict[str, Any]]:
    """Yield each parameter with what to drive, where there was nothing to fit."""
    uses, why = recorded_uses(config), f"the robot stood: {keyframes} keyframe{'' if keyframes == 1 else 's'}"
    odometries, seen = ([name for name, use in uses.items() if use == of] for of in ("odometry", "landmarks"))
    kinds = dict.fromkeys(seen, ("range and bearing",))
    for one in parameters_of(odometries, kinds, words, dimensions=config.world.dimensions, has_scale=True):
        text = f"{one}: not determined ({why}): {one.quantity.manoeuvre}"
        yield {"source": one.source, "name": one.name, "verdict": "not_determined", "text": text}


def _words(text: str, config: Config) -> list[str]:
    """The groups that are asked for. Raises GraphSlamError for what is none, and for two that are one scale."""
    words = text.split()
    unknown = [word for word in words if word not in (*GROUPS, AUTO)]
    if unknown or not words:
        raise GraphSlamError(f"--groups: {' '.join(unknown)!r} is not auto or some of {', '.join(GROUPS)}")
    if "range_factor" in words and {"factors", AUTO} & set(words) and not config.survey:
        raise GraphSlamError(
            "--groups: factors and range_factor are one scale: leave one out, or survey landmarks (landmarks.surveyed)"
        )
    return words


def _misplaced(view: MapView, config: Config, findings: Iterable[Fitted]) -> tuple[str, dict[str, float | str]]:
    """Return why nothing is used where a sensor is elsewhere on the robot, or its ranges have an offset; the setting.

    That passes for scale and yaw. The offset of ranges alone is fitted with the scale, and hides nothing.
    """
    fitted = {one.parameter.source for one in findings if one.parameter.name == "range_offset"}
    for off in view.uncorrected():
        if not off.setting:
            continue
        key, value = off.setting
        if key == f"{off.parameter.source}.range_offset_m" and off.parameter.source not in fitted:
            return f"{_HIDES}: {off}. Set it, and calibrate again: --set {key}={value}", {key: value}
        if off.code == CODES["x"]:
            source = next(one for one in config.sources if one.name == off.parameter.source)
            turn = source.numbers("mount_correction", 6)[3:] or (0.0, 0.0, 0.0)
            mount = " ".join((*str(value).split()[:3], *(f"{angle:.5g}" for angle in turn)))
            text = f"{_HIDES}: {off}. Measure it, or calibrate again with --set {key}='{mount}'"
            return text, {key: mount}
    return "", {}
