"""The outcome of each input of a run: a table for a person, and the reasons why the result is incomplete.

Both are made from ``run.json``. So they are the same for a live run, a replay and a recovered run.
"""

import shlex
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

from graph_slam_ros.check.odometry import leaves_plane
from graph_slam_ros.findings.finding import Finding, in_order
from graph_slam_ros.findings.table import DOUBTS, OF_STAMPS, Effect, explain, remedy
from graph_slam_ros.runs.tables import INPUT_COLUMNS
from graph_slam_ros.slam.frontend.gyro import GyroState

Summary = Mapping[str, Any]

_WIDTH, _COLUMN = 100, 14
_MOST_REASONS, _MAX_UNDETERMINED = 5, 10  # that are listed
_JUMPY, _MOST_JUMPS = 0.02, 5  # of all messages of an odometry; with more its motion is hardly used
_MOSTLY = 0.5
MOTION = ("odometry", "gyro")  # uses whose measurements nobody doubts one by one
_DOUBTED = 0.05  # of an input: as many that are not believed are said; so it is of visits to places
_TOO_WIDE = 1e-4  # chi2 per degree of freedom: sigmas are a hundred times as large as what they are of
_FEWEST_LOST = 2  # visits that are lost, which are said
VISITS = ("visit_condensed", "visit_lost", "visit_wider")  # in the counters of "map"
_MENDED = (  # of what is noted, signs of a wrong setting
    *("displaced", "displacement_taken_back", "jump", "frozen"),
    *("not_in_use", "gyro_waiting", "gyro_silent", "gyro_doubted"),
)
_TWO, _MANY, _FEWEST = " places fit: ", 0.25, 4  # of the reasons; part and number of landmarks
_UNNAMED = "sightings without identity"


def text(summary: Summary) -> list[str]:
    """The numbers of a run, the size of its queue, and the outcome of each input."""
    dof = f"of {summary['dof']} degrees of freedom, " if "dof" in summary else ""
    lines = [
        f"keyframes  {summary['keyframes']:8d}   over {summary['span_s']:.1f} s",
        f"landmarks  {summary['landmarks']:8d}   from {summary['sightings']} sightings",
        f"edges      {summary['edges']:8d}",
        f"chi2       {summary['chi2']:12.3f}   {dof}{_solves(summary)}",
    ]
    if what := condensed_text(summary):
        all_ = ": --set map.condense=false keeps all" if "condensed" in summary else ""
        lines.append(f"condensed  {what}{all_}")
    if "time_s" in summary:
        cpu = f", {summary['cpu_s']:.1f} s of CPU time" if "cpu_s" in summary else ""
        lines.append(f"took       {summary['time_s']:10.1f} s{cpu}")
    undetermined = [f"waiting    {name}: {reason}" for name, reason in summary["waiting"].items()]
    if rest := undetermined[_MAX_UNDETERMINED:]:
        undetermined[_MAX_UNDETERMINED:] = [f"waiting    and {len(rest)} more, see run.json"]
    if unseen := summary.get("survey_unseen"):
        more = f" and {len(unseen) - _MAX_UNDETERMINED} more" if len(unseen) > _MAX_UNDETERMINED else ""
        names = ", ".join(unseen[:_MAX_UNDETERMINED])
        lines += _wrapped(f"survey     not in the map, because it was not seen, or too little: {names}{more}", 11)
    inputs = summary.get("inputs", {})
    others = [
        line
        for source, counts in summary["counters"].items()
        for reason, times in counts.items()
        if source not in inputs or explain(reason).effect is not Effect.REFUSED
        for line in _counted_lines(source, reason, times)
    ]
    found = [*_gyro(summary), *noise(summary), *_calibration(summary), *_clocks(summary)]
    return [*lines, *undetermined, *others, *found, *table(summary)]


def _gyro(summary: Summary) -> Iterator[str]:
    """The bias of the gyro, and whether it has a part in odometry."""
    if gyro := summary.get("gyro"):
        bias = ", ".join(f"{b:.5f} +- {s:.5f}" for b, s in zip(gyro["bias"], gyro["sigma"], strict=True))
        yield f"gyro       bias {bias} rad/s; {gyro['state']}"


