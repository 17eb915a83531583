"""A graph with false measurements among the true ones: what robust solvers are tried on."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.problem import Array, Edges, Problem, joined
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.slam import Sighting
from graph_slam_ros.tools.simulation import Fault
from graph_slam_ros.tools.simulation import false_closures as generator
from graph_slam_ros.tools.simulation.faults import Draft, put_faults

ID_POLICIES = ("wrong_ids", "swapped_ids")
POLICIES = (*generator.POLICIES, *ID_POLICIES)
"""Closures between places that are not one, and landmarks taken for each other; as the simulator's."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What a contender is given, and what it is not told.

    Attributes
    ----------
    odometry : the graph without closures: odometry, from which its poses are composed, and sightings, of which each
        landmark is where the first has it
    closures : in order of their later pose
    false : (n,) which closures, and then which sightings, are false; for the judge alone
    """

    odometry: Problem
    closures: Edges
    false: NDArray[np.bool_]


def split(problem: Problem) -> tuple[Problem, Edges]:
    """Odometry, one edge from each pose to the next, and all other edges between poses.

    Raises
    ------
    GraphSlamError
        Some pose has no odometry to it.
    """
    ends = problem.relative.ends
    neighbours = np.flatnonzero(np.abs(ends[:, 1] - ends[:, 0]) == 1)
    later, first = np.unique(ends[neighbours].max(axis=1), return_index=True)
    missing = np.setdiff1d(np.arange(1, len(problem.poses)), later)
    if len(missing):
        raise GraphSlamError(f"{problem.name}: no odometry between poses {missing[0] - 1} and {missing[0]}")
    is_odometry = np.isin(np.arange(len(ends)), neighbours[first])
    return chained(replace(problem, relative=problem.relative[is_odometry])), problem.relative[~is_odometry]


def chained(odometry: Problem) -> Problem:
    """Poses composed from odometry, landmarks where they were seen first from there."""
    group = se2 if odometry.planar else se3
    level = (0.0,) * (3 if odometry.planar else 6)  # normalises a rotation: rounding would grow from pose to pose
    poses, points = [tuple(odometry.poses[0].tolist())], odometry.landmarks.copy()
    for step in odometry.steps():
        if step.pose:
            motion = tuple(step.motion.tolist())
            poses.append(
                group.retract(group.compose(poses[-1], motion if step.forward else group.inverse(motion)), level)
            )
        for landmark, row in zip(step.landmarks, step.first.tolist(), strict=True):
            points[landmark] = se2.act(poses[-1], tuple(step.sightings.measured[row].tolist()))
    return replace(odometry, poses=np.array(poses), landmarks=points)


def trial(problem: Problem, truth: Array, policy: str, rate: float, seed: int) -> Trial:
    """A graph with false closures or wrong identities, see ``POLICIES``.

    Parameters
    ----------
    truth : (n, 3) or (n, 7) poses; what agrees with them is not false
    rate : false ones, of all closures or of all sightings; of swapped identities it says nothing

    Raises
    ------
    GraphSlamError
        There is no true closure for false ones to be like, none that can be drawn, or landmarks are too few.
    """
    if policy in ID_POLICIES:
        return _with_wrong_ids(problem, Fault.named(policy, **({"rate": rate} if policy == "wrong_ids" else {})), seed)
    return _with_false_closures(problem, truth, policy, rate, seed)


def _with_false_closures(problem: Problem, truth: Array, policy: str, rate: float, seed: int) -> Trial:
    """Shuffled among the true ones, and with the information of true ones."""
    odometry, true = split(problem)
    if not len(true):
        raise GraphSlamError(f"{problem.name}: no closure in it: --policy {','.join(ID_POLICIES)}")
    rng = np.random.default_rng(seed)
    both = joined(true, Edges(*generator.false_closures(truth, true.root, rng, policy, rate)))
    shuffled = rng.permutation(len(both))
    in_time = shuffled[np.argsort(both.ends[shuffled].max(axis=1), kind="stable")]
    sightings = np.zeros(len(problem.sightings), dtype=bool)
    return Trial(odometry, both[in_time], np.concatenate([in_time >= len(true), sightings]))


def _with_wrong_ids(problem: Problem, fault: Fault, seed: int) -> Trial:
    """By the simulator's faults, which know identities as texts."""
    odometry, closures = split(problem)
    seen, nowhere = problem.sightings, np.zeros((len(problem.poses), 3))
    named = [Sighting(str(landmark), "position", (0.0, 0.0), np.eye(2)) for landmark in seen.ends[:, 1].tolist()]
    draft = Draft(
        PLANAR,
        nowhere,
        nowhere,
        nowhere,
        named,
        seen.ends[:, 0],
        {},
        np.arange(len(nowhere)),
        [],
    )
    put_faults(draft, [fault], seed)
    false = np.array([("sighting", k) in draft.wrong for k in range(len(named))], dtype=bool)
    ends = np.column_stack([seen.ends[:, 0], [int(s.id) for s in draft.sightings]])
    return Trial(
        chained(in_order_of_sighting(replace(odometry, sightings=replace(seen, ends=ends)))),
        closures,
        np.concatenate([np.zeros(len(closures), dtype=bool), false]),
    )


def in_order_of_sighting(problem: Problem) -> Problem:
    """Landmarks numbered as they are seen first; those that are not seen are none."""
    seen, first, which = np.unique(problem.sightings.ends[:, 1], return_index=True, return_inverse=True)
    in_time = np.argsort(first)
    ends = np.column_stack([problem.sightings.ends[:, 0], np.argsort(in_time)[which]])
    return replace(problem, landmarks=problem.landmarks[seen[in_time]], sightings=replace(problem.sightings, ends=ends))
