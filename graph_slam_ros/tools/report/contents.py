"""The contents of a report, read from a run folder. A part is left out only if its files are missing."""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message
from scipy.special import gammainc

from graph_slam_ros.analysis import measurement_text
from graph_slam_ros.analysis.consistency import nees_of_each
from graph_slam_ros.analysis.evaluation import Scores, dimensions_of, evaluate, input_topics, scored_drive
from graph_slam_ros.analysis.explain import REASONS, STATES, change_text, landmark_lines, statements_of_place
from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.trajectories import Truth, read_truth
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.colours import DARK, LIGHT
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import CdrReader
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.lie import se3
from graph_slam_ros.messages import results
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.mcap_records import records
from graph_slam_ros.runs.folder import COVARIANCES, changed_since, check_run, recording_of, run_config, summary_of
from graph_slam_ros.runs.journal import parts_of
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.runs.tables import INPUT_COLUMNS
from graph_slam_ros.runs.trajectory import read_covariances, read_rows
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.tools.report import verdict
from graph_slam_ros.tools.report.packing import Packing, shown
from graph_slam_ros.tools.report.places import floor_plan, keyframe_paths, outside, paths
from graph_slam_ros.tools.report.sentences import closure_groups, effects, sentences
from graph_slam_ros.typing import Array

_BINS, _SHOWN = 60, 15
_CLOCK_NS = 10**18  # stamps before are no dates
_MM, _NOTHING = 1e-3, 1e-9
MOST_FRAMES, MOST_POINTS, MOST_LANDMARKS, MOST_JUMPS = 80, 500, 300, 15


@dataclass
class Contents:
    """The contents, as JSON with packed columns.

    Attributes
    ----------
    losses : parts that could not be read; beware : what may mislead
    saved : the graph of the run; None if it cannot be read
    """

    run: Path
    packing: Packing = field(default_factory=Packing)
    data: dict[str, Any] = field(default_factory=dict)
    losses: list[str] = field(default_factory=list)
    beware: list[str] = field(default_factory=list)
    saved: SavedGraph | None = None

    def attempt(self, part: Callable[[], Any]) -> Any:
        """Make one part; None, and a loss, where its files are damaged."""
        try:
            return part()
        except (GraphSlamError, LookupError, TypeError, ValueError, AttributeError, OSError) as error:
            self.losses.append(str(error) or type(error).__name__)
            return None


def read_contents(
    run: Path,
    truth: str | None = None,
    other: Path | None = None,
    plan: Path | None = None,
    topic: str = "",
    *,
    align: bool = True,
) -> Contents:
    """Read a run.

    Raises GraphSlamError: the folder is not a run; or the truth, the other run or the floor plan, which were asked for,
    cannot be read.

    Parameters
    ----------
    truth, topic : as ``evaluate`` takes them
    other : another run, whose path is drawn and whose map is compared
    plan : a ``map.yaml`` of Nav2
    """
    check_run(run)
    out = Contents(run)
    summary = out.attempt(lambda: summary_of(run)) or {}
    known = read_truth(truth, topic, out.attempt(lambda: input_topics(run)) or set()) if truth else None
    saved = out.saved = out.attempt(lambda: SavedGraph(run, out.losses))
    out.beware += out.attempt(lambda: changed_since(run)) or []
    scores = evaluate(run, known, align=align) if known and saved else None
    out.data["run"] = shown(run.resolve().name)
    out.data["title"] = _title(run, saved)
    out.data["colours"] = {"light": LIGHT, "dark": DARK}
    out.data["dimensions"] = saved.space.dimensions if saved else out.attempt(lambda: dimensions_of(run)) or 2
    out.data["map"] = out.attempt(lambda: paths(out.packing, run, saved, known, other, align=align)) if saved else None
    out.data["plan"] = floor_plan(plan) if plan else None
    if saved:
        out.beware += outside(plan, out.data["plan"], saved) if plan else []
        out.data["edges"] = _edges(out, saved)
        out.data["charts"] = _charts(out, saved)
        out.data["drive"] = out.attempt(lambda: _drive(out, saved))
        out.data["groups"] = out.attempt(lambda: closure_groups(saved)) or []
    _tables(out, summary, saved, scores, known)
    out.data["compared"] = _compared(run, other, out) if other else None
    out.losses = _once(out.losses)
    out.beware = [one for one in _once(out.beware) if not any(loss.endswith(one) for loss in out.losses)]
    of_drive = out.data.get("drive") or {"jumps": ()}
    large = [one for one in of_drive["jumps"] if saved.config.tf.report_jump_m < one[1]]
    out.data["sentences"] = out.attempt(lambda: verdict.verdict(run, summary, saved, scores, out.losses, *large[:1]))
    out.data["losses"], out.data["beware"] = [[shown(one) for one in some] for some in (out.losses, out.beware)]
    return out


