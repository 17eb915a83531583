"""Faults of real robots, by kind: wrong closures and identities, slipping wheels, moved landmarks.

A fault is put into a ``Draft``, which lists what is wrong in it. The same seed gives the same faults. Each fault has
its own stream of random numbers, so that one more fault changes none of the others.
"""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.random import Generator

from graph_slam_ros.edge_tags import tag_of
from graph_slam_ros.errors import GraphSlamError, did_you_mean
from graph_slam_ros.formats.g2o_writer import graph_lines, write_text
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Closure, Sighting
from graph_slam_ros.tools.simulation import false_closures as generator
from graph_slam_ros.tools.simulation.bag import ODOMETRY_TOPIC, recorded_names
from graph_slam_ros.tools.simulation.drive import Drive
from graph_slam_ros.tools.simulation.message_faults import MESSAGE_KINDS
from graph_slam_ros.tools.simulation.options import filled, option, options_of, random
from graph_slam_ros.tools.simulation.recording import (
    CLOSURES_TOPIC,
    LANDMARKS_TOPIC,
    Recording,
    moved_from,
    places,
    space_of,
)
from graph_slam_ros.typing import Array, Index, Numbers

Measured = Literal["odometry", "sighting", "closure"]
_OFTEN = 3  # times that a landmark must be seen, and seen again later, to be worth a fault
_STREAMS = 1  # the world itself is drawn from the seed alone, true closures from stream 0
_HALFWAY = "when, as a part of the whole: 0 the first pose, 1 the last"


@dataclass(slots=True)
class Draft:
    """Odometry, sightings and closures of n poses, in order of time.

    Attributes
    ----------
    truth : (n, 3) or (n, 7) true poses
    odometry : the same by dead reckoning
    twist : (n, d) velocity since the pose before
    sightings, seen_at : what was seen, and (m,) from which pose
    landmarks : true places by id
    stamps_ns : (n,)
    closures : true ones; false ones are added
    wrong : by what was measured and its number (of odometry the later pose's), the faults that hit it
    true_ids : of the landmarks that were really seen, whatever ids the sightings have now
    """

    space: Geometry
    truth: Array
    odometry: Array
    twist: Array
    sightings: list[Sighting]
    seen_at: Index
    landmarks: Mapping[str, Numbers]
    stamps_ns: Index
    closures: list[Closure]
    wrong: dict[tuple[Measured, int], list[str]] = field(default_factory=dict)
    true_ids: list[str] = field(init=False)

    def __post_init__(self) -> None:
        self.true_ids = [s.id for s in self.sightings]

    def __len__(self) -> int:
        return len(self.odometry)

    def pose_at(self, fraction: float) -> int:
        """The pose at a fraction of the drive: 0 is the first, 1 the last."""
        return round(fraction * (len(self) - 1))

    def mark(self, what: Measured, number: int, fault: str) -> None:
        """Note that a fault has hit a measurement."""
        faults = self.wrong.setdefault((what, number), [])
        if fault not in faults:
            faults.append(fault)

    def spoil(self, number: int, fault: str, sighting: Sighting) -> None:
        """Replace a sighting by a wrong one."""
        self.mark("sighting", number, fault)
        self.sightings[number] = sighting

    def spoil_odometry(self, first: int, poses: Sequence[Numbers], factors: Array | float, fault: str) -> None:
        """Replace odometry from a pose on by other poses; those behind move along. Twists there have factors."""
        last = first + len(poses) - 1
        self.odometry = moved_from(self.odometry, last, poses[-1])
        self.odometry[first : last + 1] = poses
        self.twist = self.twist.copy()
        self.twist[first + 1 : last + 1] *= factors
        for pose in range(first + 1, last + 1):
            self.mark("odometry", pose, fault)

    def seen_from(self, number: int, displaced: Array) -> Sighting:
        """A sighting as it would have been, with its noise, if the landmark had been elsewhere.

        Parameters
        ----------
        displaced : (2,) or (3,) by how much, in world
        """
        old, T_world_base = self.sightings[number], self.truth[self.seen_at[number]]
        n = self.space.dimensions
        if old.kind in ("position", "pose"):
            moved = np.array(old.measured)
            moved[:n] += self.space.turn(tuple(T_world_base)).T @ displaced
            return replace(old, measured=tuple(moved.tolist()))
        edge, at = self.space.sightings[old.kind], np.array([[0, len(T_world_base)]])
        whole = edge.whole(np.array([*old.measured, *(old.T_base_sensor or ())])[None])
        true = np.array(self.landmarks[self.true_ids[number]][:n])
        before, after = (
            edge.linearize(np.concatenate([T_world_base, place]), at, whole)[0][0] for place in (true, true + displaced)
        )
        moved = old.measured + after - before
        angles = slice("range" in old.kind, None)
        moved[angles] = se2.wrap(moved[angles])
        return replace(old, measured=tuple(moved.tolist()))


