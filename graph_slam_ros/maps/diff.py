"""Differences between the maps of two runs."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.edge_tags import tag_of
from graph_slam_ros.maps.alignment import Alignment, align, as_they_are, laid_on, positions
from graph_slam_ros.maps.merge import merge_trouble, refuse_other_space, shared_landmarks
from graph_slam_ros.runs.condensed_map import WholePath
from graph_slam_ros.runs.restore import restored
from graph_slam_ros.slam import MapView
from graph_slam_ros.typing import Array, Index, Numbers

_SAME_M = 1e-3  # nobody calls that moved
_DIGITS = 6  # of what was measured
_SHOWN = 10


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of each map, and of what is in both."""

    a: int
    b: int
    both: int


@dataclass(frozen=True, slots=True)
class MovedLandmark:
    """A landmark that is elsewhere in B: by how many metres, and how many standard deviations of both maps."""

    landmark: str
    distance_m: float
    sigmas: float


@dataclass(frozen=True, slots=True)
class Judged:
    """A measurement in both maps with different verdicts: its class, its edge in each, each verdict."""

    about: str
    edge_a: int
    edge_b: int
    verdict_a: str
    verdict_b: str


@dataclass(frozen=True, slots=True)
class Difference:
    """The differences between two maps.

    Attributes
    ----------
    keyframes, landmarks, edges : of one stamp, of one name, of one measurement between the same
    aligned_by : landmarks, stamps, or nothing: then both are taken as they are
    T_a_b : where the map of B is in that of A
    keyframes_m : how far keyframes of one stamp are apart, of half of them and at most; none: not a number
    moved : landmarks, the farthest in standard deviations first
    edits_a, edits_b : edits by hand that only one of them has
    condensed : how many keyframes of each have left it, or are in a place: their edges are compared no more
    merge_trouble : why they cannot be merged; empty where they can
    """

    keyframes: Counts
    landmarks: Counts
    edges: Counts
    chi2: tuple[float, float]
    aligned_by: str
    T_a_b: Numbers
    keyframes_m: tuple[float, float]
    only_in_a: list[str]
    only_in_b: list[str]
    moved: list[MovedLandmark]
    verdicts: list[Judged]
    edits_a: list[str]
    edits_b: list[str]
    condensed: tuple[int, int] = (0, 0)
    merge_trouble: str = ""

    @property
    def is_same(self) -> bool:
        """Return whether both are equal to a millimetre."""
        counted = (self.keyframes, self.landmarks, self.edges)
        is_there = all(one.a == one.b == one.both for one in counted)
        is_moved = any(one.distance_m > _SAME_M for one in self.moved) or self.keyframes_m[1] > _SAME_M
        return is_there and not (is_moved or self.verdicts or self.edits_a or self.edits_b)

    def as_dict(self) -> dict[str, Any]:
        """Plain values; a missing one is None."""
        apart = [None if math.isnan(metres) else metres for metres in self.keyframes_m]
        return asdict(self) | {"keyframes_m": apart, "same": self.is_same}

    def lines(self) -> Iterator[str]:
        """Yield what differs, for people."""
        yield f"{'':10s}{'A':>14s}{'B':>14s}{'both':>14s}"
        for name in ("keyframes", "landmarks", "edges"):
            one: Counts = getattr(self, name)
            yield f"{name:10s}{one.a:14d}{one.b:14d}{one.both:14d}"
        if any(self.condensed):
            counts = "".join(f"{count:14d}" for count in self.condensed)
            yield f"condensed {counts}  keyframes, whose edges are in places"
        yield f"{'chi2':10s}{self.chi2[0]:14.3f}{self.chi2[1]:14.3f}"
        n = 2 if len(self.T_a_b) == 3 else 3
        where = ", ".join(f"{x:.3f}" for x in self.T_a_b[:n])
        yield f"aligned by {self.aligned_by}" + (
            f": B begins at ({where}) m in A" if self.aligned_by != "nothing" else ""
        )
        if self.keyframes.both:
            half, most = self.keyframes_m
            yield f"keyframes of one stamp are {half:.3f} m apart (median), {most:.3f} m at most"
        moved = [one for one in self.moved if one.distance_m > _SAME_M]
        yield from _shown(f"only in A  landmark {name}" for name in self.only_in_a)
        yield from _shown(f"only in B  landmark {name}" for name in self.only_in_b)
        yield from _shown(
            f"moved      landmark {m.landmark}: {m.distance_m:.3f} m, {m.sigmas:.1f} sigmas" for m in moved
        )
        yield from _shown(
            f"judged     {j.about}: {j.verdict_a} (edge {j.edge_a} of A), {j.verdict_b} (edge {j.edge_b} of B)"
            for j in self.verdicts
        )
        yield from _shown(f"by hand    only in A: {text}" for text in self.edits_a)
        yield from _shown(f"by hand    only in B: {text}" for text in self.edits_b)
        yield "no difference" if self.is_same else "they differ"


def _shown(lines: Iterable[str]) -> Iterator[str]:
    whole = list(lines)
    yield from whole[:_SHOWN]
    if len(whole) > _SHOWN:
        yield f"{whole[0][:11]}and {len(whole) - _SHOWN} more (--json has all)"


