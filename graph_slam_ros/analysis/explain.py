"""Explain the decisions of a saved run, as a whole or for one edge, in sentences."""

import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import gammainc

from graph_slam_ros.analysis import measurement_text
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import FormatError, GaugeError, GraphSlamError, SingularError, did_you_mean
from graph_slam_ros.formats.strict import integer
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.runs import outcome
from graph_slam_ros.runs.condensed_map import read_left_edges
from graph_slam_ros.runs.folder import SUMMARY, summary_of
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.runs.restore import of_all
from graph_slam_ros.slam import Config
from graph_slam_ros.slam.bounded_map import CONDENSED
from graph_slam_ros.slam.edits import HAND_MADE
from graph_slam_ros.slam.robust.ledger import FINAL, Reason, Verdict, VerdictChange

STATES = {
    Verdict.NOT_EVALUATED: "not judged",
    Verdict.ACCEPTED: "accepted",
    Verdict.DOWN_WEIGHTED: "down-weighted",
    Verdict.PENDING: "held back",
    Verdict.REJECTED: "rejected",
}
"""What a person reads of a verdict."""
REASONS = {one: one.name.lower().replace("_", " ") for one in Reason} | {Reason.NONE: ""}
_KIND = {
    "closures": "a loop closure",
    "landmarks": "a sighting",
    "fixes": "a fix",
    "odometry": "odometry",
    "by_hand": "an edge that was let in or added",
}
_BECAME = {
    CONDENSED: "condensed (believed; a place or a longer motion has what they measured)",
    "expired": "expired (not believed, and can no longer come back)",
}
_SHOWN = 5
_WIDTH = 110
_SAME = 0.99
_FAR = 0.5  # of the gate is the largest statistic that was ever seen
_CHANCE = 1e-4  # that so many would all stay below that, were their noise as it is told


# -- the whole ---------------------------------------------------------------------------------------------------------


def explain_run(run: SavedGraph) -> Iterator[str]:
    """Count the edges by class, verdict and reason, list the worst, and warn of gates that reject nothing.

    Raises FormatError: the summary of the run is invalid.
    """
    entries, summary = run.entries, summary_of(run.folder)
    for one in outcome.findings(summary):
        yield from _line("found", str(one))
    judged = [entry for entry in entries if entry.verdict]
    yield f"{len(entries)} edges; {len(judged)} are measurements that can be rejected, the others odometry and priors"
    if judged:
        yield from _table(judged)
    yield from _worst(e for e in judged if not e.is_in and e.reason not in FINAL)
    yield from _least(e for e in judged if e.is_in)
    yield from condensed_lines(run)
    yield from (f"warning: {text}" for text in inert_gates(run))
    yield from (f"by hand: {one.text}" for one in run.edits)
    yield from _rivals(run.folder, summary)
    yield from (one["text"] for one in summary.get("displacements", ()) if "text" in one)


def _table(entries: Sequence[Entry]) -> Iterator[str]:
    counts = Counter((e.label, _state(e.verdict, e.reason)) for e in entries)
    labels, states = dict.fromkeys(e.label for e in entries), sorted({state for _, state in counts})
    widths = [max(8, len(state)) for state in states]
    yield "  " + f"{'':12s}" + "".join(f"  {state:>{width}s}" for state, width in zip(states, widths, strict=True))
    for label in labels:
        numbers = [f"  {counts[label, state]:{width}d}" for state, width in zip(states, widths, strict=True)]
        yield f"  {label:12s}" + "".join(numbers)


def _worst(entries: Iterable[Entry]) -> Iterator[str]:
    """The worst rejected edges: those whose statistic is farthest above its threshold."""
    worst = sorted(entries, key=lambda e: -e.statistic / e.threshold)[:_SHOWN]
    if worst:
        yield "rejected or held back; the farthest above its threshold first:"
    yield from (_row(e, f"chi2 {e.statistic:10.4g} against {e.threshold:6.4g}") for e in worst)


def _least(entries: Iterable[Entry]) -> Iterator[str]:
    least = sorted(entries, key=lambda e: -e.chi2 / e.dof)[:_SHOWN]
    if least:
        yield "accepted; the largest chi2 first:"
    yield from (_row(e, f"chi2 {e.chi2:10.4g} with {e.dof} degree{'s' * (e.dof > 1)} of freedom") for e in least)


