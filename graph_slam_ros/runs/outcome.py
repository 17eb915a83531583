"""The outcome of each input of a run: a table for a person, and the reasons why the result is incomplete.

Both are made from ``run.json``. So they are the same for a live run, a replay and a recovered run.
"""

import shlex
import textwrap
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from typing import Any

from graph_slam_ros.check.finding import FOLLOWS, KINDS
from graph_slam_ros.measurements.reasons import Effect, explain, remedy
from graph_slam_ros.runs.tables import INPUT_COLUMNS
from graph_slam_ros.slam.frontend.gyro import GyroState

Summary = Mapping[str, Any]

_WIDTH, _COLUMN = 100, 14
_MOST_REASONS, _MAX_UNDETERMINED = 5, 10  # that are listed
_OUT_OF_PLANE = 0.05  # of all poses of an odometry: with more, the robot does not move in a plane
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
_CONTRADICT = (
    "graph_slam explain RUN says why. Check units (metres and radians), signs (y and bearings to the left), the place "
    "of the sensor (TF or {0}.mount), its clock ({0}.offset_s) and ids that are used twice. If only its noise is "
    "larger than stated: --set {0}.noise=sigmas --set {0}.sigma_m=..."
)
_CONFUSED = (
    "Landmarks a few metres apart are confused less with a density that is theirs, e.g. for 2 m "
    "--set landmarks.density_per_m=0.4; and with classes, sizes or ids"
)
_ON_JUMP = "--set time.on_jump=segment goes on in the same map, reset in another run"
_NOT_CONVERGED = (
    "the estimate is not at its optimum: --set solve.max_iterations=1000. If that does not help, measurements that are "
    "believed contradict each other: graph_slam explain RUN lists those that fit worst"
)
_CONTRADICTED = "measurements contradict each other, so more iterations do not help: graph_slam explain RUN says which"
_EXTREME = "distances or noise that no robot means do that: --set INPUT.max_distance_m=... or INPUT.noise=sigmas"


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


def _gyro_faults(summary: Summary) -> Iterator[str]:
    """Yield why the gyro has no part in odometry, or in most of it; empty if it has."""
    gyro, inputs = summary.get("gyro"), summary.get("inputs", {})
    if not gyro:
        return
    name, counted = gyro["name"], summary["counters"].get(gyro["name"], {})
    steps = max((counts["used"] for counts in inputs.values() if counts["use"] == "odometry"), default=0)
    without, reason = max((counted.get(one, 0), one) for one in ("gyro_silent", "gyro_waiting"))
    if gyro["state"] == "doubted":
        yield GyroState(**gyro).fault
    elif without > _MOSTLY * steps and inputs.get(name, {}).get("used"):
        yield f"{name}: in {without} of {steps} steps odometry turned without the gyro: {remedy(name, reason)}"


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
    lines.append(f"{'input':{wide}s}" + "".join(f"{name:>{_COLUMN}s}" for name in names))
    for name, counts in inputs.items():
        refused = _counted(summary, name, Effect.REFUSED)
        numbers = ((counts | {"refused": sum(refused.values())})[column] for column in INPUT_COLUMNS)
        lines.append(f"{name:{wide}s}" + "".join(f"{'-' if n is None else n:>{_COLUMN}}" for n in numbers))
        for reason, times in list(refused.items())[:_MOST_REASONS]:
            lines += textwrap.wrap(f"{reason} {times}: {explain(reason).meaning}", _WIDTH - 2, initial_indent="  ")
            if mend := _remedy(summary, name, reason):
                lines += textwrap.wrap(f"-> {mend}", _WIDTH, initial_indent="    ", subsequent_indent="       ")
    return lines


def findings(summary: Summary) -> tuple[list[str], list[str]]:
    """Shortcomings and doubts of a run; none where its summary is not whole."""
    with suppress(LookupError, TypeError, ValueError, AttributeError):
        return [*shortcomings(summary)], [*doubts(summary)]
    return [], []


