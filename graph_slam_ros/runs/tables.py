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
from graph_slam_ros.runs.condensed_map import WholePath
from graph_slam_ros.runs.folder import COVARIANCES, GRAPH, LANDMARKS, ODOMETRY, PATH, PATH_ODOMETRY, SIGHTINGS, VERTICES
from graph_slam_ros.runs.journal import CHANGES, LEDGER
from graph_slam_ros.runs.ledger_file import changes_text, ledger_text
from graph_slam_ros.slam import Counters, GraphSlam
from graph_slam_ros.slam.calibration.answers import SIGMAS
from graph_slam_ros.slam.calibration.parameters import QUANTITIES
from graph_slam_ros.slam.lifelong.state import BoundedState, seen_from
from graph_slam_ros.slam.robust.gating import CANDIDATES
from graph_slam_ros.slam.robust.ledger import OUTSIDE
from graph_slam_ros.typing import Index

Name = TypeVar("Name")
_LATELY = 400  # edges
_FEWEST_OUT, _MANY_OUT = 5, 0.25  # sightings of a landmark that are out: so many, and such a part
_TANGENT = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "rx", "ry", "rz")}
_POSE = {3: "x,y,theta", 6: "x,y,z,qx,qy,qz,qw"}


def result_texts(slam: GraphSlam, whole: WholePath) -> dict[str, str]:
    """All results except the summary, by file name."""
    ids, vertices = numbered(slam)
    sightings, path = whole.left.sightings, whole.poses()
    newest = slam.sighting_trajectory().reshape(-1, path.shape[1])
    seen = np.concatenate((seen_from(slam.space, sightings, path), newest))
    seen_odometry = np.concatenate((sightings["T_odom"], slam.sighting_odometry().reshape(-1, path.shape[1])))
    stamps = [*sightings["stamp_ns"].tolist(), *slam.sighting_poses.stamps_ns.tolist()]
    stamps_ns = whole.stamps_ns.tolist()
    return {
        GRAPH: "\n".join([*graph_lines(graph_file(slam, ids), slam.solver.estimate), ""]),
        VERTICES: vertices,
        LEDGER: ledger_text(slam, ids),
        CHANGES: changes_text(slam),
        PATH: tum_text(stamps_ns, path),
        PATH_ODOMETRY: tum_text(stamps_ns, whole.odometry),
        COVARIANCES: _covariance_table(slam, whole.left.keyframes["stamp_ns"].tolist()),
        SIGHTINGS: tum_text(stamps, seen),
        ODOMETRY: tum_text(stamps, seen_odometry),
        LANDMARKS: _landmark_table(slam),
    }


def fitted_summary(slam: GraphSlam) -> dict[str, Any]:
    """The estimated noise, whether it is applied, and the reason if there is none; and what nothing corrects."""
    out: dict[str, Any] = {"noise_scale": slam.config.robust.noise_scale, "noise": []}
    if not slam.is_solved:
        return out | {"noise_unknown": "nothing is solved"}
    if off := slam.uncorrected():
        out["uncorrected"] = [one.as_dict() for one in off]
    if renewed := slam.renewed_ids():
        out["renewed_ids"] = str(renewed)
    if contradicted := slam.contradicted:
        out["contradicted"] = contradicted
    try:
        return out | {"noise": [one.as_dict() for one in slam.noise_scale()]}
    except GraphSlamError as error:  # what cannot be said of a singular map must not cost its results
        return out | {"noise_unknown": str(error)}


def summarize(slam: GraphSlam, earlier: Counters | None = None) -> dict[str, Any]:
    """Return the numbers of a run; ``earlier`` was counted in the same run before this pipeline continued it."""
    counters = Counters()
    for some in (earlier or Counters(), slam.counters):
        counters.update(some)
    last = slam.report or (slam.solver.evaluate() if slam.is_solved else None)
    optional = {
        "survey_unseen": sorted(slam.config.survey.keys() - slam.landmarks.keys()),
        "gyro": slam.gyro and asdict(slam.gyro),
        "calibrated": slam.found_settings,
        "association": _association(slam),
        "contested": _contested(slam),
    }
    return (
        {
            "version": __version__,
            "keyframes": len(slam.keyframes),
            "landmarks": len(slam.landmarks),
            "waiting": slam.waiting,
            "segments": len(slam.segments),
            "drives": _drives(slam),
            "sightings": sum(landmark.sightings for landmark in slam.landmarks.values()),
            "edges": slam.graph.edge_count,
            "solves": slam.solves,
            "chi2": last.chi2_final if last else 0.0,
            "dof": slam.solver.degrees_of_freedom,
            "cost": last.cost_final if last else 0.0,
            "ended": True,
            "converged": last.converged if last else True,
            "stop": last.stop if last else "nothing_to_do",
            "failing": slam.failing,
            "classes": {name: asdict(share) for name, share in (last.classes if last else {}).items()},
            "rivals": [asdict(rival) for rival in slam.backend.rivals],
            "displacements": slam.displacements,
            "span_s": (slam.keyframes[-1].stamp_ns - slam.began_ns) * 1e-9 if slam.keyframes else 0.0,
        }
        | condensed_part(slam)
        | {name: value for name, value in optional.items() if value}
        | account(slam, counters)
    )