def _row(e: Entry, numbers: str) -> str:
    return f"  edge {e.edge:<7d} {e.about:24s} keyframe {e.keyframe:<6d} {numbers}   {_state(e.verdict, e.reason)}"


def inert_gates(run: SavedGraph) -> Iterator[str]:
    """Yield gates that reject nothing: every statistic is far below them, more than correct noise explains."""
    if not run.config.robust.decide:
        yield "robust.decide is false: no measurement is ever held back or rejected"
        return
    entries = [e for e in run.entries if e.verdict]
    gate = {e.edge: quantile(run.config.robust.gate, e.dof) for e in entries}
    seen = {e.edge: e.statistic for e in entries}
    for change in run.changes:
        if change.edge in seen:
            seen[change.edge] = max(seen[change.edge], change.statistic)
    for label in dict.fromkeys(e.label for e in entries):
        of_label = [e for e in entries if e.label == label]
        largest = max(seen[e.edge] / gate[e.edge] for e in of_label)
        below = gammainc([0.5 * e.dof for e in of_label], [0.5 * largest * gate[e.edge] for e in of_label])
        if largest < _FAR and below.prod() < _CHANCE:
            yield (
                f"the gate of {label} is inert: of {len(of_label)} the largest chi2 ever seen is"
                f" {largest:.2g} of it; the stated noise is too large, and false measurements may pass"
            )


def _rivals(folder: Path, summary: Mapping[str, Any]) -> Iterator[str]:
    """The hypotheses that the last search could not rule out."""
    try:
        rows = [_rival(folder, rival) for rival in summary.get("rivals", ())]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(f"{folder / SUMMARY}: not the summary of a run: {error!r}") from None
    yield from rows


def _rival(folder: Path, rival: Mapping[str, Any]) -> str:
    costs = f"this explanation costs {rival['best_cost']:.4g}, another {rival['cost']:.4g}"
    here, there = (" ".join(f"{edge:d}" for edge in rival[which]) for which in ("only_here", "only_there"))
    tried = f"graph_slam explain {folder} --with {here}" + (f" --without {there}" if there else "")
    return f"warning: ambiguous: {costs}: {tried}"


# -- one edge, or a landmark's -----------------------------------------------------------------------------------------


def explain_edge(run: SavedGraph, which: str) -> Iterator[str]:
    """Explain an edge, by id, or the observations of a landmark, by name.

    Raises GraphSlamError: there is no such edge or landmark.

    If the name of a landmark is a number, write ``landmark:7``; ``7`` is edge 7.
    """
    return _edge(run, integer(which)) if which.isdecimal() else _landmark(run, which.removeprefix("landmark:"))


def _landmark(run: SavedGraph, name: str) -> Iterator[str]:
    entries = run.entries
    seen = [e for e in entries if name in run.landmarks_of(e)]
    left = [row for row in edges_that_left(run) if row["landmark"] == name]
    if not (seen or left):
        names = sorted({e.landmark for e in entries} - {""})
        there = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
        raise GraphSlamError(
            f"{name}: neither the id of an edge nor a landmark; there are {there or 'no landmarks'}"
            f"{did_you_mean(name, names)}"
        )
    if seen:
        yield from landmark_lines(run.folder, name, seen)
    if left:
        yield f"landmark {name}: {len(left)} edges are not in the map any more: {became(left)}"


def landmark_lines(folder: Path, name: str, seen: Sequence[Entry]) -> Iterator[str]:
    """Explain a landmark by its edges: how many there are of each verdict, and the worst of them."""
    yield f"landmark {name}: {len(seen)} edges, from keyframe {seen[0].keyframe} to {seen[-1].keyframe}"
    yield from _table(seen)
    out = [e for e in seen if not e.is_in]
    yield from _worst(out)
    yield from _least(e for e in seen if e.is_in)
    if out:
        yield f"graph_slam explain {folder} {out[0].edge} prints all about the first"