def shortcomings(summary: Summary) -> Iterator[str]:
    """Yield the reasons why the result is incomplete, one sentence each; empty if it is complete."""
    inputs: Mapping[str, Any] = summary.get("inputs", {})
    causes = list(checked(summary, "error")) or ([] if is_explained(summary) else list(_uncorrected(summary)))
    follows = _cause(summary)[1]
    yield from causes
    if summary.get("failing"):
        yield f"the last solve failed ({summary['failing']}), and the estimate is the one before it: {_EXTREME}"
    elif not (summary.get("converged", True) or causes):
        is_doubtful = any(_believed(counts) < 1.0 - _DOUBTED for counts in inputs.values())
        yield f"the last solve did not converge ({summary['stop']}): {_CONTRADICTED if is_doubtful else _NOT_CONVERGED}"
    if stopped := sum(reasons.get("stopped", 0) for reasons in summary["counters"].values()):
        yield f"time jumped back, and time.on_jump is stop: {stopped} measurements after it were refused: {_ON_JUMP}"
    for name, counts in inputs.items():
        is_odometry = counts["use"] in MOTION
        if (causes or not is_odometry) and next(iter(_counted(summary, name, Effect.REFUSED)), "") in follows:
            continue
        if not counts["used"] and (counts["use"] != "odometry" or counts["received"] == 0):
            yield _unused(summary, name, counts["received"])
        elif _is_mostly_refused(summary, name):
            yield f"{name}: most of it was refused: {_because(summary, name, _counted(summary, name, Effect.REFUSED))}"
        elif not (is_odometry or causes) and (why := contradicts(name, counts["believed"] or 0, counts["used"])):
            yield why
        counted, received = summary["counters"].get(name, {}), counts["received"] or counts["used"]
        if is_odometry and (why := leaves_plane(name, counted, received)):
            yield why
        jumps = sum(of.get("jump", 0) for one, of in summary["counters"].items() if one.partition("#")[0] == name)
        if is_odometry and jumps > max(_MOST_JUMPS, _JUMPY * received) and "jump" not in follows:
            yield (
                f"{name}: {jumps} jumps, each begins a segment, and the motion across it is not used: odometry in "
                "metres and radians? A robot as fast as that: --set odometry.max_speed_m_s=..."
            )
        if (count := counted.get("frozen", 0)) > 2 and "frozen" not in follows:
            yield f"{name}: {explain('frozen').meaning} ({count} times): {remedy(name, 'frozen')}"
    for name, counted in summary["counters"].items():
        for why in ({"mount_assumed", "mount_unknown"} - {*follows}) & counted.keys():
            yield f"{name}: no transform has the place of its sensor, and one is assumed: {remedy(name, why)}"
    yield from _gyro_faults(summary)
    yield from association_faults(summary.get("association", {}))
    alarm: Mapping[str, Any] = next(reversed(summary.get("displacements", ())), {})
    if not causes and is_undecided(alarm):
        hint = _CONFUSED if summary.get("association") else "ids, units and clocks: graph_slam check BAG"
        yield f"{alarm['text']}, which is not decided: the end of the path is by odometry. {hint}"
    if not sum(counts["believed"] or 0 for counts in inputs.values()):
        yield (
            "this is odometry alone: no landmark, fix or closure is in the result; "
            "graph_slam check BAG says what of the recording cannot be used"
        )
    yield from _without_effect(summary.get("noise", ()))
    if summary["landmarks"] and summary["sightings"] == summary["landmarks"] and not causes:
        yield "no landmark was seen twice, so they correct nothing: do ids change? Each landmark needs its own"