def _title(run: Path, saved: SavedGraph | None) -> str:
    name, start_ns = shown(recording_of(run) or run.resolve().name), int(saved.whole_path.stamps_ns[0]) if saved else 0
    if start_ns < _CLOCK_NS:
        return name
    return f"{name}, {datetime.fromtimestamp(start_ns // 10**9, timezone.utc):%d %B %Y, %H:%M} UTC"


def _once(lines: Sequence[str]) -> list[str]:
    """Lines without those that stand in others: the same said of a file by its whole name."""
    several = list(dict.fromkeys(lines))
    return [one for one in several if not any(other != one and other.endswith(one) for other in several)]


def _edges(out: Contents, saved: SavedGraph) -> dict[str, Any]:
    pack, entries, found = out.packing, saved.entries, effects(saved)
    groups, group = sentences(saved, found)
    changes: dict[str, list[str]] = {}
    for change in saved.changes:
        changes.setdefault(str(change.edge), []).append(change_text(change))
    ends = [[_end(saved, e, vertex) for vertex in e.vertices] for e in entries]
    names = list(dict.fromkeys(name for several in ends for name in several if isinstance(name, str) and name))
    places = {name: len(saved.view.keyframes) + k for k, name in enumerate(names)}
    is_condensed = saved.view.bounded is not None

    def coded(values: list[str]) -> dict[str, Any]:
        several = list(dict.fromkeys(values))
        code = {value: k for k, value in enumerate(several)}
        return {"names": several, "of": pack.column([code[value] for value in values], "i4")}

    def end(slot: int) -> list[int]:
        some = (several[slot] if slot < len(several) else "" for several in ends)
        return [places.get(one, -1) if isinstance(one, str) else one for one in some]

    def numbers(name: str) -> Any:
        return np.array([getattr(e, name) for e in entries], dtype=float)

    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.sqrt(numbers("statistic") / numbers("threshold"))
    columns = {name: pack.column(_finite(numbers(name))) for name in ("statistic", "threshold", "chi2")}
    columns |= {"sigma_factor": pack.column(_finite(factor)), "percent": pack.column(100.0 * numbers("weight"))}
    columns |= {name: pack.column(_finite(getattr(found, name))) for name in ("last_m", "end_m", "cost")}
    columns["stamp_s"] = pack.column(numbers("stamp_s"), "f8")
    columns |= {name: pack.column(numbers(name), "i4") for name in ("keyframe", "dof")}
    for name, values in measurement_text.columns(entries).items():
        columns[name] = pack.fixed(values, _step(values))
    slots = max((len(e.vertices) for e in entries), default=0)
    for slot in range(slots):
        vertices = [e.vertices[slot] if slot < len(e.vertices) else None for e in entries]
        columns[f"end{slot}"] = pack.column([-1 if v is None else saved.name(v) for v in vertices], "i4")
    return {
        "count": len(entries),
        "ids": pack.column([e.edge for e in entries], "i4") if is_condensed else None,
        "columns": columns,
        "group": pack.column(group, "i4"),
        "groups": groups,
        "changes": changes,
        "by_hand": _by_hand(saved),
        "condensed": {str(e.edge): [*statements_of_place(saved, e)] for e in entries if e.label == PLACES},
        "places": [pack.column(end(slot), "i4") for slot in range(max(slots, 2))],
        "label": coded([e.label for e in entries]),
        "source": coded([shown(e.source) for e in entries]),
        "landmark": coded([shown(e.landmark) for e in entries]),
        "verdict": pack.column([int(e.verdict) for e in entries], "u1"),
        "reason": pack.column([int(e.reason) for e in entries], "u1"),
        "verdicts": [STATES[one] for one in Verdict],
        "reasons": [REASONS[one] for one in Reason],
        "landmark_lines": pack.texts(_landmark_texts(saved, names)),
        "landmark_names": pack.texts([shown(name) for name in names]),
    }