@dataclass(frozen=True, slots=True)
class WrongMessage:
    """A row of a recording's table: a wrong message, or one of its detections.

    Attributes
    ----------
    index : of the detection or point in its message; empty of odometry
    id : that it carries; of a closure, the earlier stamp
    true_id : the landmark that was seen
    """

    topic: str
    stamp_ns: int
    index: int | str
    id: str
    fault: str
    true_id: str


@dataclass(frozen=True, slots=True)
class WrongLine:
    """A row of a graph's table: a wrong edge.

    Attributes
    ----------
    line : of the file, from 1
    first, second : ids of its vertices, as in the file
    true_second : empty of a closure
    """

    line: int
    tag: str
    first: int
    second: int
    fault: str
    true_second: str = ""


def write_table(path: Path | str, of: type, rows: Sequence[WrongMessage] | Sequence[WrongLine]) -> None:
    """Write a table as CSV, below the names of the fields. Raises FormatError."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in fields(of))
    writer.writerows(astuple(row) for row in rows)
    write_text(path, text.getvalue())


# -- kinds -----------------------------------------------------------------------------------------------------------


def false_closures(
    draft: Draft,
    rng: Generator,
    policy: str = option("random", "which poses, see ``false_closures``", choices=generator.POLICIES),
    rate: float = option(0.3, "false of all closures", "", 0, 0.99),
    count: int = option(0, "so many, whatever the rate; 0: by the rate", "", 0, 1e6),
    group: int = option(generator.GROUP, "pairs of poses in a group", "", 1, 1e4),
) -> None:
    """Closures between different places; one that agrees with the truth is drawn again."""
    covariances = np.reshape([c.covariance for c in draft.closures], (-1, draft.space.dof, draft.space.dof))
    roots, at = Gaussian.from_covariance(covariances).sqrt_information, places(draft.truth)
    ends, measured, root = generator.false_closures(draft.truth[at], roots, rng, policy, rate, count, group)
    for (earlier, later), z, one in zip(draft.stamps_ns[at[ends]].tolist(), measured.tolist(), root, strict=True):
        draft.mark("closure", len(draft.closures), "false_closures")
        covariance = np.linalg.inv(one.T @ one)
        flat = tuple((0.5 * (covariance + covariance.T)).ravel().tolist())
        draft.closures.append(Closure(later, earlier, CLOSURES_TOPIC, tuple(z), flat))


def wrong_ids(draft: Draft, rng: Generator, rate: float = option(0.05, "of all sightings", "", 0, 1)) -> None:
    """Sightings with the id of another landmark, if possible one that is not in the same message."""
    names = list(dict.fromkeys(draft.true_ids))
    if len(names) < 2:
        raise GraphSlamError(f"wrong_ids: {len(names)} landmarks are seen; another one's id needs two")
    for k in _random_subset(rng, len(draft.sightings), rate):
        message = np.flatnonzero(draft.seen_at == draft.seen_at[k]).tolist()
        others_in_message = {name for j in message for name in (draft.sightings[j].id, draft.true_ids[j])}
        others = [name for name in names if name not in others_in_message] or [
            n for n in names if n != draft.true_ids[k]
        ]
        draft.spoil(k, "wrong_ids", replace(draft.sightings[k], id=others[rng.integers(len(others))]))


def swapped_ids(
    draft: Draft,
    rng: Generator,
    pairs: int = option(1, "how many", "", 1, 1e4),
    at: float = option(0.5, _HALFWAY, "", 0, 1),
) -> None:
    """Pairs of landmarks that exchange their ids, from some time on."""
    names, later = _seen_later(draft, rng, at, 2 * pairs, "swapped_ids")
    other = dict(zip(names[::2] + names[1::2], names[1::2] + names[::2], strict=True))
    for k in later:
        draft.spoil(k, "swapped_ids", replace(draft.sightings[k], id=other[draft.true_ids[k]]))


def moved_landmarks(
    draft: Draft,
    rng: Generator,
    count: int = option(1, "how many", "", 1, 1e4),
    at: float = option(0.5, _HALFWAY, "", 0, 1),
    distance_m: float = option(2.0, "by how much each, in a direction of its own", "m", 0, 1000),
) -> None:
    """Landmarks that stand elsewhere from some time on."""
    names, later = _seen_later(draft, rng, at, count, "moved_landmarks")
    angles = rng.uniform(-np.pi, np.pi, len(names))
    ways = distance_m * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(names))])
    displaced = dict(zip(names, ways[:, : draft.space.dimensions], strict=True))
    for k in later:
        draft.spoil(k, "moved_landmarks", draft.seen_from(k, displaced[draft.true_ids[k]]))


def outliers(
    draft: Draft,
    rng: Generator,
    rate: float = option(0.05, "of all sightings", "", 0, 1),
    most_m: float = option(5.0, "by how much at most; evenly from a fifth of it", "m", 1e-3, 1000),
) -> None:
    """Sightings whose range is too long, as by an echo."""
    n = draft.space.dimensions
    if not draft.sightings:
        raise GraphSlamError("outliers: no landmark is seen")
    for k in _random_subset(rng, len(draft.sightings), rate):
        s, longer = draft.sightings[k], float(rng.uniform(0.2, 1.0)) * most_m
        if s.kind == "bearing":
            raise GraphSlamError("outliers: a bearing has no range")
        measured = np.array(s.measured)
        if "range" in s.kind:
            measured[0] += longer
        else:
            distance = float(np.linalg.norm(measured[:n]))
            measured[:n] *= 1.0 + longer / max(distance, 1e-6)
        draft.spoil(k, "outliers", replace(s, measured=tuple(measured.tolist())))


def slip(
    draft: Draft,
    _rng: Generator,
    at: float = option(0.5, _HALFWAY, "", 0, 1),
    lasting: float = option(0.02, "for how long, as a part of the whole", "", 0, 1),
    factor: float = option(1.5, "distance in odometry for each metre driven", "", 0, 100),
) -> None:
    """A stretch in which odometry tells a longer or shorter way than was driven."""
    first = draft.pose_at(at)
    last = min(len(draft) - 1, first + max(1, draft.pose_at(lasting)))
    if first >= last:
        raise GraphSlamError(f"slip: at {at:g} of the whole nothing is driven any more")
    group, n, poses = draft.space.group, draft.space.dimensions, draft.odometry
    steps = np.stack(group.between(tuple(poses[first:last].T), tuple(poses[first + 1 : last + 1].T)), axis=1)
    steps[:, :n] *= factor
    slipped = [tuple(poses[first].tolist())]
    for step in steps.tolist():
        slipped.append(group.compose(slipped[-1], tuple(step)))
    draft.spoil_odometry(first, slipped, np.where(np.arange(draft.space.dof) < n, factor, 1.0), "slip")


def carried(
    draft: Draft,
    _rng: Generator,
    at: float = option(0.5, _HALFWAY, "", 0, 1),
    distance_m: float = option(10.0, "how far from where it was lifted it is set down, at least", "m", 1e-3, 1e5),
) -> None:
    """A robot that is carried along its way: odometry stands still, its sensors still measure."""
    first, n = draft.pose_at(at), draft.space.dimensions
    away = np.linalg.norm(draft.truth[first:, :n] - draft.truth[first, :n], axis=1)
    if not (away >= distance_m).any():
        raise GraphSlamError(f"carried: after {at:g} of the whole it comes no farther than {away.max():.1f} m")
    last = first + int(np.argmax(away >= distance_m))
    lifted = tuple(draft.odometry[first].tolist())
    draft.spoil_odometry(first, [lifted] * (last - first + 1), 0.0, "carried")


def jump(
    draft: Draft,
    _rng: Generator,
    at: float = option(0.5, _HALFWAY, "", 0, 1),
    ahead_m: float = option(1.0, "how far along its own x axis", "m", -1000, 1000),
    left_m: float = option(0.0, "along its own y axis", "m", -1000, 1000),
    turn_rad: float = option(0.2, "and by how much it turns", "rad", -3.15, 3.15),
) -> None:
    """Odometry that jumps from one pose to the next, and does not know it."""
    later = max(1, draft.pose_at(at))
    if later >= len(draft):
        raise GraphSlamError("jump: there is but one pose")
    space = draft.space
    turned = [0.0] * (space.dof - space.dimensions - 1) + [turn_rad]
    ahead = [ahead_m, left_m, 0.0][: space.dimensions]
    before, there = map(tuple, draft.odometry[later - 1 : later + 1].tolist())
    draft.spoil_odometry(later - 1, [before, space.group.retract(there, (*ahead, *turned))], 1.0, "jump")


KINDS = {
    put.__name__: put
    for put in (false_closures, wrong_ids, swapped_ids, moved_landmarks, outliers, slip, carried, jump)
}
"""Faults of worlds, whose truth is known."""


def _random_subset(rng: Generator, count: int, rate: float) -> list[int]:
    return np.sort(rng.permutation(count)[: round(rate * count)]).tolist()


def _seen_later(draft: Draft, rng: Generator, at: float, count: int, fault: str) -> tuple[list[str], list[int]]:
    """Some of the landmarks that are seen often enough before a part of the drive and from it on, and what is then."""
    is_later = draft.seen_at >= draft.pose_at(at)
    later = Counter(name for name, late in zip(draft.true_ids, is_later, strict=True) if late)
    whole = Counter(draft.true_ids)
    often = [name for name in whole if min(later[name], whole[name] - later[name]) >= _OFTEN]
    if len(often) < count:
        raise GraphSlamError(f"{fault}: needs {count} landmarks that are seen often enough; there are {len(often)}")
    names = [often[k] for k in rng.permutation(len(often))[:count].tolist()]
    return names, [k for k in np.flatnonzero(is_later).tolist() if draft.true_ids[k] in names]


@dataclass(frozen=True, slots=True)
class Fault:
    """A kind of fault and its options."""

    kind: str
    options: Mapping[str, Any]

    @classmethod
    def named(cls, kind: str, /, **options: Any) -> "Fault":
        """A fault by its name.

        Raises
        ------
        GraphSlamError
            Unknown kind or option (those that exist are named), wrong type, or a value out of bounds.
        """
        known: dict[str, Any] = {**KINDS, **MESSAGE_KINDS}
        if kind not in known:
            raise GraphSlamError(f"no fault {kind!r}; there are {', '.join(known)}{did_you_mean(kind, known)}")
        return cls(kind, filled(kind, options_of(known[kind]), options))

    @property
    def is_of_messages(self) -> bool:
        """Return whether it is put into messages, and not into a world."""
        return self.kind in MESSAGE_KINDS

    @classmethod
    def parsed(cls, text: str) -> "Fault":
        """A fault from ``KIND`` or ``KIND:KEY=VALUE,...``; as ``named``."""
        kind, separator, options = text.partition(":")
        values: dict[str, Any] = {}
        for one in options.split(",") if separator else ():
            name, value = parse_setting(one)
            if name in values:
                raise GraphSlamError(f"{kind}: {name} is given twice")
            values[name] = value
        return cls.named(kind, **values)


def put_faults(into: Draft | Drive, faults: Sequence[Fault], seed: int) -> None:
    """Put faults of a world into a draft, or those of messages into a drive, one after the other."""
    kinds: dict[str, Any] = KINDS if isinstance(into, Draft) else MESSAGE_KINDS
    for k, fault in enumerate(faults):
        if fault.kind in kinds:
            kinds[fault.kind](into, random(seed, _STREAMS, k), **fault.options)


def faulty_recording(recording: Recording, faults: Sequence[Fault], seed: int) -> tuple[Recording, list[WrongMessage]]:
    """Put faults into a recording. The truth stays as it was.

    Raises
    ------
    GraphSlamError
        A fault does not fit: it needs closures, or landmarks that are seen often, and there are none.
    """
    space, at = space_of(recording.T_world_base[0]), {ns: k for k, ns in enumerate(recording.stamps_ns.tolist())}
    sizes = [len(one.sightings) for one in recording.seen]
    draft = Draft(
        space,
        recording.T_world_base,
        recording.T_odom_base,
        recording.twist,
        [s for one in recording.seen for s in one.sightings],
        np.repeat(np.array([at[one.stamp_ns] for one in recording.seen], dtype=np.int64), sizes),
        recording.landmarks,
        recording.stamps_ns,
        list(recording.closures),
    )
    put_faults(draft, faults, seed)
    starts = np.cumsum([0, *sizes]).tolist()
    seen = tuple(
        replace(one, sightings=tuple(draft.sightings[start:end]))
        for one, (start, end) in zip(recording.seen, pairwise(starts), strict=True)
    )
    closures = tuple(sorted(draft.closures, key=lambda closure: closure.stamp_ns))
    faulty = replace(recording, T_odom_base=draft.odometry, twist=draft.twist, seen=seen, closures=closures)

    def message(what: str, k: int) -> tuple[str, int, int | str, str]:
        if what == "odometry":
            return ODOMETRY_TOPIC, int(recording.stamps_ns[k]), "", ""
        if what == "closure":
            one = draft.closures[k]
            before = sum(other.stamp_ns == one.stamp_ns for other in draft.closures[:k])  # in its message
            return CLOSURES_TOPIC, one.stamp_ns, before, str(one.from_stamp_ns)
        of = int(np.searchsorted(starts, k, side="right")) - 1
        return LANDMARKS_TOPIC, recording.seen[of].stamp_ns, k - starts[of], names[draft.sightings[k].id]

    names = recorded_names(recording)
    rows = [
        WrongMessage(*message(what, k), "+".join(kinds), names[draft.true_ids[k]] if what == "sighting" else "")
        for (what, k), kinds in draft.wrong.items()
    ]
    return faulty, sorted(rows, key=lambda row: (row.stamp_ns, row.topic, row.index or 0))


def faulty_graph(file: G2oFile, truth: Array, faults: Sequence[Fault], seed: int) -> tuple[G2oFile, list[WrongLine]]:
    """Add false closures to the graph of a file, whose poses are in order of their ids.

    Parameters
    ----------
    truth : the stored numbers of all vertices end to end, as ``graph.initial``: of a graph whose truth nobody knows,
        those of its optimum

    Raises
    ------
    GraphSlamError
        Another fault, or no closures that false ones could be like.
    """
    graph, is_pose = file.graph, np.zeros(file.graph.vertex_count, dtype=bool)
    space = SPATIAL if SPATIAL.pose in graph.kinds else PLANAR
    if space.relative_pose not in graph.tables:
        raise GraphSlamError("faults: a graph without relative poses")
    table = graph.tables[space.relative_pose]
    is_pose[np.flatnonzero(graph.kind.values == graph.kinds.index(space.pose))] = True
    if "landmarks" in graph.labels:  # tags with orientation are poses, too
        is_pose[table.vertices[table.label.values == graph.labels.index("landmarks"), 1]] = False
    poses = np.flatnonzero(is_pose)
    poses = poses[np.argsort(np.asarray(file.ids)[poses])]
    place = np.full(graph.vertex_count, -1)
    place[poses] = np.arange(len(poses))
    edges = table.at(np.argsort(table.ids))
    ends = place[edges.vertices]
    is_closure = np.asarray((ends >= 0).all(axis=1))
    steps = np.flatnonzero(is_closure & (np.abs(ends[:, 1] - ends[:, 0]) == 1))
    is_closure[steps[np.unique(ends[steps].max(axis=1), return_index=True)[1]]] = False
    true = truth[graph.begins(poses)[:, None] + np.arange(space.pose.size)]
    roots = edges.sqrt_information[is_closure]
    added: dict[int, Index] = {}
    for k, fault in enumerate(faults):
        if fault.kind != "false_closures":
            raise GraphSlamError(f"{fault.kind}: a graph has no messages and no drive: it takes false_closures alone")
        at, z, root = generator.false_closures(true, roots, random(seed, _STREAMS, k), **fault.options)
        ids = graph.add_edges(space.relative_pose, poses[at], z, Gaussian(root), "closures")
        added |= dict(zip(ids.tolist(), poses[at], strict=True))
        roots = np.concatenate([roots, root])
    line_of, tag = _lines(file), tag_of(space.relative_pose)
    ends_of = {edge: (file.ids[i], file.ids[j]) for edge, (i, j) in added.items()}
    rows = [WrongLine(line_of[edge], tag, *ends, "false_closures") for edge, ends in ends_of.items()]
    return file, sorted(rows, key=lambda row: row.line)


def _lines(file: G2oFile) -> dict[int, int]:
    """The line of each edge in the file that is written, from 1."""
    graph, tags = file.graph, {tag_of(edge) for edge in file.graph.tables}
    text = graph_lines(file, lambda vertices: np.zeros((len(vertices), 1)))  # whatever the values are
    lines = [number for number, line in enumerate(text, start=1) if line.split()[0] in tags]
    labels = np.empty(graph.edge_count, dtype=np.int64)
    for table in graph.tables.values():
        labels[table.ids] = table.label.values
    return dict(zip(np.lexsort((np.arange(len(labels)), labels)).tolist(), lines, strict=True))
