"""Other associations of a whole drive, for where the first one makes a map that is probably wrong.

The beam follows a drive from its beginning, and drops what becomes unlikely on the way. In a warehouse, where much
looks alike, that is sometimes the truth. With more new landmarks or hypotheses, or where what is missing counts,
a beam drops others. The explanation of everything decides which one is right.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.landmarks.beam import NOTHING, Beam, BeamSettings, Ids, Seed, changes
from graph_slam_ros.slam.landmarks.rotations import matrices_of
from graph_slam_ros.slam.landmarks.scans import Motion, Scan
from graph_slam_ros.typing import Array

MOST_SCANS = 1000
"""Scans of a drive that is associated again: it takes 10 to 30 ms for each."""

_LOG_NEW = 0.0  # a landmark in each square metre
_MORE, _WITHIN = 120, 40.0  # hypotheses, and the log weight below the best at which one is dropped
_LOG_MISSED = float(np.log(0.1))
_SLOTS = 60
_HELD = 1e-8  # variance of the first pose


def other_associations(
    space: Geometry, scans: tuple[Scan, ...], motions: tuple[Motion, ...], pose: Array, settings: BeamSettings
) -> Iterator[Ids]:
    """Yield the number of each cluster's landmark by other beams, from the first scan on.

    Parameters
    ----------
    pose : of the first scan
    settings : of the beam that came first
    """
    firsts = np.cumsum([0, *(len(scan.clusters) for scan in scans)]).tolist()
    (position,), (turn,) = matrices_of(space, pose[None])
    variances = [_HELD] * space.dof + [settings.scale_sigma**2] * 2
    no_landmarks = np.empty((0, space.dimensions)), np.empty(0, dtype=np.int64)
    plain = replace(settings, log_new=_LOG_NEW, slots=_SLOTS)
    wide = replace(plain, hypotheses=_MORE, within=_WITHIN)
    for other in (plain, wide, replace(wide, log_missed=_LOG_MISSED)):
        seed = Seed(position, turn, np.zeros(2), *no_landmarks, np.diag(variances))
        beam = Beam(other, seed)
        out, last = np.full(firsts[-1], NOTHING), None
        for k, scan in enumerate(scans):
            if k:
                beam.advance(motions[k - 1])
            last = beam.explain(scan, firsts[k])
        if beam.is_sound:
            for cluster, landmark in changes(None, last).items():
                out[cluster] = landmark
            yield out