def _end(saved: SavedGraph, e: Entry, vertex: int) -> int | str:
    """The number of the keyframe at an end of an edge, or the name of the landmark; empty where it is neither."""
    number = saved.keyframe(vertex)
    if number is not None:
        return number
    name = saved.landmark_of(vertex)
    return name or ("" if saved.landmarks_of(e) else e.landmark)  # of one that was removed the ledger knows the name


def _by_hand(saved: SavedGraph) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for one in saved.edits:
        for edge in (*one.edges, *one.added):
            found.setdefault(str(edge), []).append(shown(one.text))
    return found


def _step(values: Any) -> float:
    """The step of a column of measured numbers: what is shown of it is no finer."""
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    return _MM if largest < 1e6 else largest * 1e-9


def _finite(values: Any) -> Any:
    return np.where(np.isfinite(values), values, np.nan)


def _landmark_texts(saved: SavedGraph, names: list[str]) -> list[str]:
    seen: dict[str, list[Any]] = {name: [] for name in names}
    for e in saved.entries:
        for name in {_end(saved, e, vertex) for vertex in e.vertices} & seen.keys():
            seen[str(name)].append(e)
    return ["\n".join(map(shown, landmark_lines(saved.folder, name, several))) for name, several in seen.items()]


def _charts(out: Contents, saved: SavedGraph) -> dict[str, Any]:
    """Histograms: verdicts over the drive, and chi2 of each class against what it should be."""
    judged = [e for e in saved.entries if e.verdict]
    count = max(1, len(saved.view.keyframes))
    edges = np.linspace(0, count, min(_BINS, count) + 1)
    over = {}
    for one in Verdict:
        if one:
            at = [e.keyframe for e in judged if e.verdict is one]
            over[STATES[one]] = np.histogram(at, edges)[0].tolist()
    later = [c.keyframe for c in saved.changes]
    worst = sorted(judged, key=lambda e: -e.chi2 / e.dof)[:_SHOWN]
    return {
        "bins": edges.tolist(),
        "verdicts": over,
        "changes": np.histogram(later, edges)[0].tolist(),
        "chi2": list(_chi2_histograms(saved)),
        "worst": [e.edge for e in worst],
    }


def _nees(out: Contents, known: Truth) -> dict[str, Any]:
    """NEES of each keyframe that has a truth, and the band of single ones."""
    run, drive_of = out.run, scored_drive(out.run, known.trajectory)
    path, covariances = (
        read_rows(run / "path.tum").at(drive_of.keyframes),
        read_covariances(run / COVARIANCES)[drive_of.keyframes],
    )
    truth = known.trajectory if covariances.shape[1] == 6 else known.trajectory.in_plane()
    values, band = nees_of_each(path.poses, interpolated(truth, path.stamps_s), covariances)
    at = np.flatnonzero(np.isfinite(values))
    return {"values": [out.packing.column(at + 1, "i4"), out.packing.column(values[at])], "band": band}


def _chi2_histograms(saved: SavedGraph) -> Iterator[dict[str, Any]]:
    """Chi2 of the accepted edges of each class, and how many the chi2 distribution has in each bin."""
    inside = [e for e in saved.entries if e.is_in]
    for label, dof in dict.fromkeys((e.label, e.dof) for e in inside):
        values = np.array([e.chi2 for e in inside if (e.label, e.dof) == (label, dof)])
        if len(values) < 2 or not values.max() > _NOTHING:
            continue
        bins = np.linspace(0.0, 4.0 * dof + 8.0, 41)
        found = np.histogram(np.minimum(values, bins[-1] - _NOTHING), bins)[0]
        should = len(values) * np.diff(gammainc(0.5 * dof, 0.5 * bins))
        should[-1] = len(values) - should[:-1].sum()
        name = f"chi2 of {label}, {dof} degree{'s' * (dof > 1)} of freedom; the last bin has all above"
        yield {"name": name, "bins": bins.tolist(), "found": found.tolist(), "should": should.tolist()}