def diff(a: Path, b: Path, losses: list[str]) -> Difference:
    """Compare the maps of two runs. What could not be read of them is added to ``losses``.

    Raises GraphSlamError: one of them has no map, or another number of dimensions.

    Keyframes that were condensed count, at their present poses. Their edges do not: what they measured is in places.
    """
    one, two = (restored(folder, losses).view for folder in (a, b))
    refuse_other_space(one, two, a, b)
    common = shared_landmarks(one, two)
    at = _of_one_stamp(WholePath.of(one, a), WholePath.of(two, b))
    aligned, by, T_a_b = _aligned(one, two, common, at)
    in_a, in_b = (poses[:, : one.space.dimensions] for poses in at)
    apart = np.linalg.norm(np.stack(one.space.group.act(T_a_b, tuple(in_b.T)), axis=-1) - in_a, axis=1)
    known = [set(view.landmarks) for view in (one, two)]
    edges, verdicts = _edges(one, two)
    chi2 = [view.report.chi2_final if view.report else math.nan for view in (one, two)]
    moved = [MovedLandmark(name, *aligned.distance(k)) for k, name in enumerate(common)]
    return Difference(
        Counts(len(one.keyframes), len(two.keyframes), len(apart)),
        Counts(len(known[0]), len(known[1]), len(known[0] & known[1])),
        edges,
        (chi2[0], chi2[1]),
        by,
        T_a_b,
        (float(np.median(apart)), float(apart.max())) if len(apart) else (math.nan, math.nan),
        sorted(known[0] - known[1]),
        sorted(known[1] - known[0]),
        sorted(moved, key=lambda one: (-one.sigmas, one.landmark)),
        verdicts,
        [edit.text for edit in one.edits if edit.edit not in [other.edit for other in two.edits]],
        [edit.text for edit in two.edits if edit.edit not in [other.edit for other in one.edits]],
        (one.keyframes.first, two.keyframes.first),
        merge_trouble(one, two, a, b),
    )


def _aligned(one: MapView, two: MapView, common: list[str], at: tuple[Array, Array]) -> tuple[Alignment, str, Numbers]:
    """Align by landmarks, else by stamps, else use the maps as they are; ``at`` are the poses of one stamp."""
    space, robust = one.space, one.config.robust
    a, b = positions(one, common), positions(two, common)
    found = align(space, a, b, robust.gate, robust.noise_factor)
    if found is not None:
        return found, f"{int(found.fits.sum())} of {len(common)} landmarks", found.T_a_b
    T_a_b = laid_on(space, *(poses[:, : space.dimensions] for poses in at))
    by = f"{len(at[0])} stamps" if T_a_b is not None else "nothing"
    T_a_b = T_a_b or space.identity
    return as_they_are(space, a, b, T_a_b), by, T_a_b


def _of_one_stamp(one: WholePath, two: WholePath) -> tuple[Array, Array]:
    """Poses of the keyframes with the same stamp. Several of one stamp are paired in order."""
    a, b = _by_stamp(one.stamps_ns), _by_stamp(two.stamps_ns)
    common = [stamp for stamp in a if stamp in b]
    return one.poses()[[a[stamp] for stamp in common]], two.poses()[[b[stamp] for stamp in common]]


def _by_stamp(stamps_ns: Index) -> dict[tuple[int, int], int]:
    times = Counter[int]()
    out = {}
    for k, stamp in enumerate(stamps_ns.tolist()):
        out[stamp, times[stamp]] = k
        times[stamp] += 1
    return out


# -- edges -------------------------------------------------------------------------------------------------------------


def _edges(one: MapView, two: MapView) -> tuple[Counts, list[Judged]]:
    """Edges in both maps, with equal type, vertices and measurement, and those of them with different verdicts."""
    a, b, names = _by_meaning(one), _by_meaning(two), _names(one)
    pairs = [pair for key in a if key in b for pair in zip(a[key], b[key], strict=False)]
    unlike = []
    for in_a, in_b in pairs:
        verdicts = one.ledger.verdict_of(in_a), two.ledger.verdict_of(in_b)
        if verdicts[0] is not verdicts[1]:
            words = [verdict.name.lower() for verdict in verdicts]
            unlike.append(Judged(_about(one, names, in_a), in_a, in_b, *words))
    return Counts(one.graph.edge_count, two.graph.edge_count, len(pairs)), unlike


def _by_meaning(view: MapView) -> dict[Any, list[int]]:
    names = _names(view)
    out: dict[Any, list[int]] = defaultdict(list)
    for edge in view.graph.edge_ids.since().tolist():
        one = view.graph.edge(edge)
        ends = tuple(names.get(vertex) for vertex in one.vertices)
        measured = tuple(round(x, _DIGITS) + 0.0 for x in one.measured.tolist())
        out[tag_of(one.type), one.label, ends, measured].append(edge)
    return out


def _names(view: MapView) -> dict[int, int | str]:
    """Return the identity of a vertex in any map: a stamp, or a name."""
    poses = dict(zip(view.keyframes.ids.tolist(), view.keyframes.stamps_ns.tolist(), strict=True))
    poses |= {one.vertex: one.stamp_ns for one in view.bounded.old.values()} if view.bounded else {}
    return poses | {mark.vertex: name for name, mark in view.landmarks.items()}


def _about(view: MapView, names: dict[int, int | str], edge: int) -> str:
    one = view.graph.edge(edge)
    name = names.get(one.vertices[-1], "")
    what = f"{name / 1e9:.3f} s" if isinstance(name, int) else name
    return f"{one.label} {what}"