def noise(summary: Summary) -> Iterator[str]:
    """Yield the factors of the configured sigmas that the run used, and those that it could not estimate."""
    if summary.get("noise_scale") != "estimated":
        return
    known, unknown = list[str](), list[str]()
    for one in summary.get("noise", ()):
        name = f"{one['label']} {one['source']} {one['part']}"
        if one["reason"]:
            unknown.append(f"{name} ({one['reason']})")
        else:
            grows = ", more in motion" if one["per_rad"] > 0.0 or one["per_m"] > 0.0 else ""
            known.append(f"{name} {one['factor']:.2f}{grows}")
    if known:
        yield from _wrapped(f"noise      by the residuals, times the configured sigmas: {'; '.join(known)}", 11)
    if unknown:
        yield from _wrapped(f"noise      as configured: {', '.join(unknown)}", 11)


def _calibration(summary: Summary) -> Iterator[str]:
    """Yield the factors of odometry that the association found, as settings, and what is off and in covariances."""
    if settings := summary.get("calibrated"):
        lines = " ".join(f"--set {shlex.quote(f'{name}={value}')}" for name, value in settings.items())
        yield from _wrapped(f"calibrated {lines}", 11)
    if (off := summary.get("contradicted")) and not is_explained(summary):
        text = f"not corrected, so the covariances contain it: {', '.join(off)} (graph_slam calibrate BAG)"
        yield from _wrapped(f"off        {text}", 11)


def _clocks(summary: Summary) -> Iterator[str]:
    """Yield the clocks that the association of sightings without identity found, with the setting of each."""
    for topic, one in summary.get("association", {}).get("clocks", {}).items():
        if one["setting"]:
            found = f"{one['value']:+.3f} s (sigma {one['sigma']:.3f} s), used to recognise landmarks"
            yield from _wrapped(f"clock      of {topic}: {found}; in the estimate, too: --set {one['setting']}", 11)


def _solves(summary: Summary) -> str:
    """The number of solves. A map that is only read is solved once, before the run counts."""
    count = summary["solves"]
    if count:
        return f"after {count} solve{'s' * (count > 1)}"
    return "no solve succeeded" if summary["failing"] else "of the map as it was read, solved once"


def _counted_lines(source: str, reason: str, times: int) -> Iterator[str]:
    """Yield what was repaired or noted, with the remedy if it was frequent."""
    yield from _wrapped(f"counted    {source}: {reason} {times} ({explain(reason).meaning})", 11)
    if times > 1 and reason in _MENDED and (mend := remedy(source, reason)):
        yield from textwrap.wrap(f"-> {mend}", _WIDTH, initial_indent=" " * 11, subsequent_indent=" " * 14)


def _wrapped(line: str, indent: int) -> list[str]:
    """The words of a line, in as many lines as needed. A name from a message never begins a line."""
    return textwrap.wrap(" ".join(line.splitlines()), _WIDTH, subsequent_indent=" " * indent)


def table(summary: Summary) -> list[str]:
    """A row for each input, with the reasons of refusals and their remedies.

    Measurements are the odometry, sightings, fixes and closures in messages. Those are believed that the estimate uses.
    A message that is refused as a whole counts once.
    """
    inputs: Mapping[str, Any] = summary.get("inputs", {})
    if not inputs:
        return []
    wide = max(5, *map(len, inputs))
    units, names = zip(*(title.rpartition(" ")[::2] for title in INPUT_COLUMNS.values()), strict=True)
    lines = [f"{'':{wide}s}" + "".join(f"{unit:>{_COLUMN}s}" for unit in units)]
    hidden = {code for one in of_run(summary) for code in one.hides}
    lines.append(f"{'input':{wide}s}" + "".join(f"{name:>{_COLUMN}s}" for name in names))
    for name, counts in inputs.items():
        refused = _counted(summary, name)
        numbers = ((counts | {"refused": sum(refused.values())})[column] for column in INPUT_COLUMNS)
        lines.append(f"{name:{wide}s}" + "".join(f"{'-' if n is None else n:>{_COLUMN}}" for n in numbers))
        for reason, times in list(refused.items())[:_MOST_REASONS]:
            lines += textwrap.wrap(f"{reason} {times}: {explain(reason).meaning}", _WIDTH - 2, initial_indent="  ")
            if reason not in hidden and (mend := _remedy(summary, name, reason)):
                lines += textwrap.wrap(f"-> {mend}", _WIDTH, initial_indent="    ", subsequent_indent="       ")
    return lines


def findings(summary: Summary) -> list[Finding]:
    """Return what is wrong with a run, the most severe first; nothing where its summary is not whole."""
    with suppress(LookupError, TypeError, ValueError, AttributeError):
        return of_run(summary)
    return []


def shortcomings(summary: Summary) -> Iterator[str]:
    """Yield the reasons why the result is incomplete, one sentence each; empty if it is complete."""
    yield from (str(one) for one in of_run(summary) if one.severity == "error")


