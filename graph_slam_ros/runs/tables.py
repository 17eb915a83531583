"""The tables of a run, and what happened in it in numbers."""

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np

from graph_slam_ros import __version__
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o_writer import graph_lines
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.messages import results
from graph_slam_ros.messages.inputs import recorded_uses
from graph_slam_ros.runs.condensed_map import WholePath, rows_text
from graph_slam_ros.runs.folder import COVARIANCES, GRAPH, LANDMARKS, ODOMETRY, PATH, PATH_ODOMETRY, SIGHTINGS, VERTICES
from graph_slam_ros.runs.journal import CHANGES, LEDGER
from graph_slam_ros.runs.ledger_file import Entry, ledger_entries
from graph_slam_ros.slam import Counters, GraphSlam, MapView
from graph_slam_ros.slam.calibration.parameters import QUANTITIES
from graph_slam_ros.slam.levels import SIGMAS
from graph_slam_ros.slam.lifelong.state import BoundedState, seen_from
from graph_slam_ros.slam.robust.gating import CANDIDATES
from graph_slam_ros.slam.robust.ledger import OUTSIDE, VerdictChange
from graph_slam_ros.typing import Index

Name = TypeVar("Name")
_LATELY = 400  # edges
_FEWEST_OUT, _MANY_OUT = 5, 0.25  # sightings of a landmark that are out: so many, and such a part
_TANGENT = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "rx", "ry", "rz")}
_POSE = {3: "x,y,theta", 6: "x,y,z,qx,qy,qz,qw"}


def result_texts(view: MapView, whole: WholePath) -> dict[str, str]:
    """All results except the summary, by file name."""
    ids, vertices = numbered(view)
    sightings, path = whole.left.sightings, whole.poses()
    newest = view.sighting_trajectory().reshape(-1, path.shape[1])
    seen = np.concatenate((seen_from(view.space, sightings, path), newest))
    seen_odometry = np.concatenate((sightings["T_odom"], view.sighting_odometry().reshape(-1, path.shape[1])))
    stamps = [*sightings["stamp_ns"].tolist(), *view.sighting_poses.stamps_ns.tolist()]
    stamps_ns = whole.stamps_ns.tolist()
    return {
        GRAPH: "\n".join([*graph_lines(graph_file(view, ids), view.solver.estimate), ""]),
        VERTICES: vertices,
        LEDGER: rows_text(ledger_entries(view, ids), Entry),
        CHANGES: rows_text(view.ledger.history, VerdictChange),
        PATH: tum_text(stamps_ns, path),
        PATH_ODOMETRY: tum_text(stamps_ns, whole.odometry),
        COVARIANCES: _covariance_table(view, whole.left.keyframes["stamp_ns"].tolist()),
        SIGHTINGS: tum_text(stamps, seen),
        ODOMETRY: tum_text(stamps, seen_odometry),
        LANDMARKS: _landmark_table(view),
    }


def _fitted(view: MapView) -> dict[str, Any]:
    """The estimated noise, whether it is applied, and the reason if there is none; and what nothing corrects."""
    out: dict[str, Any] = {"noise_scale": view.config.robust.noise_scale, "noise": []}
    if not view.is_solved:
        return out | {"noise_unknown": "nothing is solved"}
    if off := view.uncorrected():
        out["uncorrected"] = [one.as_dict() for one in off]
    if renewed := view.renewed_ids():
        out["renewed_ids"] = str(renewed)
    if contradicted := view.trials.contradicted():
        out["contradicted"] = contradicted
    try:
        return out | {"noise": [one.as_dict() for one in view.backend.noise_scale()]}
    except GraphSlamError as error:  # what cannot be said of a singular map must not cost its results
        return out | {"noise_unknown": str(error)}


def summarize(slam: GraphSlam, earlier: Counters | None = None) -> dict[str, Any]:
    """Return the numbers of a run; ``earlier`` was counted in the same run before this pipeline continued it."""
    counters, view = Counters(), slam.view
    for some in (earlier or Counters(), slam.counters):
        counters.update(some)
    last = view.report or (view.solver.evaluate() if view.is_solved else None)
    optional = {
        "survey_unseen": sorted(view.config.survey.keys() - view.landmarks.keys()),
        "gyro": view.gyro and asdict(view.gyro),
        "calibrated": view.corrections.lines(),
        "association": _association(view),
        "contested": _contested(view),
    }
    return (
        {
            "version": __version__,
            "keyframes": len(view.keyframes),
            "landmarks": len(view.landmarks),
            "waiting": view.waiting,
            "segments": len(view.segments),
            "drives": _drives(view),
            "sightings": sum(landmark.sightings for landmark in view.landmarks.values()),
            "edges": view.graph.edge_count,
            "solves": view.solves,
            "chi2": last.chi2_final if last else 0.0,
            "dof": view.solver.degrees_of_freedom,
            "cost": last.cost_final if last else 0.0,
            "ended": True,
            "converged": last.converged if last else True,
            "stop": last.stop if last else "nothing_to_do",
            "failing": view.failing,
            "classes": {name: asdict(share) for name, share in (last.classes if last else {}).items()},
            "rivals": [asdict(rival) for rival in view.backend.rivals],
            "displacements": view.displacements,
            "span_s": (view.keyframes[-1].stamp_ns - view.began_ns) * 1e-9 if view.keyframes else 0.0,
        }
        | condensed_part(view)
        | {name: value for name, value in optional.items() if value}
        | account(slam, counters)
        | _fitted(view)
    )