def condensed_part(slam: GraphSlam) -> dict[str, Any]:
    """Return how many keyframes have left the map, or why none does where some should."""
    settings = slam.config.map
    if slam.first_keyframe:
        return {"condensed": slam.first_keyframe}
    is_long = settings.condense and len(slam.keyframes) > settings.window_keyframes
    is_doubtful = slam.association_report.get("is_doubtful", False)
    why = slam.config.not_condensed or ("a doubtful map of landmarks without ids" if is_doubtful else "")
    return {"not_condensed": why} if is_long and why else {}


def _contested(slam: GraphSlam) -> dict[str, tuple[int, int]]:
    """Landmarks with ids of which many sightings are not believed, by name: how many, and how many there are."""
    graph, edges = slam.graph, slam.graph.edges_of("landmarks").tolist()
    seen = Counter((graph.edge(edge).vertices[-1], slam.ledger.verdict_of(edge) in OUTSIDE) for edge in edges)
    named = {name: one.vertex for name, one in slam.landmarks.items() if not one.is_unnamed}
    counts = {name: (seen[vertex, True], seen[vertex, False] + seen[vertex, True]) for name, vertex in named.items()}
    return {name: of for name, of in counts.items() if of[0] >= max(_FEWEST_OUT, _MANY_OUT * of[1])}


def _association(slam: GraphSlam) -> dict[str, Any]:
    """The report on sightings without identity, with the setting of each clock that was found."""
    report, clock = slam.association_report, QUANTITIES["clock"]
    for topic, one in report.get("clocks", {}).items():
        is_found = abs(one["value"]) > max(SIGMAS * one["sigma"], clock.least) and one["sigma"] < clock.determined_below
        value = slam.calibrated(topic, "clock") + one["value"]
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
    odometries = dict.fromkeys(slam.odometry_sources, "odometry")  # a source need not be an input
    used_as = odometries | recorded_uses(slam.config)
    is_of_map = not slam.counters.used  # nothing was measured since: a run that is written from its map
    newest_drive = 0 if is_of_map or not slam.drives else slam.drives[-1]
    accepted = _accepted_by_input(slam, newest_drive)
    for drive, condensed in (slam.bounded.accepted if slam.bounded else {}).items():
        if drive >= newest_drive:
            accepted.update(condensed)
    inputs = {}
    for name in dict.fromkeys([*slam.config.inputs.names.split(), *counters.used, *accepted]):
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


def accepted_lately(slam: GraphSlam) -> dict[str, tuple[int, int]]:
    """Return by input how many of its edges among the newest of the graph are believed, and how many there are."""
    accepted, judged = _by_input(slam, slam.graph.edge_ids.since()[-_LATELY:])
    return {name: (accepted[name], times) for name, times in judged.items()}


def _accepted_by_input(slam: GraphSlam, first: int) -> Counter[str]:
    """Accepted edges of landmarks, fixes and closures by input that were judged first at a keyframe or later."""
    edges, ledger = slam.graph.edge_ids.since(), slam.ledger
    return _by_input(slam, np.delete(edges, np.flatnonzero(ledger.keyframe.values < first)))[0]


def _by_input(slam: GraphSlam, edges: Index) -> tuple[Counter[str], Counter[str]]:
    """Count those edges that are of landmarks, fixes and closures, by input: the accepted ones, and all."""
    graph, out = slam.graph, slam.ledger.ids.since()[np.isin(slam.ledger.verdict.values, OUTSIDE)]
    judged = edges[graph.has_label(edges, CANDIDATES)]
    accepted, every = (Counter(map(graph.source_of, some.tolist())) for some in (np.setdiff1d(judged, out), judged))
    return accepted, every


