"""The command ``fleet tune``: parameters from the data of many recordings."""

import argparse

from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError

_MIB = 2**20


def tune(args: argparse.Namespace) -> int:
    """Tune parameters on recordings, and write a file of those that change."""
    from graph_slam_ros.formats.durable import write_whole
    from graph_slam_ros.tools.fleet.engine import Workers
    from graph_slam_ros.tools.fleet.tune import TUNED, Tuning
    from graph_slam_ros.tools.fleet.tune import tune as tuned
    from graph_slam_ros.tools.fleet.tuned import as_yaml, in_words, proof_in_words

    if args.scheduler and args.workers:
        raise GraphSlamError("fleet tune: no use for --workers with --scheduler: its workers are there already")
    work = Tuning(
        args.recordings,
        args.out,
        args.parameters.split(","),
        args.objective,
        args.truth,
        args.config,
        args.set,
        args.trials,
        args.limit,
        int(args.memory * _MIB),
        args.seed,
    )
    try:
        done = tuned(work, Workers(args.scheduler, args.workers), console.progress)
    except KeyboardInterrupt:
        console.warn(f"stopped: study and runs are in {args.out}, and the same command goes on from there")
        return console.INTERRUPTED
    for reason in done.left_out:
        console.warn(f"not tuned on: {reason}", most=console.SENTENCE)
    if done.others:
        console.warn(f"not tuned: {', '.join(done.others)}: only numbers above 0 are", most=console.SENTENCE)
    for one in done.parameters:
        value = f"{one.name}={one.value:g}" if one.state == "changed" else one.name
        console.show(f"{value}: {in_words(one)}")
    console.show(*proof_in_words(done))
    if not done.settings:
        if done.changes:
            console.warn("recordings that were left out are worse with these values: nothing is written")
        return console.LOSSES if done.changes or done.left_out else console.DONE
    write_whole(args.out / TUNED, as_yaml(done).encode())
    console.show(f"wrote {args.out / TUNED}")
    console.then(console.command("fleet", "replay", "...", "--config", args.out / TUNED))
    return console.LOSSES if done.left_out else console.DONE