def condensed_part(view: MapView) -> dict[str, Any]:
    """Return how many keyframes have left the map, or why none does where some should."""
    settings = view.config.map
    if view.keyframes.first:
        return {"condensed": view.keyframes.first}
    is_long = settings.condense and len(view.keyframes) > settings.window_keyframes
    is_doubtful = view.association_report.get("is_doubtful", False)
    why = view.config.not_condensed or ("a doubtful map of landmarks without ids" if is_doubtful else "")
    return {"not_condensed": why} if is_long and why else {}


def _contested(view: MapView) -> dict[str, tuple[int, int]]:
    """Landmarks with ids of which many sightings are not believed, by name: how many, and how many there are."""
    graph, edges = view.graph, view.graph.edges_of("landmarks").tolist()
    seen = Counter((graph.edge(edge).vertices[-1], view.ledger.verdict_of(edge) in OUTSIDE) for edge in edges)
    named = {name: one.vertex for name, one in view.landmarks.items() if not one.is_unnamed}
    counts = {name: (seen[vertex, True], seen[vertex, False] + seen[vertex, True]) for name, vertex in named.items()}
    return {name: of for name, of in counts.items() if of[0] >= max(_FEWEST_OUT, _MANY_OUT * of[1])}


def _association(view: MapView) -> dict[str, Any]:
    """The report on sightings without identity, with the setting of each clock that was found."""
    report, clock = view.association_report, QUANTITIES["clock"]
    for topic, one in report.get("clocks", {}).items():
        is_found = abs(one["value"]) > max(SIGMAS * one["sigma"], clock.least) and one["sigma"] < clock.determined_below
        value = view.corrections.total(topic, "clock") + one["value"]
        one["setting"] = f"{topic}.offset_s={value:.4g}" if is_found else ""
    return report


INPUT_COLUMNS = {
    "received": "messages received",
    "used": "measurements used",
    "believed": "measurements believed",
    "refused": "refused",
}
"""The columns of an input and their titles, wherever its numbers are shown: one message may hold many measurements."""


def account(slam: GraphSlam, counters: Counters) -> dict[str, Any]:
    """Return all counters, and the outcome of each input.

    ``received`` counts messages, ``used`` the measurements from them, ``believed`` the edges of those (odometry
    excepted) that the estimate uses.

    Parameters
    ----------
    counters : those of the pipeline, of what stands before it, and of an earlier part of the run
    """
    view = slam.view
    used_as = dict.fromkeys(view.odometry_sources, "odometry") | recorded_uses(view.config)  # sources may be no inputs
    is_of_map = not slam.counters.used  # nothing was measured since: a run that is written from its map
    newest_drive = 0 if is_of_map or not view.drives else view.drives[-1]
    edges = view.graph.edge_ids.since()
    accepted, _ = _by_input(view, np.delete(edges, np.flatnonzero(view.ledger.keyframe.values < newest_drive)))
    for drive, condensed in (view.bounded.accepted if view.bounded else {}).items():
        if drive >= newest_drive:
            accepted.update(condensed)
    inputs = {}
    for name in dict.fromkeys([*view.config.inputs.names.split(), *counters.used, *accepted]):
        if name in counters.received or counters.used[name] or name in accepted:
            used = max(counters.used[name], accepted.get(name, 0) if is_of_map else 0)
            of_input = {"received": counters.received.get(name), "used": used, "believed": accepted.get(name)}
            inputs[name] = {"use": used_as.get(name, "")} | of_input
    return {"counters": counters.as_dict(), "inputs": inputs}


def counted(counters: Counters) -> dict[str, Any]:
    """The same of a pipeline that is still working, without looking into its graph."""
    inputs = {
        name: {"use": "", "received": counters.received.get(name), "used": counters.used[name], "believed": None}
        for name in dict.fromkeys([*counters.received, *counters.used])
    }
    return {"counters": counters.as_dict(), "inputs": inputs}


def counters_of(summary: Mapping[str, Any]) -> Counters:
    """Return the counters from which ``account`` or ``counted`` was made. Raises ValueError if a summary has others."""
    out = Counters()
    try:
        for source, counts in summary.get("counters", {}).items():
            for reason, times in counts.items():
                out.count(str(source), str(reason), int(times))
        for name, of in summary.get("inputs", {}).items():
            out.used[name] += int(of["used"])
            if of["received"] is not None:
                out.received[name] += int(of["received"])
    except (AttributeError, LookupError, TypeError) as error:
        raise ValueError(str(error)) from None
    return out