def _edge(run: SavedGraph, edge: int) -> Iterator[str]:
    if left := [row for row in edges_that_left(run) if row["edge"] == str(edge)]:
        yield from (line for what, text in statements_of_one_that_left(run, left[0]) for line in _line(what, text))
        return
    e = run.edge(edge)
    if e.label == PLACES:
        yield from (line for what, text in statements_of_place(run, e) for line in _line(what, text))
        return
    history, fields = [change for change in run.changes if change.edge == edge], fields_of(run, e)
    yield title(e, run).format(**fields)
    for what, text in statements(e, run, is_changed=bool(history)):
        yield from _line(what, text.format(**fields))
    for change in history if e.verdict else ():
        yield from _line("changed", change_text(change))
    for one in run.edits:
        if edge in (*one.edges, *one.added):
            yield from _line("by hand", one.text)
    if not e.verdict:
        return
    if e.reason not in FINAL:
        yield from _what_if(run, e)
    if not e.is_in:
        yield from _line("to change", remedy(e).format(**fields))


# -- sentences: templates, which are filled in with the fields of an edge, here and in the page of a report ------------


def fields_of(run: SavedGraph, e: Entry) -> dict[str, Any]:
    """The values of the fields that sentences have."""
    numbers = {name: float(column[0]) for name, column in measurement_text.columns([e]).items()}
    ends = {f"end{slot}": run.name(vertex) for slot, vertex in enumerate(e.vertices)}
    own = ("edge", "source", "landmark", "keyframe", "stamp_s", "statistic", "threshold", "chi2", "percent")
    factor = {} if e.is_in or e.reason in FINAL else {"sigma_factor": e.sigma_factor}
    return {name: getattr(e, name) for name in own} | factor | numbers | ends


def title(e: Entry, run: SavedGraph) -> str:
    """An edge's title: its kind, the landmarks that it is of, and the verdict on it."""
    of = "{landmark}" if e.landmark else " and ".join(map(_literal, run.landmarks_of(e)))
    by = e.source and (f" {e.source}" if e.source == HAND_MADE else " by {source}")
    return f"edge {{edge}}: {_KIND.get(e.label, e.label)}{of and f' of {of}'}{by}: {_state(e.verdict, e.reason)}"


def ends_of(e: Entry, run: SavedGraph) -> list[str]:
    """Call the vertices of an edge: keyframes by their numbers, landmarks by their names."""
    out, name = list[str](), e.landmark and "{landmark}"
    for slot, vertex in enumerate(e.vertices):
        if run.keyframe(vertex) is not None:
            out.append(f"keyframe {{end{slot}}}")
        elif name or run.landmark_of(vertex):
            out.append(f"landmark {name or _literal(run.landmark_of(vertex))}")
            name = ""  # the landmark of an edge is one vertex
        else:
            out.append(f"vertex {{end{slot}}}")
    return out


def _literal(text: str) -> str:
    return text.replace("{", "{{").replace("}", "}}")


def statements(e: Entry, run: SavedGraph, *, is_changed: bool) -> Iterator[tuple[str, str]]:
    """Sentences on an edge, each with its name: what was measured, what was decided, and how it fits now."""
    yield "stamp", "{stamp_s:.3f} s, of the newest keyframe that it is attached to"
    yield "judged", "first at keyframe {keyframe}"
    yield "between", " and ".join(ends_of(e, run))
    yield "measured", measurement_text.template(e, "measured")
    yield "sigmas", measurement_text.template(e, "sigmas")
    yield "expected", f"{measurement_text.template(e, 'expected')}, when it was judged first"
    yield "decided", _decided(e, run.config, is_changed=is_changed)
    if e.verdict:
        yield "now", "chi2 {chi2:.4g} by its own noise; {percent:.3g} % of its weight counts"


def change_text(c: VerdictChange) -> str:
    """One change of a verdict."""
    return f"at keyframe {c.keyframe}: {_state(c.verdict, c.reason)}, chi2 {c.statistic:.4g} against {c.threshold:.4g}"