def doubts(summary: Summary) -> Iterator[str]:
    """Yield what makes the result doubtful, or worse than it could be, one sentence each."""
    yield from (str(one) for one in of_run(summary) if one.severity == "warning")


def of_run(summary: Summary) -> list[Finding]:
    """Return what is wrong with a run, without what follows from something else."""
    inputs = [one for name in summary.get("inputs", {}) for one in _of_input(summary, name)]
    solves = _of_solves(summary, is_doubtful=any(one.code == "contradicted" for one in inputs))
    found = [*of_map(summary), *_of_recording(summary), *solves, *inputs]
    return in_order([*found, *_of_counters(summary), *_of_sightings(summary)])


def of_map(summary: Summary) -> Iterator[Finding]:
    """Yield what a map itself shows to be wrong, at the end of a run or while it goes on."""
    for one in summary.get("uncorrected", ()):
        settings = tuple(f"{key}={value}" for key, value in one["settings"].items() if f"{key}=" not in one["text"])
        text = f"{one['text']} (graph_slam calibrate BAG compares the causes)"
        yield Finding(one["code"], "error", text=text, settings=settings, remedy="" if one["settings"] else None)
    if (gyro := summary.get("gyro")) and gyro["state"] != "used":
        name, code, fault = gyro["name"], f"gyro_{gyro['state']}", GyroState(**gyro).fault
        note = Finding(code, "note", text=f"{name}: {explain(code).meaning}", source=name)
        yield Finding(code, "error", text=fault, remedy="") if fault else note
    found: Mapping[str, Any] = summary.get("association", {})
    if found.get("is_doubtful"):
        missing, lost = 100.0 * found["missing_part"], 100.0 * found["lost_part"]
        text = f"{_UNNAMED}: {missing:.0f} % of the landmarks that should be seen are not, and the sensor misses "
        yield Finding("confused", "error", text=f"{text}{lost:.1f} %: the map is probably wrong")
    if not found.get("is_whole", True):
        text = f"{_UNNAMED}: landmarks may be in the map twice, the search for those reached its limit (moves_left)"
        yield Finding("confused", "error", text=text)
    if count := sum(len(rival["only_here"]) for rival in summary.get("rivals", ())):
        text = f"ambiguous: {count} loop closures that are not believed agree with one another as well"
        yield Finding("ambiguous", "warning", text=text)
    landmarks, waiting = summary.get("landmarks", 0), summary.get("waiting", {})
    undecided, every = sum(_TWO in reason for reason in waiting.values()), landmarks + len(waiting)
    if landmarks >= _FEWEST and undecided >= max(_FEWEST, _MANY * every):
        text = (
            f"ranges alone: of {undecided} of {every} landmarks two places fit, one on either side of the path, so "
            "they are not used; others may be in the map on the wrong side, and covariances do not contain that"
        )
        yield Finding("sides_unknown", "warning", text=text)
    if renewed := summary.get("renewed_ids"):
        yield Finding("ids_renewed", "warning", text=f"ids_renewed: {renewed}")
    condensed, lost, wider = (summary.get("counters", {}).get("map", {}).get(name, 0) for name in VISITS)
    doubted, visits = lost + wider, condensed + lost
    if doubted >= _FEWEST_LOST and doubted > _DOUBTED * visits:
        text = (
            f"map.condense: {doubted} of {visits} visits contradict themselves or the others, so the noise or the "
            "calibration is wrong, and the map may be much worse than with all keyframes"
        )
        yield Finding("visits_contradict", "warning", text=text)


def _of_recording(summary: Summary) -> Iterator[Finding]:
    """Yield the worst finding of the recording; ``graph_slam check`` lists all."""
    if found := summary.get("check"):
        follows = (*DOUBTS, "confused") if found["severity"] == "error" else ()
        text = f"{found['code']}: {found['text']} (graph_slam check BAG lists all)"
        source, settings = found.get("evidence", {}).get("input", ""), tuple(found["settings"])
        yield Finding(found["code"], found["severity"], text=text, settings=settings, source=source, follows=follows)


def _of_solves(summary: Summary, *, is_doubtful: bool) -> Iterator[Finding]:
    """Yield that the last solve failed or did not converge."""
    if summary.get("failing"):
        text = f"the last solve failed ({summary['failing']}), and the estimate is the one before it"
        yield Finding("solve_failed", "error", text=text)
    elif not summary.get("converged", True):
        text = f"the last solve did not converge ({summary['stop']})"
        yield Finding("contradictory" if is_doubtful else "not_converged", "error", text=text)


