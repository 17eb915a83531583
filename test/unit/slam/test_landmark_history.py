"""When a landmark is well known: from verdicts on its first sightings, as they are now."""

import numpy as np
import pytest

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.slam.robust.landmark_history import LandmarkHistory
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict


@pytest.mark.parametrize("seed", range(5))
def test_what_is_known_follows_every_change_of_a_verdict(seed):
    rng, graph, ledger = np.random.default_rng(seed), Graph(), Ledger()
    history = LandmarkHistory(graph, ledger)
    landmarks = [graph.add_vertex(PLANAR.point, (k, 0.0)) for k in range(3)]
    verdicts = Verdict.ACCEPTED, Verdict.PENDING, Verdict.REJECTED
    known = set[int]()
    for edge in range(120):
        history.add(edge, edge, landmarks[int(rng.integers(3))])
        if rng.random() < 0.7:  # some edges are judged later than they are added
            count = edge + 1 - len(ledger)
            zeros = np.zeros(count)
            ledger.enter(0, zeros, np.zeros(count, dtype=int), zeros, np.empty(0), np.ones(count, dtype=bool))
        if len(ledger) and rng.random() < 0.4:
            ledger.put(int(rng.integers(len(ledger))), verdicts[int(rng.integers(3))], Reason.NONE)
        for landmark in landmarks:
            if landmark in history._earliest:
                newest, anew = int(rng.integers(130)), LandmarkHistory(graph, ledger)
                anew._start, anew._earliest = history._start, history._earliest
                found = history.known_from(landmark, newest)
                assert found == anew.known_from(landmark, newest)
                known.add(found)
    assert len(known) > 3