def _decided(e: Entry, config: Config, *, is_changed: bool) -> str:
    limit = quantile(config.robust.gate, e.dof)
    chance = f"noise alone exceeds {limit:.4g} once in {1.0 / (1.0 - config.robust.gate):.0f} times"
    if e.threshold < _SAME * limit:
        chance += f", and what was accepted of {e.label} is much smaller than its stated noise"
    elif limit < _SAME * e.threshold:
        chance += ", but all noise may be larger than stated, robust.noise_factor"
    numbers = f"chi2 {{statistic:.4g}} with {e.dof} degree{'s' * (e.dof > 1)} of freedom"
    allowed = f"up to {{threshold:.4g}} would have passed ({chance})"
    if not e.verdict:
        return "nothing: odometry and priors are not judged"
    match e.reason:
        case Reason.UNLIKELY:
            return f"accepting it would have raised the cost by {numbers}, after all else had moved for it; {allowed}"
        case Reason.DOES_NOT_FIT:
            return f"after a solve with it, it had {numbers}; {allowed}"
        case Reason.OUTVOTED:
            return f"in the solution of least cost of the whole graph it has {numbers}; {allowed}"
        case Reason.WITHDRAWN:
            return "not by its chi2: a user cleared or removed it, or association gave it to another landmark"
        case Reason.QUARANTINED:
            return "not by its chi2: several solves in a row failed with it, and succeeded without it"
        case Reason.BY_HAND:
            return "not by its chi2: a user decided it by hand"
        case Reason.DISPLACED:
            return (
                "{statistic:.0f} sightings more agreed on another pose of the robot than on this motion: it was"
                " carried, or its wheels slipped; an edge with very large noise replaces it"
            )
        case Reason.SLIP:
            return (
                "its stretch slips: the landmarks make that {statistic:.1f} likelier than not (twice the logarithm),"
                " more than {threshold:.1f}, the odds against it; an edge with more noise replaces it"
            )
    if e.verdict is Verdict.DOWN_WEIGHTED:
        return f"it is accepted, but its loss leaves it little weight: {numbers}, above {{threshold:.4g}} ({chance})"
    return f"{'it was accepted later' if is_changed else 'it was accepted at once'}: {numbers}; {allowed}"


def _what_if(run: SavedGraph, e: Entry) -> Iterator[str]:
    which = "out" if e.is_in else "in with its full weight"
    try:
        moved = run.moved(run.solve([e.edge] if e.is_in else [], [] if e.is_in else [e.edge]))
    except (GaugeError, SingularError) as error:
        yield from _line("what if", f"it were {which}: nothing could be solved: {error}")
        return
    grown, (most, most_m) = moved.after.chi2_final - moved.before.chi2_final, moved.most
    text = f"it were {which}: chi2 {grown:+.4g}, the last pose moves by {moved.final[0]:.3f} m"
    yield from _line("what if", f"{text}, keyframe {run.keyframe(most)} the most, by {most_m:.3f} m")
    if not e.is_in:
        for edge, before, after in [w for w in moved.worse if w[0] != e.edge][:_SHOWN]:
            other = f"edge {edge} ({run.edge(edge).about})"
            yield from _line("against", f"{other}, whose chi2 would go from {before:.3g} to {after:.3g}")


def remedy(e: Entry) -> str:
    """The remedy for an edge that is out."""
    if e.reason in FINAL:
        return f"nothing in this run: {REASONS[e.reason]} is final; replay the run with another configuration"
    return (
        "it is accepted by itself as soon as the map agrees with it. If you know that it is true, a stated noise is too"
        " small, its own or that of the edges against it: with all sigmas {sigma_factor:.3g} times as large it would"
        " pass (robust.noise_factor). With robust.decide=false nothing is held back"
    )


# -- words -------------------------------------------------------------------------------------------------------------


def _state(verdict: Verdict, reason: Reason) -> str:
    return f"{STATES[verdict]}: {REASONS[reason]}" if reason else STATES[verdict]


def _line(what: str, text: str) -> Iterator[str]:
    """A paragraph with its name at the left; no word is broken, so that commands and names stay whole."""
    wrapper = textwrap.TextWrapper(_WIDTH, f"{what:11s}", " " * 11, break_long_words=False, break_on_hyphens=False)
    yield from wrapper.wrap(text)


# -- what has left a map when visits were condensed, and the places that it is in -------------------------------------


def edges_that_left(run: SavedGraph) -> Iterator[Mapping[str, str]]:
    """Yield the edges that have left the map, by column: see ``CondensedEdge``.

    Those that left after the map was recorded last, in a run that was killed, are still in it, and are none of these.
    """
    if run.view.bounded is not None:
        yield from (row for row in read_left_edges(run.folder) if not run.graph.edge_ids.has(int(row["edge"])))


def became(rows: Sequence[Mapping[str, str]]) -> str:
    """Count edges that have left a map by what they became."""
    counts = Counter(row["became"] for row in rows)
    return ", ".join(f"{counts[name]} {text}" for name, text in _BECAME.items() if counts[name])