def _without_effect(noise: Collection[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the inputs with so much noise that odometry is not measured by anything, from ``Noise`` as dictionaries."""
    measured = [one for one in noise if one["dof"] >= 1.0]
    if all(one["label"] != "odometry" for one in measured):
        for name in dict.fromkeys(one["source"] for one in measured if one["per_dof"] < _TOO_WIDE):
            yield (
                f"{name}: its noise is stated more than 100 times too large, so it corrects nothing, and this is "
                f"odometry alone: --set {name}.noise=sigmas --set {name}.sigma_m=..."
            )


def contradicts(name: str, accepted: int, count: int) -> str:
    """Return why an input is of little use if less than half of its measurements are believed; else empty."""
    if accepted >= _MOSTLY * count:
        return ""
    return f"{name}: only {accepted} of {count} are believed: {_CONTRADICT.format(name)}"


def leaves_plane(name: str, counted: Mapping[str, int], received: int) -> str:
    """Return that an odometry is not of a plane, if many of its poses are outside; else empty."""
    if counted.get("out_of_plane", 0) <= _OUT_OF_PLANE * received:
        return ""
    return f"{name} leaves the plane: these are three dimensions: --set world.dimensions=3"


def association_faults(found: Mapping[str, Any]) -> Iterator[str]:
    """Yield why the association in a ``MapView.association_report`` is not to be believed; empty if it is."""
    if found.get("is_doubtful"):
        missing, lost = 100.0 * found["missing_part"], 100.0 * found["lost_part"]
        yield (
            f"sightings without identity: {missing:.0f} % of the landmarks that should be seen are not, and the sensor "
            f"misses {lost:.1f} %: the map is probably wrong. {_CONFUSED}"
        )
    if not found.get("is_whole", True):
        yield (
            "sightings without identity: landmarks may be in the map twice, the search for those reached its limit "
            f"(moves_left). {_CONFUSED}"
        )


def is_undecided(alarm: Mapping[str, Any]) -> bool:
    """Return whether a ``Doubt`` as a dictionary is of where the robot is, goes on, and nothing is decided of it."""
    return "held_back" in alarm and all(alarm.get(key) is None for key in ("decided_ns", "ended_ns", "segment"))


def ambiguities(rivals: Collection[Mapping[str, Any]]) -> Iterator[str]:
    """Yield other explanations of the measurements that could not be ruled out: ``Backend.rivals`` as dictionaries."""
    if count := sum(len(rival["only_here"]) for rival in rivals):
        yield f"ambiguous: {count} loop closures that are not believed agree with one another as well"


def doubts(summary: Summary) -> Iterator[str]:
    """Yield a sentence for each input of which many measurements are rejected, and for what makes a result doubtful.

    That are visits that contradict others, and other explanations.
    """
    if is_explained(summary):
        return
    yield from checked(summary, "warning")
    for text in ambiguities(summary.get("rivals", ())):
        yield f"{text} (graph_slam explain RUN)"
    yield from filter(None, [wrong_sides(summary.get("landmarks", 0), summary.get("waiting", {}))])
    if renewed := summary.get("renewed_ids"):
        yield renewed_text(renewed)
    contested = {} if renewed or summary.get("uncorrected") else summary.get("contested", {})
    for name, (out, count) in contested.items() if len(contested) <= _MANY * summary.get("landmarks", 0) else ():
        yield f"{name}: {out} of {count} sightings are not believed: did it move, or is its id used twice?"
    yield from visit_faults(summary["counters"].get("map", {}))
    for name, count in Counter(name.partition("#")[0] for name in summary.get("inputs", {})).items():
        if count > 1:
            yield (
                f"{name}: {count} odometries are on its topic ({name}, {name}#2, ...), or one that jumps. Each needs a "
                "topic and an input of its own (inputs.names); one that jumps: is it in metres and radians?"
            )
    for name, counts in summary.get("inputs", {}).items():
        accepted, has_cause = _believed(counts), name == _cause(summary)[0] or summary.get("uncorrected")
        if _MOSTLY <= accepted < 1.0 - _DOUBTED and not has_cause:
            part, hint = 100.0 * (1.0 - accepted), _CONTRADICT.format(name)
            yield f"{name}: {part:.0f} % of {counts['used']} are not believed: {hint}"


def is_explained(summary: Summary) -> bool:
    """Return whether all doubts may be consequences: of an error of the recording, or of an input mostly refused."""
    inputs = [name for name in summary.get("inputs", ()) if "#" not in name]  # not a second odometry of a topic
    return any(checked(summary, "error")) or any(_is_mostly_refused(summary, name) for name in inputs)


def _is_mostly_refused(summary: Summary, name: str) -> bool:
    refused = sum(_counted(summary, name, Effect.REFUSED).values())
    return bool(refused > _MOSTLY * (refused + summary["inputs"][name]["used"]))


def _believed(counts: Mapping[str, Any]) -> float:
    """Return which part of the measurements of an input is believed; all of odometry, and of none."""
    return 1.0 if counts["use"] in MOTION or not counts["used"] else (counts["believed"] or 0) / counts["used"]


def _cause(summary: Summary) -> tuple[str, tuple[str, ...]]:
    """Return the input that the finding of the recording is of, and what follows from it."""
    if found := summary.get("check"):
        return found.get("evidence", {}).get("input", ""), FOLLOWS.get(found.get("code", ""), ())
    lost = [name for name, of in summary.get("inputs", {}).items() if of["use"] == "odometry" and "#" not in name]
    own = [_counted(summary, name, Effect.REFUSED) for name in lost if _is_mostly_refused(summary, name)]
    return "", tuple(one for one in FOLLOWS["wrong_stamps"] if own and not any(one in reasons for reasons in own))


def _uncorrected(summary: Summary) -> Iterator[str]:
    for one in summary.get("uncorrected", ()):
        settings = {key: value for key, value in one["settings"].items() if f"{key}=" not in one["text"]}
        mend = " ".join(f"--set {shlex.quote(f'{key}={value}')}" for key, value in settings.items())
        yield f"{one['text']}{mend and ': '}{mend} (graph_slam calibrate BAG compares the causes)"


def renewed_text(found: str) -> str:
    """Return that all ids are new from some time on, and what mends it."""
    return f"ids_renewed: {found} {KINDS['ids_renewed']}"


def condensed_text(summary: Mapping[str, Any]) -> str:
    """Return which keyframes were condensed, or why none was in a long drive; empty in a short one."""
    if count := summary.get("condensed"):
        return f"keyframes 0 to {count - 1}, into places"
    why = summary.get("not_condensed", "")
    return f"nothing: not with {why} yet, so the map grows with the distance driven" if why else ""


def visit_faults(counted: Mapping[str, int]) -> Iterator[str]:
    """Yield why a condensed map is worse than it should be, by how often visits ended how (``VISITS``)."""
    condensed, lost, wider = (counted.get(name, 0) for name in VISITS)
    doubted, visits = lost + wider, condensed + lost
    if doubted >= _FEWEST_LOST and doubted > _DOUBTED * visits:
        yield (
            f"map.condense: {doubted} of {visits} visits contradict themselves or the others, so the noise or the "
            "calibration is wrong, and the map may be much worse than with all keyframes: compare with --set "
            "map.condense=false, run graph_slam check on the recording, or keep more by map.window_keyframes"
        )


def checked(summary: Summary, severity: str) -> Iterator[str]:
    """Yield the worst finding of the recording if it is severe enough and a cause; ``graph_slam check`` lists all."""
    found = summary.get("check")
    follows = {code for one in summary.get("uncorrected", ()) for code in FOLLOWS.get(one.get("code", ""), ())}
    if found is not None and found["severity"] == severity and found["code"] not in follows:
        mend = " ".join(f"--set {shlex.quote(text)}" for text in found["settings"])
        yield f"{found['code']}: {found['text']}{'; ' if mend else ''}{mend} (graph_slam check BAG lists all)"


def unscaled(summary: Summary) -> Iterator[str]:
    """Yield why noise that should be estimated is as configured, though something was solved."""
    why = summary.get("noise_unknown")
    if why and summary.get("noise_scale") == "estimated" and summary["landmarks"]:
        yield f"robust.noise_scale=estimated: no noise could be estimated at the end: {why}"


def _unused(summary: Summary, name: str, received: int | None) -> str:
    if not received and received is not None:
        return f"{name}: no message came"
    messages = "" if received is None else f" of {received} messages"
    counted = _counted(summary, name, Effect.REFUSED) or _counted(summary, name, Effect.NOTED)
    if not counted and summary["waiting"]:
        return f"{name}: nothing{messages} was used: {len(summary['waiting'])} landmarks are not determined (waiting)"
    return f"{name}: nothing{messages} was used: {_because(summary, name, counted)}"


def _because(summary: Summary, name: str, counted: Mapping[str, int]) -> str:
    if not counted:
        return "it holds nothing"
    reason = next(iter(counted))
    mend = _remedy(summary, name, reason)
    return f"{reason} {counted[reason]} ({explain(reason).meaning})" + (f"; {mend}" if mend else "")


def _remedy(summary: Summary, name: str, reason: str) -> str:
    """Return what mends a reason; of a frame that is unknown since transforms name none, what mends the transforms."""
    if reason in _cause(summary)[1]:
        return ""
    empty = [one for one in ("tf", "tf_static") if summary["counters"].get(one, {}).get("frame_empty")]
    return remedy(empty[0], "frame_empty") if empty and reason == "frame_unknown" else remedy(name, reason)


def _counted(summary: Summary, name: str, effect: Effect) -> dict[str, int]:
    """Reasons of one effect for an input, the most frequent first."""
    some = [(r, times) for r, times in summary["counters"].get(name, {}).items() if explain(r).effect is effect]
    return dict(sorted(some, key=lambda one: (-one[1], one[0])))


def wrong_sides(landmarks: int, waiting: Mapping[str, str]) -> str:
    """Return that landmarks may be on the wrong side of the path, where many that wait are undecided; else nothing."""
    undecided = sum(_TWO in reason for reason in waiting.values())
    if landmarks < _FEWEST or undecided < max(_FEWEST, _MANY * (landmarks + len(waiting))):
        return ""
    return (
        f"ranges alone: of {undecided} of {landmarks + len(waiting)} landmarks two places fit, one on either side of "
        "the path, so they are not used; others may be in the map on the wrong side, and covariances do not contain "
        "that. Drive more turns in sight of them, or add bearings or surveyed landmarks (landmarks.surveyed)"
    )