def _drive(out: Contents, saved: SavedGraph) -> dict[str, Any]:
    odometry = keyframe_paths(saved)[1]
    found = corrections(out.run, odometry.stamps_s, odometry.poses, out.losses)
    changed: dict[int, list[int]] = {}
    for change in saved.changes:
        changed.setdefault(change.keyframe, []).append(change.edge)
    several = jumps(found, saved.entries, changed)
    return {
        "frames": [
            {
                "keyframes": count,
                "points": [out.packing.fixed(column, _MM, is_path=True) for column in points.T],
                "landmarks": [out.packing.fixed(column, _MM) for column in landmarks.T],
            }
            for count, points, landmarks in frames(out.run, saved, out.losses)
        ],
        "corrections": [out.packing.column(found[0], "i4"), out.packing.fixed(found[1], 1e-4)],
        "jumps": several,
    }


def _tables(out: Contents, summary: dict[str, Any], saved: Any, scores: Scores | None, known: Truth | None) -> None:
    edits = [one.edit for one in saved.edits] if saved else []
    made: dict[str, Callable[[], list[verdict.Row]]] = {
        "inputs": lambda: verdict.inputs(summary),
        "configuration": lambda: verdict.configuration(run_config(out.run)),
        "versions": lambda: verdict.versions(out.run, summary),
        "timing": lambda: verdict.timing(summary),
        "noise": lambda: verdict.noise(summary, scores),
        "edits": lambda: [[shown(str(e)) for e in (one.name, one.text, one.who, one.when, one.why)] for one in edits],
        "classes": lambda: list(verdict.classes(summary)),
    }
    out.data["tables"] = {name: out.attempt(table) or [] for name, table in made.items()}
    out.data["tables"]["input_columns"] = list(INPUT_COLUMNS.values())
    out.data["load"] = out.attempt(lambda: verdict.load(summary))
    out.data["waiting"] = [[shown(str(n)), shown(str(why))] for n, why in dict(summary.get("waiting") or {}).items()]
    out.data["chi2_per_dof"] = out.attempt(lambda: verdict.chi2_per_dof(saved)) if saved else None
    out.data["scores"] = str(scores).splitlines() if scores else None
    if scores and known and scores.consistency and scores.consistency.poses:
        out.data["nees"] = out.attempt(lambda: _nees(out, known))
    if scores:
        out.beware += scores.warnings
        out.losses += scores.losses


def _compared(run: Path, other: Path, out: Contents) -> dict[str, Any]:
    from graph_slam_ros.maps.diff import diff

    found = diff(run, other, out.losses)
    marks = found.landmarks
    if not marks.both and (min(marks.a, marks.b) or not found.keyframes.both):
        nothing = "no landmark is in both maps: are they of one place? Their frames need not be the same"
        out.beware.append(f"--compare {other}: {nothing}")
    lines = [shown(line) for line in found.lines()]
    return {"with": shown(other.resolve().name), "lines": lines}


# -- the history of the drive: the estimate at some moments, and the jumps of map -> odom ------------------------------