def accepted_lately(view: MapView) -> dict[str, tuple[int, int]]:
    """Return by input how many of its edges among the newest of the graph are believed, and how many there are."""
    accepted, judged = _by_input(view, view.graph.edge_ids.since()[-_LATELY:])
    return {name: (accepted[name], times) for name, times in judged.items()}


def _by_input(view: MapView, edges: Index) -> tuple[Counter[str], Counter[str]]:
    """Count those edges that are of landmarks, fixes and closures, by input: the accepted ones, and all."""
    graph, out = view.graph, view.ledger.ids.since()[np.isin(view.ledger.verdict.values, OUTSIDE)]
    judged = edges[graph.has_label(edges, CANDIDATES)]
    accepted, every = (Counter(map(graph.source_of, some.tolist())) for some in (np.setdiff1d(judged, out), judged))
    return accepted, every


def _drives(view: MapView) -> list[dict[str, int]]:
    """Return the first row of each drive in ``path.tum`` and in ``sightings.tum``, from 0."""
    of, state = view.sighting_poses.ids, view.bounded or BoundedState()
    rows = {first: state.sightings + int(np.sum(of < first)) for first in view.drives if first >= view.keyframes.first}
    return [{"keyframe": first, "sighting": rows.get(first, state.begins.get(first, 0))} for first in view.drives]


def numbered(view: MapView) -> tuple[list[int], str]:
    """The number of each vertex, at its id, and the table of all vertices.

    Poses are numbered from 0 in order of time, landmarks after them, because other tools read odometry from that order.
    A vertex that is not part of the map any more is ``unused``: a deleted landmark.
    """
    names: list[tuple[int, int, str, int | str, str]] = []
    old = view.bounded.old.items() if view.bounded else ()
    for k, keyframe in (*old, *enumerate(view.keyframes, start=view.keyframes.first)):
        names.append((k, keyframe.vertex, "keyframe", keyframe.stamp_ns, str(k)))
    for k, (name, landmark) in enumerate(view.landmarks.items(), start=len(view.keyframes)):
        names.append((k, landmark.vertex, "landmark", "", name))
    rest = np.setdiff1d(view.graph.vertex_ids.since(), [vertex for _, vertex, *_ in names]).tolist()
    names += [(k, vertex, "unused", "", "") for k, vertex in enumerate(rest, len(view.keyframes) + len(view.landmarks))]
    ids = [0] * view.graph.vertex_ids.next
    rows = ["id,vertex,stamp_ns,name"]
    for file_id, vertex, what, stamp, name in names:
        ids[vertex] = file_id
        rows.append(f"{file_id},{what},{stamp},{_csv(name)}")
    return ids, "\n".join(rows) + "\n"


def graph_file(view: MapView, ids: list[int]) -> G2oFile:
    """The graph, with the vertices of a frozen map fixed, and without those that are not part of the map any more."""
    count = len(view.keyframes) + len(view.landmarks)
    absent = frozenset(vertex for vertex, number in enumerate(ids) if number >= count)
    return G2oFile(view.graph, ids, view.solver.held.tolist(), absent=absent)


def _covariance_table(view: MapView, before_ns: Sequence[int]) -> str:
    """The covariances of all keyframes; of those that have left the map, with these stamps, nothing is known."""
    dof = view.config.space.dof
    unknown = ",".join(["nan"] * (dof * (dof + 1) // 2))
    rows = [f"stamp_ns,{','.join(f'tangent_{a}{b}' for a, b in _upper(_TANGENT[dof]))}"]
    rows += [f"{stamp_ns},{unknown}" for stamp_ns in before_ns]
    for stamp_ns, covariance in zip(view.keyframes.stamps_ns, view.keyframe_covariances(), strict=True):
        rows.append(f"{stamp_ns},{','.join(map(repr, covariance[np.triu_indices(dof)].tolist()))}")
    return "\n".join(rows) + "\n"


def _landmark_table(view: MapView) -> str:
    space = view.config.space
    rows = [f"id,kind,{_POSE[space.dof]},sightings,{','.join(f'cov_{a}{b}' for a, b in _upper(_TANGENT[space.dof]))}"]
    has_features = any(mark.sort or mark.sized for mark in view.landmarks.values())
    rows[0] += ",class,size" * has_features
    for name, value, covariance in results.landmark_estimates(view):
        kind = "pose" if len(value) == space.pose.size else "point"
        at = [*map(repr, value), *[""] * (space.pose.size - len(value))]
        spread = [f"{covariance[i, j]:.9e}" if j < len(covariance) else "" for i, j in _upper(range(space.dof))]
        mark = view.landmarks[name]
        features = [_csv(mark.sort), repr(mark.size) if mark.sized else ""] if has_features else []
        rows.append(",".join([_csv(name), kind, *at, str(mark.sightings), *spread, *features]))
    return "\n".join(rows) + "\n"


def _upper(names: Sequence[Name]) -> Iterator[tuple[Name, Name]]:
    """Pairs of the upper triangle of a matrix, row by row."""
    return itertools.combinations_with_replacement(names, 2)


def _csv(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\n\r') else text