def _of_input(summary: Summary, name: str) -> Iterator[Finding]:
    """Yield why an input is not used, or little of it, or is not believed."""
    counts, counted = summary["inputs"][name], summary["counters"].get(name, {})
    received, refused, is_odometry = counts["received"], _counted(summary, name), counts["use"] in MOTION
    if received == 0 and not counts["used"]:
        yield Finding("unused", "error", text=f"{name}: no message came", source=name)
    elif not counts["used"] and counts["use"] != "odometry":
        messages = "" if received is None else f" of {received} messages"
        noted = refused or _counted(summary, name, Effect.NOTED)
        yield _little_used(summary, name, f"nothing{messages} was used", noted)
    elif _is_mostly_refused(summary, name):
        yield _little_used(summary, name, "most of it was refused", refused)
    elif not is_odometry:
        has_cause = name == summary.get("check", {}).get("evidence", {}).get("input")
        found = contradicted(name, counts["believed"] or 0, counts["used"])
        yield from (one for one in found if one.severity == "error" or not has_cause)
    if is_odometry:
        yield from leaves_plane(name, counted, received or counts["used"])
        jumps = sum(of.get("jump", 0) for one, of in summary["counters"].items() if one.partition("#")[0] == name)
        if jumps > max(_MOST_JUMPS, _JUMPY * (received or counts["used"])):
            text = (
                f"{name}: {jumps} jumps, each begins a segment, and the motion across it is not used: odometry in "
                "metres and radians? A robot as fast as that"
            )
            yield Finding("jump", "error", text=text, settings=("odometry.max_speed_m_s=...",), source=name)
        if (count := counted.get("frozen", 0)) > 2:
            yield Finding("frozen", "error", text=f"{name}: {explain('frozen').meaning} ({count} times)", source=name)


def contradicted(name: str, accepted: int, count: int) -> Iterator[Finding]:
    """Yield that many measurements of an input are not believed; with more than half it is of little use."""
    if accepted < _MOSTLY * count:
        text = f"{name}: only {accepted} of {count} are believed"
        yield Finding("contradicted", "error", text=text, source=name)
    elif accepted < (1.0 - _DOUBTED) * count:
        text = f"{name}: {100.0 * (1.0 - accepted / count):.0f} % of {count} are not believed"
        yield Finding("contradicted", "warning", text=text, source=name)


def _of_counters(summary: Summary) -> Iterator[Finding]:
    """Yield what counters show: a stop, a place of a sensor that is assumed, an idle gyro, a topic of two drivers."""
    if stopped := sum(reasons.get("stopped", 0) for reasons in summary["counters"].values()):
        text = f"time jumped back, and time.on_jump is stop: {stopped} measurements after it were refused"
        yield Finding("stopped", "error", text=text)
    inputs: Mapping[str, Any] = summary.get("inputs", {})
    for name, counted in summary["counters"].items():
        for why in {"mount_assumed", "mount_unknown"} & counted.keys():
            text = f"{name}: no transform has the place of its sensor, and one is assumed"
            yield Finding(why, "error", text=text, source=name)
    steps = max((counts["used"] for counts in inputs.values() if counts["use"] == "odometry"), default=0)
    if (gyro := summary.get("gyro")) and inputs.get(name := gyro["name"], {}).get("used"):
        counted = summary["counters"].get(name, {})
        without, reason = max((counted.get(one, 0), one) for one in ("gyro_silent", "gyro_waiting"))
        if without > _MOSTLY * steps and gyro["state"] != "doubted":
            text = f"{name}: in {without} of {steps} steps odometry turned without the gyro"
            yield Finding(reason, "error", text=text, source=name)
    for name, count in Counter(name.partition("#")[0] for name in inputs).items():
        if count > 1:
            text = (
                f"{name}: {count} odometries are on its topic ({name}, {name}#2, ...), or one that jumps: is it in "
                "metres and radians?"
            )
            yield Finding("two_publishers", "warning", text=text, source=name)


