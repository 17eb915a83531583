"""Synthetic worlds with truth: the same seed gives the same recording.

recording = simulate("warehouse", seed=7, aisles=5)
write_bag(recording, "warehouse.mcap")
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.simulation import flight, manhattan, pythonrobotics, warehouse
from graph_slam_ros.simulation.bag import write_bag
from graph_slam_ros.simulation.draft import WrongLine, WrongMessage, write_table
from graph_slam_ros.simulation.drive import Drive
from graph_slam_ros.simulation.faults import KINDS, Fault, spoil_messages
from graph_slam_ros.simulation.faulty import faulty_graph, faulty_recording
from graph_slam_ros.simulation.instruments import Instruments, with_instruments
from graph_slam_ros.simulation.options import Option, fill, options_of
from graph_slam_ros.simulation.pose_graph import CityGraph, city_graph, landmark_graph, write_graph
from graph_slam_ros.simulation.recording import Recording, measurements, with_closures


@dataclass(frozen=True, slots=True)
class World:
    """A world: the dataclass of its options, and the function that drives through it."""

    options: type
    drive: Callable[[int, Any], Recording]

    @property
    def about(self) -> str:
        """Describe it in one sentence."""
        return (self.drive.__doc__ or "").strip().splitlines()[0]


WORLDS: dict[str, World] = {
    "pythonrobotics": World(pythonrobotics.PythonRobotics, pythonrobotics.simulate),
    "manhattan": World(manhattan.Manhattan, manhattan.simulate),
    "warehouse": World(warehouse.Warehouse, warehouse.simulate),
    "flight": World(flight.Flight, flight.simulate),
}


def simulate(world: str, /, seed: int, **options: Any) -> Recording:
    """Drive through a world.

    Raises
    ------
    GraphSlamError
        Unknown world or option (those that exist are named), wrong type, or a value out of bounds.
    """
    if world not in WORLDS:
        raise GraphSlamError(f"no world {world!r}; there are {', '.join(WORLDS)}")
    if seed < 0:
        raise GraphSlamError(f"seed {seed} is negative")
    of_world, of_instruments = WORLDS[world].options, {o.name for o in options_of(Instruments)}
    chosen = {name: value for name, value in options.items() if name in of_instruments}
    rest = {name: value for name, value in options.items() if name not in of_instruments}
    recording = WORLDS[world].drive(seed, fill(world, of_world, rest, [*of_instruments]))
    return with_instruments(recording, seed, fill(world, Instruments, chosen))


__all__ = [
    "KINDS",
    "WORLDS",
    "CityGraph",
    "Drive",
    "Fault",
    "Instruments",
    "Option",
    "Recording",
    "World",
    "WrongLine",
    "WrongMessage",
    "city_graph",
    "faulty_graph",
    "faulty_recording",
    "landmark_graph",
    "measurements",
    "options_of",
    "simulate",
    "spoil_messages",
    "with_closures",
    "write_bag",
    "write_graph",
    "write_table",
]
