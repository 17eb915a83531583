"""How long it takes to take up the map of a run that was cut off: ``python -m benchmarks.recovery [--poses 10000]``.

A Manhattan with a closure per three poses is driven as the node drives, its journal flushed after each update, and left
without an end. Then its map is read and solved, as the node does when it starts again; and what came of it is compared.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.live.streams import city_measurements
from graph_slam_ros.runs import recorder as recording
from graph_slam_ros.runs.restore import map_of
from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.warmup import warmup


def drive(folder: Path, config: Config, poses: int) -> GraphSlam:
    """A run that nobody ends."""
    recording._BYTES_PER_S = np.inf  # the drive takes a hundredth of its time
    recorder = recording.RunRecorder(folder, config, 1.0)
    slam = GraphSlam(config, recorder.sink)
    for m in (*city_measurements(poses), Control("flush")):
        recorder.record(slam, slam.process(m))
        recorder.flush()
    return slam


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=10_000, metavar="N")
    args = parser.parse_args()
    warmup()
    every_m = {"keyframes.max_interval_s": 1.0, "keyframes.min_distance_m": 0.5}
    config = Config.from_mapping(every_m | {"map.condense": False})  # all keyframes are compared
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        start_s, view = time.process_time(), drive(run, config, args.poses).view
        drove_s = time.process_time() - start_s
        written = {name: sum(f.stat().st_size for f in run.glob(f"{name}.mcap")) / 2**20 for name in ("ingest", "map")}
        start, cpu_s = time.perf_counter(), time.process_time()
        state = map_of(run, losses := [])
        read_s = time.perf_counter() - start
        again = GraphSlam(config, start=state).view
        took_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu_s
        solved = view.solver.optimize(view.solver.settings.until_still())
        apart_m = np.abs(again.trajectory() - view.trajectory()).max()
        same = (again.ledger.verdict.values == view.ledger.verdict.values).all()
        print(
            f"RELIABILITY recovery keyframes={len(view.keyframes)} edges={view.graph.edge_count} drove_s={drove_s:.1f}"
            f" journal_mib={written['ingest']:.1f} map_mib={written['map']:.1f} read_s={read_s:.2f}"
            f" recovered_s={took_s:.2f} cpu_s={cpu_s:.2f} verdicts={'same' if same else 'other'}"
            f" apart={apart_m:.1e} chi2={again.solver.evaluate().chi2_final / solved.chi2_final:.9f} lost={losses}"
        )


if __name__ == "__main__":
    main()