def _drives(slam: GraphSlam) -> list[dict[str, int]]:
    """Return the first row of each drive in ``path.tum`` and in ``sightings.tum``, from 0."""
    of, state = slam.sighting_poses.ids, slam.bounded or BoundedState()
    rows = {first: state.sightings + int(np.sum(of < first)) for first in slam.drives if first >= slam.first_keyframe}
    return [{"keyframe": first, "sighting": rows.get(first, state.begins.get(first, 0))} for first in slam.drives]


def numbered(slam: GraphSlam) -> tuple[list[int], str]:
    """The number of each vertex, at its id, and the table of all vertices.

    Poses are numbered from 0 in order of time, landmarks after them, because other tools read odometry from that order.
    A vertex that is not part of the map any more is ``unused``: a deleted landmark.
    """
    names: list[tuple[int, int, str, int | str, str]] = []
    for one in slam.bounded.old if slam.bounded else ():
        names.append((one.number, one.vertex, "keyframe", one.stamp_ns, str(one.number)))
    for k, keyframe in enumerate(slam.keyframes, start=slam.first_keyframe):
        names.append((k, keyframe.vertex, "keyframe", keyframe.stamp_ns, str(k)))
    for k, (name, landmark) in enumerate(slam.landmarks.items(), start=len(slam.keyframes)):
        names.append((k, landmark.vertex, "landmark", "", name))
    rest = np.setdiff1d(slam.graph.vertex_ids.since(), [vertex for _, vertex, *_ in names]).tolist()
    names += [(k, vertex, "unused", "", "") for k, vertex in enumerate(rest, len(slam.keyframes) + len(slam.landmarks))]
    ids = [0] * slam.graph.vertex_ids.next
    rows = ["id,vertex,stamp_ns,name"]
    for file_id, vertex, what, stamp, name in names:
        ids[vertex] = file_id
        rows.append(f"{file_id},{what},{stamp},{_csv(name)}")
    return ids, "\n".join(rows) + "\n"


def graph_file(slam: GraphSlam, ids: list[int]) -> G2oFile:
    """The graph, with the vertices of a frozen map fixed, and without those that are not part of the map any more."""
    count = len(slam.keyframes) + len(slam.landmarks)
    absent = frozenset(vertex for vertex, number in enumerate(ids) if number >= count)
    return G2oFile(slam.graph, ids, slam.solver.held.tolist(), absent=absent)


def _covariance_table(slam: GraphSlam, before_ns: Sequence[int]) -> str:
    """The covariances of all keyframes; of those that have left the map, with these stamps, nothing is known."""
    dof = slam.config.space.dof
    unknown = ",".join(["nan"] * (dof * (dof + 1) // 2))
    rows = [f"stamp_ns,{','.join(f'tangent_{a}{b}' for a, b in _upper(_TANGENT[dof]))}"]
    rows += [f"{stamp_ns},{unknown}" for stamp_ns in before_ns]
    for stamp_ns, covariance in zip(slam.keyframes.stamps_ns, slam.keyframe_covariances(), strict=True):
        rows.append(f"{stamp_ns},{','.join(map(repr, covariance[np.triu_indices(dof)].tolist()))}")
    return "\n".join(rows) + "\n"


def _landmark_table(slam: GraphSlam) -> str:
    space = slam.config.space
    rows = [f"id,kind,{_POSE[space.dof]},sightings,{','.join(f'cov_{a}{b}' for a, b in _upper(_TANGENT[space.dof]))}"]
    has_features = any(mark.sort or mark.sized for mark in slam.landmarks.values())
    rows[0] += ",class,size" * has_features
    for name, value, covariance in results.landmark_estimates(slam):
        kind = "pose" if len(value) == space.pose.size else "point"
        at = [*map(repr, value), *[""] * (space.pose.size - len(value))]
        spread = [f"{covariance[i, j]:.9e}" if j < len(covariance) else "" for i, j in _upper(range(space.dof))]
        mark = slam.landmarks[name]
        features = [_csv(mark.sort), repr(mark.size) if mark.sized else ""] if has_features else []
        rows.append(",".join([_csv(name), kind, *at, str(mark.sightings), *spread, *features]))
    return "\n".join(rows) + "\n"


def _upper(names: Sequence[Name]) -> Iterator[tuple[Name, Name]]:
    """Pairs of the upper triangle of a matrix, row by row."""
    return itertools.combinations_with_replacement(names, 2)


def _csv(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\n\r') else text