def frames(run: Path, saved: SavedGraph, losses: list[str]) -> Iterator[tuple[int, Array, Array]]:
    """The paths and landmarks that the run has recorded, some of them where there are many; each with a part."""
    several = list(zip(*(_recorded(run, topic, losses) for topic in ("/path", "/landmarks")), strict=False))
    some = np.unique(np.linspace(0, len(several) - 1, min(len(several), MOST_FRAMES)).astype(int))
    count = {stamp_ns: k for k, stamp_ns in enumerate(saved.whole_path.stamps_ns.tolist(), start=1)}
    decode: Any = typestore().deserialize_cdr
    for path, landmarks in (several[k] for k in some.tolist()):
        newest_ns, poses = CdrReader(path).stamp_ns(), decode(path, results.PATH).poses
        at = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST_POINTS)).astype(int)).tolist()
        markers = [one.pose.position for one in decode(landmarks, results.LANDMARKS).markers if one.ns == "landmarks"]
        if newest_ns in count:
            points = [poses[k].pose.position for k in at]
            yield count[newest_ns], _positions(points), _positions(markers[:MOST_LANDMARKS])


def _positions(points: Sequence[Any]) -> Array:
    return np.array([(one.x, one.y, one.z) for one in points], dtype=float).reshape(-1, 3)


def corrections(run: Path, stamps_s: Array, odometry: Array, losses: list[str]) -> tuple[Array, Array, Array]:
    """Changes of ``map -> odom`` from keyframe to keyframe, as it was published.

    Returns keyframes (m,), distances (m,) [m] by which the robot was moved at each, angles (m,) [rad].

    Parameters
    ----------
    stamps_s, odometry : (n,), (n, 7) of the keyframes, ``T_odom_base``
    """
    published = list(_published(run, losses))
    if len(published) < 2:
        return np.zeros(0, dtype=int), np.zeros(0), np.zeros(0)
    stamps, poses = np.array([at for at, _ in published]) * 1e-9, np.array([pose for _, pose in published])
    at = np.clip(np.searchsorted(stamps_s, stamps - 1e-4), 0, len(stamps_s) - 1)
    fits = np.abs(stamps_s[at] - stamps) < 1e-3
    at, poses = at[fits], poses[fits]
    odom = tuple(odometry[at].T)
    T_map_odom = se3.compose(tuple(poses.T), se3.inverse(odom))
    before = tuple(number[:-1] for number in T_map_odom)
    foretold = se3.compose(before, tuple(number[1:] for number in odom))
    moved = np.stack(se3.between(foretold, tuple(poses[1:].T)), axis=1)
    angles = 2.0 * np.arctan2(np.linalg.norm(moved[:, 3:6], axis=1), np.abs(moved[:, 6]))
    keyframes: Any = at[1:]
    return keyframes, np.linalg.norm(moved[:, :3], axis=1), angles


def jumps(
    found: tuple[Array, Array, Array], entries: Sequence[Entry], changed: dict[int, list[int]]
) -> list[tuple[int, float, float, list[int]]]:
    """The largest corrections: keyframe, distance [m], angle [degrees], and the edges judged then that pulled most."""
    keyframes, distances, angles = found
    came: dict[int, list[Entry]] = {}
    for e in entries:
        if e.verdict and e.is_in:
            came.setdefault(e.keyframe, []).append(e)
    out = []
    for k in np.argsort(-distances, kind="stable")[:MOST_JUMPS].tolist():
        if distances[k] <= 1e-3:
            break
        at = int(keyframes[k])
        pulled = sorted(came.get(at, ()), key=lambda e: -e.statistic)[:4]
        edges = list(dict.fromkeys([*changed.get(at, ())[:4], *(e.edge for e in pulled)]))
        out.append((at, float(distances[k]), float(angles[k]) * 180.0 / math.pi, edges))
    return out


def _published(run: Path, losses: list[str]) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Stamp and pose of each message of ``/pose``."""
    for data in _recorded(run, "/pose", losses):
        with suppress(struct.error):  # shorter than a pose: as if it had not come
            reader = CdrReader(data)
            stamp_ns, _ = reader.stamp_ns(), reader.text()
            yield stamp_ns, reader.numbers("d", 7)


def _recorded(run: Path, topic: str, losses: list[str]) -> Iterator[bytes]:
    """The messages of a topic."""
    for file in parts_of(run, "run"):
        of_topic = -1
        for record in records(file, losses, follow=False):
            if isinstance(record, Channel) and record.topic == topic:
                of_topic = record.id
            elif isinstance(record, Message) and record.channel_id == of_topic:
                yield record.data
