"""The command ``fleet simulate``: seeds and faults of simulated worlds."""

import argparse
import math

from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError

_MIB = 2**20


def simulate(args: argparse.Namespace) -> int:
    """Simulate worlds, replay and score them, and print the means over seeds."""
    from graph_slam_ros.tools.fleet.engine import Workers
    from graph_slam_ros.tools.fleet.page import write_page
    from graph_slam_ros.tools.fleet.simulate import Sweep, cells, simulate_all

    if args.scheduler and args.workers:
        raise GraphSlamError("fleet simulate: no use for --workers with --scheduler: its workers are there already")
    memory = int(args.memory * _MIB)
    work = Sweep(args.worlds, args.out, args.seeds, args.seed, args.fault, args.config, args.set, args.limit, memory)
    try:
        done = simulate_all(work, Workers(args.scheduler, args.workers), console.progress)
    except KeyboardInterrupt:
        console.warn(f"stopped: what is done is in {args.out}, and the same command goes on from there")
        return console.INTERRUPTED
    found = cells(done.rows)
    names = [" ".join(part for part in (one.world, one.fault, one.setting)) for one in found]
    width = max(map(len, names))
    console.show(f"{'':{width}s}  runs failed    rmse_m   worst_m     map_m      nees")
    for name, one in zip(names, found, strict=True):
        numbers = "".join(f"{x:10.4g}" if math.isfinite(x) else f"{'-':>10s}" for x in _numbers(one))
        sure = f" +- {one.nees_sigma:.2g}" if math.isfinite(one.nees_sigma) else ""
        console.show(f"{name:{width}s}{one.runs:6d}{one.failed:7d}{numbers}{sure}")
    for row in done.rows:
        if row["state"] == "failed":
            console.warn(f"failed: {row['recording']} ({row['setting']}): {row['reason']}", most=console.SENTENCE)
    page = write_page(args.out, done.rows)
    console.show(f"results in {args.out}: {page.name}, table.parquet; {done.reused} runs were there")
    console.then(f"{console.command('fleet', 'table', args.out, '--order', 'rmse_m DESC')} (the worst first)")
    return console.LOSSES if any(row["state"] == "failed" for row in done.rows) else console.DONE


def _numbers(one: object) -> tuple[float, ...]:
    return tuple(getattr(one, name) for name in ("rmse_m", "worst_m", "map_rmse_m", "nees"))
