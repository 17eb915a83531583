"""Many: identities in one drive, vertices in one file. What they take is told; ``make soak`` has the large numbers."""

import resource
import subprocess
import time

import numpy as np
from places import executable
from reliability import tell, times

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings

S = 1_000_000_000
EACH = 5  # new identities at each look


def mebibytes(whose):
    return resource.getrusage(whose).ru_maxrss / 1024.0


def test_G25_a_drive_past_very_many_identities_has_each_where_it_is():
    slam = GraphSlam(Config.from_mapping({"odometry.noise": "density"}))
    rng, count, start_s = np.random.default_rng(25), times(300, 100_000), time.process_time()

    def observe(first, x):
        noise = 0.02 * rng.standard_normal((EACH, 2))
        there = [(0.3 * (first // EACH) + 1.0 + 0.2 * j - x + noise[j, 0], 2.0 + noise[j, 1]) for j in range(EACH)]
        return [Sighting(f"{first + j}", "position", at, (0.0004, 0.0, 0.0, 0.0004)) for j, at in enumerate(there)]

    for first in range(0, count, EACH):
        k, x = first // EACH, 0.3 * (first // EACH)
        slam.process(Odometry(10**18 + k * S // 2, (x, 0.0, 0.0)))
        seen = observe(first, x) + (observe(first - EACH, x) if k else [])
        slam.process(Sightings(10**18 + k * S // 2, "tags", tuple(seen)))
    for event in ("end", "optimize"):
        slam.process(Control(event))
    assert len(slam.view.landmarks) == count
    assert slam.counters.as_dict() == {}
    found = np.array([slam.view.solver.estimate([mark.vertex]) for mark in slam.view.landmarks.values()]).reshape(-1, 2)
    told = slam.view.trajectory()[np.arange(count) // EACH]
    off = found - told[:, :2] - np.array([[1.0 + 0.2 * (k % EACH), 2.0] for k in range(count)])
    assert np.abs(off).max() < 0.2, "each stands where it was seen from its keyframe"
    worst = {"cpu_s": time.process_time() - start_s, "mib": mebibytes(resource.RUSAGE_SELF)}
    tell("identities", tried=count, failed=0, worst=worst)


def test_G25_a_graph_of_very_many_vertices_is_solved(tmp_path):
    """Rows of poses there and back, each a step from the last, and edges to the row before."""
    count, width = times((20_000, 100), (1_000_000, 1_000))
    rng, k = np.random.default_rng(1), np.arange(count)
    row, column = np.divmod(k, width)
    is_back = row % 2 == 1
    true = np.stack([np.where(is_back, width - 1 - column, column), row, np.pi * is_back], axis=1).astype(float)
    start = true + np.cumsum(1e-3 * rng.standard_normal((count, 3)), axis=0) * (1.0, 1.0, 0.0)
    later = np.arange(width, count, 25)
    across = np.stack([(row[later] - 1) * width + width - 1 - column[later], later], axis=1)
    with (tmp_path / "large.g2o").open("w") as out:
        for v, (x, y, theta) in enumerate(start.tolist()):
            out.write(f"VERTEX_SE2 {v} {x:.6f} {y:.6f} {theta:.6f}\n")
        for a, b in [*zip(k[:-1].tolist(), k[1:].tolist(), strict=True), *across.tolist()]:
            x, y, theta = np.add(se2.between(tuple(true[a]), tuple(true[b])), 1e-3 * rng.standard_normal(3))
            out.write(f"EDGE_SE2 {a} {b} {x:.6f} {y:.6f} {theta:.6f} 1e6 0 0 1e6 0 1e6\n")
    command = [executable("graph_slam"), "optimize", "large.g2o", "--out", "solved.g2o"]
    begun = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    assert "\nconverged" in done.stdout
    solved = [line.split()[2:4] for line in (tmp_path / "solved.g2o").read_text().splitlines() if line[:6] == "VERTEX"]
    assert np.abs(np.array(solved, dtype=float) - true[:, :2]).max() < times(0.5, 50.0)
    cpu_s = ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime
    tell("vertices_grid", tried=count, failed=0, worst={"cpu_s": cpu_s, "mib": mebibytes(resource.RUSAGE_CHILDREN)})
