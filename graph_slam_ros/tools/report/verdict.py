"""The verdict on a run in a few sentences, and its tables."""

import math
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from graph_slam_ros import __version__
from graph_slam_ros.analysis.consistency import should_be
from graph_slam_ros.analysis.explain import inert_gates
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.config.config import Config, parameters
from graph_slam_ros.findings.table import Effect, explain, remedy
from graph_slam_ros.runs import outcome
from graph_slam_ros.runs.tables import INPUT_COLUMNS
from graph_slam_ros.slam.noise.scale import NoiseScale
from graph_slam_ros.tools.report.packing import shown

Row = list[Any]
_FINE = 0.5, 2.0  # chi2 per degree of freedom
_MOST_NEES = 2.0  # times what is expected
_MOST_REASONS = 3  # that are named: of rejected measurements, and of what else is wrong


def verdict(
    run: Path,
    summary: Mapping[str, Any],
    saved: SavedGraph | None,
    scores: Any,
    losses: Sequence[str],
    jump: Sequence[Any] = (),
) -> list[str]:
    """Sentences: the verdict with its reason, what else is wrong, the figures, and what was not believed.

    Parameters
    ----------
    saved : the graph; None if it cannot be read
    scores : of the evaluation, None without truth
    jump : keyframe and distance [m] of the largest jump of ``map -> odom``, if it is large
    """
    if saved is None:
        return [f"There is no map to show: {losses[0] if losses else 'the run holds no keyframe'}."]
    again = f"(graph_slam recover {shlex.quote(str(run))} --out DIR writes its results anew)"
    doubts = [f"a part of the run is lost: {loss} {again}" for loss in losses[:1]]
    if summary.get("ended") is False:
        doubts = [f"it is still being written, or was cut off, and this is its map so far {again}"]
    found = outcome.findings(summary)
    short, more = ([str(one) for one in found if one.severity == kind] for kind in ("error", "warning"))
    if summary.get("is_incomplete"):  # so are its counters
        short, more = [f"the run was ended before its last results were written {again}"], []
    doubts += more
    doubts += list(scores.warnings) if scores is not None else []
    doubts += inert_gates(saved)
    doubts += _covariances(saved, scores)
    first, *others = [*(one if one.endswith((".", "?")) else f"{one}." for one in (*short, *doubts)), ""]
    has_inputs = any(one["use"] for one in summary.get("inputs", {}).values())  # a graph's have no use
    fine = f"No measurement of this run speaks against this map: {_fit(saved)}."
    fine += " graph_slam check looks at the recording." * has_inputs
    out = [f"{'Do not rely on this map yet' if short else 'Use this map with care'}: {first}" if first else fine]
    out += [f"Also: {one}" for one in others[:_MOST_REASONS] if one]
    out += [f"map -> odom jumped by up to {jump[1]:.2f} m, at keyframe {jump[0]}."] if jump else []
    size = f"{len(saved.view.keyframes)} keyframes and {summary.get('landmarks', len(saved.landmarks))} landmarks"
    if scores is not None:
        size += f", position error {scores.estimate.position_m['rmse']:.3f} m (RMSE, {scores.scored['frame']})"
        if scores.odometry is not None:
            size += f", dead reckoning {scores.odometry.position_m['rmse']:.3f} m"
    out += [f"{size}{f'; {_fit(saved)}' if first else ''}.", _judged(saved)]
    if scores is None and not first:
        again = shlex.join(["graph_slam", "report", str(run), "--truth", "TRUTH"])
        out.append(f"Next: compare it with a ground truth, if there is one: {again}.")
    return out


def _covariances(saved: SavedGraph, scores: Any) -> list[str]:
    """A sentence where errors against the truth are far larger than the covariances say; else none."""
    found = scores.consistency if scores is not None and not scores.warnings else None
    both = {"poses": found.poses, "landmarks": found.landmarks} if found else {}
    far = {name: one for name, one in both.items() if one and one.mean >= _MOST_NEES * one.dof}
    bad = [f"{name} {one.mean:.1f}, where {one.dof} is expected" for name, one in far.items()]
    if not bad:
        return []
    advised = [line for line in scores.consistency.advice.splitlines() if "--set" in line]
    estimated = f"; {'; '.join(advised)}" if advised else ""
    return [f"its covariances are too small: NEES of {', of '.join(bad)}{estimated}"]


def _fit(saved: SavedGraph) -> str:
    ratio = chi2_per_dof(saved)
    if ratio is None:
        return "nothing in it can be compared with its noise"
    which = "as large as" if _FINE[0] <= ratio <= _FINE[1] else "larger than" if ratio > 1.0 else "smaller than"
    chi2, dof = saved.solver.evaluate().chi2_final, saved.solver.degrees_of_freedom
    return f"residuals are {which} the stated noise (chi2 {chi2:.1f} of {dof} degrees of freedom)"


def chi2_per_dof(saved: SavedGraph) -> float | None:
    """Chi2 by the residuals that are not used up by unknowns; None without any."""
    dof = saved.solver.degrees_of_freedom
    return saved.solver.evaluate().chi2_final / dof if dof > 0 else None


