"""Explain what has left a map when visits were condensed, and the places that it is in."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.runs.condensed_map import read_left_edges
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.runs.restore import of_all
from graph_slam_ros.slam.condensed_edges import CONDENSED

Row = Mapping[str, str]
_BECAME = {
    CONDENSED: "condensed (believed; a place or a longer motion has what they measured)",
    "expired": "expired (not believed, and can no longer come back)",
}
_STATES = {"not_evaluated": "not judged", "down_weighted": "down-weighted", "pending": "held back"}


def edges_that_left(run: SavedGraph) -> Iterator[Row]:
    """Yield the edges that have left the map, by column: see ``CondensedEdge``.

    Those that left after the map was recorded last, in a run that was killed, are still in it, and are none of these.
    """
    if run.slam.bounded is not None:
        ids = run.graph.edge_ids
        yield from (row for row in read_left_edges(run.folder) if ids.find(int(row["edge"])) is None)


def became(rows: Sequence[Row]) -> str:
    """Count edges that have left a map by what they became."""
    counts = Counter(row["became"] for row in rows)
    return ", ".join(f"{counts[name]} {text}" for name, text in _BECAME.items() if counts[name])


def condensed_lines(run: SavedGraph) -> Iterator[str]:
    """Say how much of a map is condensed; nothing if none is."""
    if run.slam.bounded is None:
        return
    places = [one.place for several in run.slam.bounded.places.values() for one in several]
    visits, keyframes = sum(one.visits for one in places), run.slam.first_keyframe
    yield f"condensed: keyframes 0 to {keyframes - 1}, into {len(places)} places of {visits} visits"
    factor = run.slam.bounded.scale.factor
    if factor > 1.0:
        yield f"  visits to a place differ by {np.sqrt(factor):.1f} times their sigmas: the sigmas are scaled by that"
    if rows := list(edges_that_left(run)):
        yield f"  their edges: {became(rows)}"


def statements_of_one_that_left(run: SavedGraph, row: Row) -> Iterator[tuple[str, str]]:
    """Sentences on an edge that has left the map, each with its name."""
    of, by = row["landmark"] and f" of {row['landmark']}", row["source"] and f" by {row['source']}"
    verdict = _STATES.get(row["verdict"], row["verdict"])
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
    places = run.slam.bounded.places if run.slam.bounded else {}
    several = ((cell, one) for cell, all_of_it in places.items() for one in all_of_it)
    found = next(((cell, one) for cell, one in several if run.graph.edge_ids.of(one.edge) == e.edge), None)
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