def condensed_lines(run: SavedGraph) -> Iterator[str]:
    """Say how much of a map is condensed; nothing if none is."""
    if run.view.bounded is None:
        return
    places = [one.place for several in run.view.bounded.places.values() for one in several]
    visits, keyframes = sum(one.visits for one in places), run.view.keyframes.first
    yield f"condensed: keyframes 0 to {keyframes - 1}, into {len(places)} places of {visits} visits"
    factor = run.view.bounded.scale.factor
    if factor > 1.0:
        yield f"  visits to a place differ by {np.sqrt(factor):.1f} times their sigmas: the sigmas are scaled by that"
    if rows := list(edges_that_left(run)):
        yield f"  their edges: {became(rows)}"


def statements_of_one_that_left(run: SavedGraph, row: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Sentences on an edge that has left the map, each with its name."""
    of, by = row["landmark"] and f" of {row['landmark']}", row["source"] and f" by {row['source']}"
    verdict = STATES[Verdict[row["verdict"].upper()]]
    reason = "" if row["reason"] == "none" else f": {row['reason'].replace('_', ' ')}"
    yield f"edge {row['edge']}", f"{row['label']}{of}{by}: {verdict}{reason}; {row['became']}"
    yield "stamp", f"{1e-9 * int(row['stamp_ns']):.3f} s, of the newest keyframe that it was attached to"
    yield "judged", f"first at keyframe {row['keyframe']}"
    if row["verdict"] != "not_evaluated":
        numbers = float(row["statistic"]), float(row["threshold"])
        yield "decided", f"chi2 {numbers[0]:.4g} with {row['dof']} degrees of freedom, against {numbers[1]:.4g}"
    if row["became"] == CONDENSED:
        yield "now", "what it measured is in a place, or in a longer motion, and its verdict is final"
    else:
        yield "now", "it was not believed when its visit was condensed, and can no longer come back"
    yield "what if", f"it were otherwise needs all keyframes: {of_all(run.folder)}; then explain --without"


def statements_of_place(run: SavedGraph, e: Entry) -> Iterator[tuple[str, str]]:
    """Sentences on the edge of a place, each with its name."""
    places = run.view.bounded.places if run.view.bounded else {}
    several = ((cell, one) for cell, all_of_it in places.items() for one in all_of_it)
    found = next(((cell, one) for cell, one in several if one.edge == e.edge), None)
    if found is None:
        yield f"edge {e.edge}", "an earlier place: what it measured is in the place that took over from it"
        return
    cell, place = found
    base, *members = e.vertices
    width = run.config.map.cell_m
    corner = " ".join(f"{width * c:.4g}" for c in cell)
    visits = f"{place.place.visits} visit{'s' * (place.place.visits > 1)}"
    yield f"edge {e.edge}", f"a place: {visits} to the cell of {width:.4g} m at {corner} m"
    yield "base", f"keyframe {run.keyframe(base)}"
    names = (run.landmark_of(v) or f"keyframe {run.keyframe(v)}" for v in members)
    texts = [f"{name} ({sigmas})" for name, sigmas in zip(names, _sigmas(run, e, len(members)), strict=True)]
    yield "members", f"{', '.join(texts)}: the sigma of each as seen from the base, along its worst axis"
    yield "now", f"chi2 {e.chi2:.4g} with {e.dof} degrees of freedom; a place is never judged as a whole"
    strikes = [f"{run.landmark_of(v)} ({count})" for v, count in place.strikes.items()]
    if strikes:
        yield "against", f"the newest visits contradict the place in {', '.join(strikes)}"


def _sigmas(run: SavedGraph, e: Entry, members: int) -> list[str]:
    """Return the sigma of each landmark of a place, of those that are poses also of the rotation."""
    sigmas, n, space = np.sqrt(np.diagonal(np.linalg.inv(e.information_matrix))), run.space.dimensions, run.space
    out = [f"{sigma:.3f} m" for sigma in sigmas[: n * members].reshape(-1, n).max(axis=1).tolist()]
    rotations = np.rad2deg(sigmas[n * members :].reshape(-1, space.dof - n).max(axis=1)).tolist()
    first = members - len(rotations)
    return [*out[:first], *(f"{of}, {turn:.2f} deg" for of, turn in zip(out[first:], rotations, strict=True))]
