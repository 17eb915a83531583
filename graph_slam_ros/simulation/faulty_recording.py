"""Recordings with faults in them.

faulty, wrong = faulty_recording(simulate("warehouse", 7), [Fault.named("swapped_ids", at=0.3)], seed=7)
write_bag(faulty, "warehouse.mcap")
write_table("warehouse.faults.csv", WrongMessage, wrong)
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.simulation.bag import ODOMETRY_TOPIC, recorded_names
from graph_slam_ros.simulation.closures import places
from graph_slam_ros.simulation.draft import Draft
from graph_slam_ros.simulation.false_closures import Closures
from graph_slam_ros.simulation.fault_table import WrongMessage
from graph_slam_ros.simulation.faults import Fault, put_faults
from graph_slam_ros.simulation.motion import space_of
from graph_slam_ros.simulation.recording import CLOSURES_TOPIC, LANDMARKS_TOPIC, Recording
from graph_slam_ros.slam import Closure


def faulty_recording(recording: Recording, faults: Sequence[Fault], seed: int) -> tuple[Recording, list[WrongMessage]]:
    """Put faults into a recording; what is true stays as it was.

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
        _closures_of(recording, space, at),
        places(recording.T_world_base),
    )
    put_faults(draft, faults, seed)
    starts = np.cumsum([0, *sizes]).tolist()
    seen = tuple(
        replace(one, sightings=tuple(draft.sightings[start : start + size]))
        for one, start, size in zip(recording.seen, starts, sizes, strict=False)
    )
    closures, place = _recorded_closures(recording, draft)
    twist = recording.twist if draft.twist is None else draft.twist
    faulty = replace(recording, T_odom_base=draft.odometry, twist=twist, seen=seen, closures=closures)

    def message(what: str, k: int) -> tuple[str, int, int | str, str]:
        if what == "odometry":
            return ODOMETRY_TOPIC, int(recording.stamps_ns[k]), "", ""
        if what == "closure":
            one = closures[place[k]]
            first = next(j for j, other in enumerate(closures) if other.stamp_ns == one.stamp_ns)
            return CLOSURES_TOPIC, one.stamp_ns, place[k] - first, str(one.from_stamp_ns)
        of = int(np.searchsorted(starts, k, side="right")) - 1
        return LANDMARKS_TOPIC, recording.seen[of].stamp_ns, k - starts[of], names[draft.sightings[k].id]

    names = recorded_names(recording)
    rows = [
        WrongMessage(*message(what, k), wrong.fault, names.get(wrong.true_id, ""))
        for (what, k), wrong in draft.wrong.items()
    ]
    return faulty, sorted(rows, key=lambda row: (row.stamp_ns, row.topic, row.index or 0))


def _closures_of(recording: Recording, space: Geometry, at: Mapping[int, int]) -> Closures:
    n, d = len(recording.closures), space.dof
    ends = [(at[c.from_stamp_ns], at[c.stamp_ns]) for c in recording.closures]
    covariances = np.reshape([c.covariance for c in recording.closures], (n, d, d))
    root = Gaussian.from_covariance(covariances).sqrt_information if n else np.empty((0, d, d))
    measured = np.reshape([c.T_from_base for c in recording.closures], (n, space.pose.size))
    return Closures(np.array(ends, dtype=np.int64).reshape(n, 2), measured, root)


def _recorded_closures(recording: Recording, draft: Draft) -> tuple[tuple[Closure, ...], list[int]]:
    """All closures in order of their later stamp, and the place there of each of the draft's."""
    found, new = list(recording.closures), draft.closures
    for k in range(len(found), len(new)):
        earlier, later = recording.stamps_ns[new.ends[k]].tolist()
        covariance = np.linalg.inv(new.root[k].T @ new.root[k])
        flat = tuple((0.5 * (covariance + covariance.T)).ravel().tolist())
        found.append(Closure(later, earlier, CLOSURES_TOPIC, tuple(new.measured[k].tolist()), flat))
    order = sorted(range(len(found)), key=lambda k: found[k].stamp_ns)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return tuple(found[k] for k in order), place.tolist()
