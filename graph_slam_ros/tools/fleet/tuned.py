"""The result of a tuning, as a parameter file and in words."""

import math
from collections.abc import Iterator

from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.tools.fleet.compare import Change
from graph_slam_ros.tools.fleet.surface import FACTOR
from graph_slam_ros.tools.fleet.tune import Tuned, TunedParameter

_PROOFS = {
    "held out": "on {count} recordings that were held out",
    "cross validation": "on {count} recordings, each with the values of the others",
    "none": "on the recording that it was tuned on: with a single one nothing can be held out",
}


def as_yaml(tuned: Tuned) -> str:
    """A parameter file with the parameters that change, and comments on these, on the others and on the proof."""
    nested: dict[str, dict[str, float]] = {}
    for name, value in tuned.settings.items():
        section, _, key = name.partition(".")
        nested.setdefault(section, {})[key] = value
    notes = {one.name: in_words(one) for one in tuned.parameters if one.state == "changed"}
    counts = tuned.counts
    head = [
        f"tuned on {len(tuned.tuned_on)} recordings by {tuned.objective}: {counts['trials']} trials "
        f"({counts['pruned']} pruned), {counts['runs']} runs",
        *proof_in_words(tuned),
        *(f"{one.name}: {in_words(one)}" for one in tuned.parameters if one.state != "changed"),
    ]
    return "".join(f"# {line}\n" for line in head) + parameters_text(nested, notes)


def in_words(one: TunedParameter) -> str:
    """The result for a parameter."""
    if one.state == "unused":
        return f"left at {one.before:g}: it changes no result here (see graph_slam params for what it belongs to)"
    if one.state == "undetermined":
        return f"left at {one.before:g}: these recordings do not determine it ({_how_wide(one)})"
    low, high = one.interval
    found = f"95 % interval {low:.3g} to {high:.3g}"
    return f"left at {one.before:g}: {found}" if one.state == "same" else f"was {one.before:g}; {found}"


def _how_wide(one: TunedParameter) -> str:
    if not math.isfinite(one.sigma):
        return "the score is flat, or the number of recordings is too small"
    return f"95 % interval: a factor of {math.exp(1.96 * one.sigma):.3g} to both sides, more than {FACTOR:g}"


def proof_in_words(tuned: Tuned) -> Iterator[str]:
    """Yield by how much the values help, and on what."""
    if not tuned.changes:
        yield "nothing changes"
        return
    yield _PROOFS[tuned.proof].format(count=tuned.changes[0].count) + ":"
    for one in tuned.changes:
        yield f"  {_change_in_words(one, tuned.objective)}"


def _change_in_words(one: Change, objective: str) -> str:
    (low, high), ratio = one.interval, one.ratio
    if one.metric == "objective" and objective == "likelihood":
        low, high, ratio = 1.0 / high, 1.0 / low, 1.0 / ratio
        return f"a left-out sighting is {ratio:.3f} times as likely ({low:.3f} to {high:.3f}): {one.verdict}"
    if one.metric == "objective":
        return f"score of {objective}: {ratio:.3f} times ({low:.3f} to {high:.3f}): {one.verdict}"
    verdict = "" if one.metric == "nees" else f": {one.verdict}"
    return f"{one.metric} {one.old:.4g} to {one.new:.4g}, {ratio:.3f} times ({low:.3f} to {high:.3f}){verdict}"
