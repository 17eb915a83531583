"""Revisions in any order: each is undone by its inverse, one that fails leaves nothing, and what is frozen stays."""

import numpy as np
import pytest
from reliability import times
from test_decisions import NOISE, Drive, lies

from graph_slam_ros.graph import Gaussian
from graph_slam_ros.slam.revision import Replacement, Revision
from graph_slam_ros.slam.robust.ledger import Reason
from graph_slam_ros.solver import Solver

NOISE_KEY = ("closures", "", "position")


def state(drive, edges=None, vertices=None):
    """What is measured and believed of the first edges, and the first poses."""
    graph, ledger = drive.backend.graph, drive.backend.ledger
    every = [graph.edge(edge) for edge in range(graph.edge_count if edges is None else edges)]
    numbers = np.concatenate([np.r_[one.measured, one.sqrt_information.ravel(), one.weight] for one in every])
    factors = {key: factor for key, factor in drive.backend.noise.factors.items() if factor != 1.0}
    told = ledger.verdict.values[: len(every)].tolist(), ledger.reason.values[: len(every)].tolist(), factors
    return told, numbers, drive.backend.solver.values[: 3 * (vertices or graph.vertex_count)]


def is_same(a, b, off=0.0):
    """By bytes, or where something was solved and scaled back off by so much at most."""
    return a[0] == b[0] and all(np.abs(one - other).max() <= off for one, other in zip(a[1:], b[1:], strict=True))


class Reviser:
    """Draws revisions of a drive, as policies make them."""

    def __init__(self, drive, rng):
        self.drive, self.rng, self.backend = drive, rng, drive.backend

    def apply(self, revision):
        return self.backend.apply("odometry", lambda: revision)

    def one(self):
        graph, first = self.backend.graph, self.backend.first_free_edge
        every = map(graph.edges_of, ("odometry", "closures"))
        odometry, closures = ([e for e in of.tolist() if e >= first and graph.edge(e).weight] for of in every)
        some = self.rng.choice(odometry[-10:], size=min(3, len(odometry)), replace=False).tolist()
        wider = [Replacement(e, graph.edge(e).measured, Gaussian.from_sigmas(1.0, 1.0, 1.0)) for e in some]
        slip = Revision(replaced=wider, reason=Reason.SLIP, evidence=9.0, threshold=5.0)
        noise = Revision(noise={NOISE_KEY: float(self.rng.uniform(0.5, 2.0))}, solves="all")
        verdicts = Revision(verdicts=self.backend.ledger.copy(), settings=self.drive.settings, solves="all")
        removal = Revision(withdrawn=closures[-2:], reason=Reason.WITHDRAWN)
        return (slip, noise, verdicts, removal)[self.rng.integers(4)]

    def undone(self, revision, applied):
        noise = {NOISE_KEY: 1.0} if revision.noise else None
        return Revision(noise=noise, restored=applied.replaced, solves="all")


@pytest.mark.parametrize("seed", range(times(3, 100)))
def test_each_revision_is_undone_by_its_inverse_and_one_that_fails_leaves_nothing(seed, monkeypatch):
    rng, drive = np.random.default_rng(seed), Drive(seed).go(70, lies(every=3)).solve()
    reviser, applied_count = Reviser(drive, rng), 0
    for step in range(12):
        if step == 6:
            drive.backend.hold_map()
            held = drive.backend.held[::-1]
            at_hold = state(drive, *held)
            drive.go(82, lies(every=3)).solve()
        before, edges = state(drive), drive.backend.graph.edge_count
        revision = reviser.one()
        if rng.random() < 0.4:
            with monkeypatch.context() as broken:
                for name in ("optimize", "update"):
                    broken.setattr(Solver, name, lambda *_: 1 / 0)
                assert reviser.apply(revision) is None
            assert is_same(state(drive), before) and drive.backend.graph.edge_count == edges
            continue
        applied = reviser.apply(revision)
        if applied is not None:
            applied_count += 1
            assert reviser.apply(reviser.undone(revision, applied)) is not None
            drive.backend.solver.optimize()
        assert is_same(state(drive, edges), before, off=1e-6)
        if step >= 6:
            assert is_same(state(drive, *held), at_hold)
    assert applied_count > 2


def test_a_revision_that_names_what_is_held_is_refused_and_counted():
    drive = Drive().go(40).solve()
    drive.backend.hold_map()
    before = state(drive)
    assert drive.backend.apply("odometry", lambda: Revision(replaced=[Replacement(5, (0.0, 0.0, 0.0), NOISE)])) is None
    assert drive.counters["odometry", "unsolved"] == 1
    assert is_same(state(drive), before)
