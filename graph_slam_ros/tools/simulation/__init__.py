"""Synthetic worlds with truth: the same seed gives the same recording.

recording = simulate("warehouse", seed=7, aisles=5)
write_bag(recording, "warehouse.mcap")
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from graph_slam_ros.errors import GraphSlamError, did_you_mean
from graph_slam_ros.tools.simulation import flight, manhattan, pythonrobotics, warehouse
from graph_slam_ros.tools.simulation.bag import write_bag
from graph_slam_ros.tools.simulation.drive import Drive
from graph_slam_ros.tools.simulation.faults import (
    KINDS,
    Fault,
    WrongLine,
    WrongMessage,
    faulty_graph,
    faulty_recording,
    put_faults,
    write_table,
)
from graph_slam_ros.tools.simulation.instruments import with_instruments
from graph_slam_ros.tools.simulation.message_faults import MESSAGE_KINDS
from graph_slam_ros.tools.simulation.options import filled, options_of
from graph_slam_ros.tools.simulation.pose_graph import GRAPH_WORLDS, city_graph, sphere_graph
from graph_slam_ros.tools.simulation.recording import Recording, measurements, with_closures

WORLDS: dict[str, Callable[..., Recording]] = {
    "pythonrobotics": pythonrobotics.simulate,
    "manhattan": manhattan.simulate,
    "warehouse": warehouse.simulate,
    "flight": flight.simulate,
}


def simulate(world: str, /, seed: int, **options: Any) -> Recording:
    """Drive through a world.

    Raises
    ------
    GraphSlamError
        Unknown world or option (those that exist are named), wrong type, or a value out of bounds.
    """
    if world not in WORLDS:
        raise GraphSlamError(f"no world {world!r}; there are {', '.join(WORLDS)}{did_you_mean(world, WORLDS)}")
    of_world, of_every_world = options_of(WORLDS[world]), options_of(with_instruments)
    values = filled(world, of_world | of_every_world, options)
    recording = WORLDS[world](seed, **{name: values[name] for name in of_world})
    return with_instruments(recording, seed, **{name: values[name] for name in of_every_world})


def write_faulty_bag(recording: Recording, path: Path, faults: Sequence[Fault], seed: int) -> list[WrongMessage]:
    """Write a bag of a recording with faults. Returns the measurements that are wrong."""
    faulty, wrong = faulty_recording(recording, faults, seed)
    write_bag(faulty, path)
    if any(fault.is_of_messages for fault in faults):
        spoil_bag(path, path, faults, seed)
    return wrong


def spoil_bag(source: Path, out: Path, faults: Sequence[Fault], seed: int) -> None:
    """Write a copy of a recording, with faults in its messages."""
    drive = Drive(source)
    put_faults(drive, faults, seed)
    drive.write(out)


__all__ = [
    "GRAPH_WORLDS",
    "KINDS",
    "MESSAGE_KINDS",
    "WORLDS",
    "Drive",
    "Fault",
    "Recording",
    "WrongLine",
    "WrongMessage",
    "city_graph",
    "faulty_graph",
    "faulty_recording",
    "measurements",
    "options_of",
    "put_faults",
    "simulate",
    "sphere_graph",
    "spoil_bag",
    "with_closures",
    "with_instruments",
    "write_bag",
    "write_faulty_bag",
    "write_table",
]