def _of_sightings(summary: Summary) -> Iterator[Finding]:
    """Yield that nothing corrects odometry, or that landmarks contradict it or themselves."""
    alarm: Mapping[str, Any] = next(reversed(summary.get("displacements", ())), {})
    if is_undecided(alarm):
        text = f"{alarm['text']}, which is not decided: the end of the path is by odometry"
        yield Finding("elsewhere", "error", text=text)
    landmarks, inputs = summary.get("landmarks", 0), summary.get("inputs", {}).values()
    if not sum(one["believed"] or 0 for one in inputs if landmarks or one["use"] != "landmarks"):
        text = "this is odometry alone: no landmark, fix or closure is in the result"
        yield Finding("odometry_alone", "error", text=text)
    measured = [one for one in summary.get("noise", ()) if one["dof"] >= 1.0]
    if all(one["label"] != "odometry" for one in measured):
        for name in dict.fromkeys(one["source"] for one in measured if one["per_dof"] < _TOO_WIDE):
            text = (
                f"{name}: its noise is stated more than 100 times too large, so it corrects nothing, and this is "
                "odometry alone"
            )
            yield Finding("noise_too_large", "error", text=text, source=name)
    if landmarks and summary["sightings"] == landmarks:
        yield Finding("not_seen_again", "error", text="no landmark was seen twice, so they correct nothing")
    contested = summary.get("contested", {})
    for name, (out, count) in contested.items() if len(contested) <= _MANY * landmarks else ():
        yield Finding("contested", "warning", text=f"{name}: {out} of {count} sightings are not believed")


def is_undecided(alarm: Mapping[str, Any]) -> bool:
    """Return whether a ``Doubt`` as a dictionary is of where the robot is, goes on, and nothing is decided of it."""
    return "held_back" in alarm and all(alarm.get(key) is None for key in ("decided_ns", "ended_ns", "segment"))


def is_explained(summary: Summary) -> bool:
    """Return whether doubts may be consequences: of an error of the recording, or of an input mostly refused."""
    return any(one.follows for one in of_run(summary))


def condensed_text(summary: Mapping[str, Any]) -> str:
    """Return which keyframes were condensed, or why none was in a long drive; empty in a short one."""
    if count := summary.get("condensed"):
        return f"keyframes 0 to {count - 1}, into places"
    why = summary.get("not_condensed", "")
    return f"nothing: not with {why} yet, so the map grows with the distance driven" if why else ""


def unscaled(summary: Summary) -> Iterator[str]:
    """Yield why noise that should be estimated is as configured, though something was solved."""
    why = summary.get("noise_unknown")
    if why and summary.get("noise_scale") == "estimated" and summary["landmarks"]:
        yield f"robust.noise_scale=estimated: no noise could be estimated at the end: {why}"


def _little_used(summary: Summary, name: str, what: str, counted: Mapping[str, int]) -> Finding:
    """Return that an input is not used, or little of it, by the most frequent reason."""
    if not counted:
        count = len(summary["waiting"])
        why = f"{count} landmarks are not determined (waiting)" if count else "it holds nothing"
        return Finding("unused", "error", text=f"{name}: {what}: {why}", source=name)
    reason = next(iter(counted))
    text = f"{name}: {what}: {reason} {counted[reason]} ({explain(reason).meaning})"
    mend, follows = _remedy(summary, name, reason), _follows(summary, name)
    return Finding(reason, "error", text=text, source=name, remedy=mend, follows=follows)


def _follows(summary: Summary, name: str) -> tuple[str, ...]:
    """Return what may follow from an input that is mostly refused; from odometry, also that others are refused."""
    inputs: Mapping[str, Any] = summary["inputs"]
    if "#" in name or not _is_mostly_refused(summary, name):  # a second odometry of a topic explains nothing
        return ()
    lost = [one for one, of in inputs.items() if of["use"] == "odometry" and _is_mostly_refused(summary, one)]
    own = {reason for one in lost for reason in _counted(summary, one)}
    return (*DOUBTS, *(one for one in OF_STAMPS if one not in own)) if name in lost else DOUBTS


def _is_mostly_refused(summary: Summary, name: str) -> bool:
    refused = sum(_counted(summary, name).values())
    return bool(refused > _MOSTLY * (refused + summary["inputs"][name]["used"]))


def _remedy(summary: Summary, name: str, reason: str) -> str:
    """Return what mends a reason; of a frame that is unknown since transforms name none, what mends the transforms."""
    empty = [one for one in ("tf", "tf_static") if summary["counters"].get(one, {}).get("frame_empty")]
    return remedy(empty[0], "frame_empty") if empty and reason == "frame_unknown" else remedy(name, reason)


def _counted(summary: Summary, name: str, effect: Effect = Effect.REFUSED) -> dict[str, int]:
    """Reasons of one effect for an input, the most frequent first."""
    some = [(r, times) for r, times in summary["counters"].get(name, {}).items() if explain(r).effect is effect]
    return dict(sorted(some, key=lambda one: (-one[1], one[0])))
