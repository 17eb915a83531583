"""A drive with 12 wrong loop closures, of which 4 agree with one another and are believed.

The robot takes the fourth of four aisles for the second four times, and only true closures with the first contradict.
``PYTHONPATH=test python test/planted_closures.py FOLDER`` writes FOLDER/run, clean (without the 12), truth.tum and
wrong.csv, the ids of the wrong edges.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from graph_slam_ros.formats.tum import tum_text
from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import Closure
from graph_slam_ros.runs.restore import record_run, restored
from graph_slam_ros.slam import Config, Control, Odometry

TOPIC, START_S, AISLE_M, APART_M, AISLES = "closures", 1000, 16, 2, 4
SIGMA_M, SIGMA_RAD = 0.05, 0.01  # of a closure
_WAY, _TURN_PER_M, _TURN_PER_RAD = 0.02, 0.01, 0.05  # sigmas of odometry in a step
BELIEVED, OTHERS, TRUE = 4, 8, 3
CONFIG = Config.from_mapping({"keyframes.min_distance_m": 0.9, "odometry.noise": "motion"})


def path():
    """Poses a metre apart: the aisles up and down, home, and the first aisle again."""
    corners = []
    for aisle in range(AISLES):
        ends = [(0, aisle * APART_M), (AISLE_M, aisle * APART_M)]
        corners += ends[:: -1 if aisle % 2 else 1]
    corners += [(0, 0), (AISLE_M, 0)]
    out = [(0.0, 0.0, 0.0)]
    for (x, y), (u, v) in pairwise(corners):
        steps, heading = abs(u - x) + abs(v - y), float(np.arctan2(v - y, u - x))
        out += [(x + (u - x) * k / steps, y + (v - y) * k / steps, heading) for k in range(1, steps + 1)]
    return out


def measurements(seed=0, *, with_wrong=True):
    """Yield odometry and closures; the drive is the same with and without the wrong ones."""
    rng, truth = np.random.default_rng(seed), path()
    at = se2.IDENTITY
    closures = _closures(rng, truth, with_wrong=with_wrong)
    rng = np.random.default_rng(seed + 1)
    for k, pose in enumerate(truth):
        if k:
            x, y, turn = se2.between(truth[k - 1], pose)
            turn += rng.normal(0.0, _TURN_PER_M + _TURN_PER_RAD * abs(turn))
            at = se2.compose(at, (x * (1.0 + rng.normal(0.0, _WAY)), y, turn))
        yield Odometry(_stamp_ns(k), tuple(map(float, at)))
        yield from closures.get(k, ())
    yield Control("end")
    yield Control("optimize")


def _stamp_ns(k):
    return (START_S + k) * 10**9


def _closures(rng, truth, *, with_wrong):
    """The closures of each pose, as seen from it: true ones between its two drives of the first aisle."""
    n, aisle = len(truth), AISLE_M + APART_M
    wanted = [
        (k - (n - AISLE_M), k, se2.between(truth[k - (n - AISLE_M)], truth[k]))
        for k in np.linspace(n - AISLE_M + 2, n - 3, TRUE).astype(int).tolist()
    ]
    wrong = [(aisle + k, 3 * aisle + k, se2.IDENTITY) for k in np.linspace(3, 12, BELIEVED).astype(int).tolist()]
    while len(wrong) < BELIEVED + OTHERS:
        a, b = sorted(rng.integers(0, n, 2).tolist())
        if b - a > 10 and np.linalg.norm(np.subtract(truth[a][:2], truth[b][:2])) > 5.0:
            wrong.append((a, b, (*rng.normal(0.0, 0.3, 2).tolist(), float(rng.normal(0.0, 0.2)))))
    sigmas, out = [SIGMA_M, SIGMA_M, SIGMA_RAD], {}
    covariance = tuple(np.diag(np.square(sigmas)).ravel().tolist())
    for a, b, seen in [*wanted, *(wrong if with_wrong else ())]:
        T = se2.compose(seen, tuple(rng.normal(0.0, sigmas).tolist()))
        out.setdefault(b, []).append(Closure(_stamp_ns(b), _stamp_ns(a), TOPIC, tuple(map(float, T)), covariance))
    return out


def run(folder, seed=0, *, with_wrong=True):
    """Write the run; returns the ids of the wrong edges, those that agree with one another first."""
    record_run(folder, CONFIG, measurements(seed, with_wrong=with_wrong), [])
    true = {(_stamp_ns(k - (len(path()) - AISLE_M)), _stamp_ns(k)) for k in range(len(path()))}
    ends = ends_of(folder)
    wrong = [edge for edge, stamps in ends.items() if stamps not in true]
    aisle = AISLE_M + APART_M
    alike = {(_stamp_ns(aisle + k), _stamp_ns(3 * aisle + k)) for k in range(AISLE_M)}
    return sorted(wrong, key=lambda edge: (ends[edge] not in alike, edge))


def ends_of(folder):
    """The stamps of the keyframes of each closure."""
    view = restored(folder, []).view
    stamps = dict(zip(view.keyframes.ids.tolist(), view.keyframes.stamps_ns.tolist(), strict=True))
    edges = view.graph.edges_of("closures").tolist()
    return {edge: tuple(stamps[vertex] for vertex in view.graph.edge(edge).vertices) for edge in edges}


def error_m(folder):
    """The root mean square error [m] of the path: it begins where the truth does."""
    view, truth = restored(folder, []).view, np.array(path())
    at = truth[view.keyframes.stamps_ns // 10**9 - START_S]
    return float(np.sqrt(np.mean(np.sum((view.trajectory()[:, :2] - at[:, :2]) ** 2, axis=1))))


def main():
    folder = Path(sys.argv[1])
    wrong = run(folder / "run")
    run(folder / "clean", with_wrong=False)
    stamps, poses = [_stamp_ns(k) for k in range(len(path()))], np.array(path())
    (folder / "truth.tum").write_text(tum_text(stamps, poses))
    (folder / "wrong.csv").write_text("edge\n" + "".join(f"{edge}\n" for edge in wrong))
    errors = (f"{error_m(folder / name):.3f} m" for name in ("run", "clean"))
    print("error: {}; without wrong closures {}".format(*errors))


if __name__ == "__main__":
    main()