def _judged(saved: SavedGraph) -> str:
    judged = [e for e in saved.entries if e.verdict]
    if not judged:
        return "The map is odometry alone: no landmark, fix or closure is in it."
    out = [e for e in judged if not e.is_in]
    weak = sum(e.verdict.name == "DOWN_WEIGHTED" for e in judged)
    low = f"; {weak} more have little weight" if weak else ""
    condensed = sum(sum(of.values()) for of in saved.view.bounded.accepted.values()) if saved.view.bounded else 0
    low += f"; {condensed} more were believed, and are condensed" if condensed else ""
    if not out:
        return f"All {len(judged)} measurements are in the map{low}."
    counted = Counter((e.source or e.label, e.reason.name.lower().replace("_", " ")) for e in out)
    several = [f"{times} of {shown(name)} ({why})" for (name, why), times in counted.most_common(_MOST_REASONS)]
    rest = "; the most are " if len(counted) > _MOST_REASONS else ": "
    return f"{len(out)} of {len(judged)} measurements are not in the map{rest}{', '.join(several)}{low}."


# -- tables ------------------------------------------------------------------------------------------------------------


def inputs(summary: Mapping[str, Any]) -> list[Row]:
    """A row for each input: received, used, believed, refused; and one for each reason, with its remedy."""
    rows: list[Row] = []
    of_inputs = summary.get("inputs", {})
    counters = summary.get("counters", {})
    for name in dict.fromkeys([*of_inputs, *counters]):
        of = of_inputs.get(name, {})
        counts = counters.get(name, {})
        refused = sum(times for reason, times in counts.items() if explain(reason).effect is Effect.REFUSED)
        numbers = [(of | {"refused": refused}).get(column) for column in INPUT_COLUMNS]
        rows.append([shown(name), of.get("use", ""), *numbers, "", ""])
        for reason, times in sorted(counts.items(), key=lambda one: -one[1]):
            row = explain(reason)
            why = f"{reason}: {row.meaning}"
            rows.append(["", row.effect.value, None, None, None, times, why, remedy(name, reason)])
    return rows


def configuration(config: Config) -> list[Row]:
    """The parameters that differ from their defaults: name, value, default, meaning."""
    known = {p.name: p for p in parameters(config.inputs.names.split())}
    of = [(known[name], value) for name, value in config.differing.items()]
    return [[shown(p.name), shown(str(value)), shown(str(p.default)), p.meaning] for p, value in of]


def versions(run: Path, summary: Mapping[str, Any]) -> list[Row]:
    """Versions, and what tells the files of the run from others."""
    recording = str(summary.get("recording") or "a live run, or not known")
    rows = [
        ["report made by", f"graph_slam_ros {__version__}"],
        ["run written by", f"graph_slam_ros {summary.get('version', '?')}"],
        ["run folder", shown(run.resolve().name)],
        ["recording", shown(recording)],
    ]
    for kind in ("recorded", "files"):
        of = summary.get(kind)
        if isinstance(of, dict):
            rows += [[shown(str(name)), shown(str(mark))] for name, mark in sorted(of.items())]
    return rows


def timing(summary: Mapping[str, Any]) -> list[Row]:
    """Time, memory and backlog of the run, as its summary has them."""
    cpu_s, span_s, solves = (summary.get(name) or None for name in ("cpu_s", "span_s", "solves"))
    known = {
        "time": (summary.get("time_s"), "{:.1f} s"),
        "CPU time": (cpu_s, "{:.1f} s"),
        "span of the drive": (span_s, "{:.1f} s"),
        "CPU time per second of the drive": (cpu_s and span_s and cpu_s / span_s, "{:.3f} s"),
        "solves": (solves, "{}"),
        "CPU time per solve, with all else": (cpu_s and solves and 1e3 * cpu_s / solves, "{:.2f} ms"),
        "backlog at the end": (summary.get("unprocessed"), "{} measurements accepted and not processed"),
    }
    rows: list[Row] = [[name, text.format(value)] for name, (value, text) in known.items() if value is not None]
    load = dict(summary.get("load") or {})
    if load:
        rows.append(["largest backlog", f"{max(load['backlog'])} measurements"])
        rows.append(["memory, at most", f"{max(load['memory_mib']):.0f} MiB, with Python and its libraries"])
    else:
        rows.append(["memory", "not in this run folder: it was not ended"])
    return rows


def load(summary: Mapping[str, Any]) -> dict[str, list[float]] | None:
    """CPU time for each keyframe [ms], memory [MiB] and backlog over the keyframes; None if the summary has no two."""
    rows = dict(summary.get("load") or {})
    at = [float(k) for k in rows.get("keyframes", ())]
    if len(at) < 2:
        return None
    cpu = [float(s) for s in rows["cpu_s"]]
    each = [1e3 * (b - a) / max(1.0, n - m) for a, b, m, n in zip(cpu, cpu[1:], at, at[1:], strict=False)]
    return {"keyframes": at[1:], "cpu_ms": each, "memory_mib": rows["memory_mib"][1:], "backlog": rows["backlog"][1:]}


def noise(summary: Mapping[str, Any], scores: Any = None) -> list[Row]:
    """Chi2 per degree of freedom and the factor that sigmas should have, by class, input and part."""
    rows, over_confident = [], scores.consistency.over_confidence if scores is not None and scores.consistency else ""
    for one in summary.get("noise", ()):
        name = " ".join(filter(None, (one["label"], one["source"], one["part"])))
        scale = NoiseScale.from_dict(one)
        per_dof = scale.per_dof if math.isfinite(scale.per_dof) else None
        rows.append([shown(name), one["dof"], per_dof, one["design_effect"], should_be(scale, over_confident)])
    return rows


def classes(summary: Mapping[str, Any]) -> Iterator[Row]:
    """Edges, numbers and chi2 of each class."""
    for name, of in summary.get("classes", {}).items():
        residuals = of.get("residuals", 0)
        yield [shown(name), of["edges"], residuals, of["chi2"], of["chi2"] / residuals if residuals else None]
