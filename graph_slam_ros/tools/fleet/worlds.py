"""Simulated recordings of a fleet: an address says world, options, fault and seed; the worker records it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCHEME = "simulated:"
NO_FAULT = "none"


def address(world: str, options: Mapping[str, Any], fault: str, seed: int) -> str:
    """Return the address of a simulated recording."""
    parts = {"world": world, "options": dict(options), "fault": fault, "seed": seed}
    return SCHEME + json.dumps(parts, sort_keys=True)


def world_of(url: str) -> dict[str, Any]:
    """The columns of the table that say which world an address is of: world, fault, seed; of a recording none."""
    if not url.startswith(SCHEME):
        return {}
    parts = _parts(url)
    options = [f"{name}={value}" for name, value in parts["options"].items()]
    return {"world": " ".join([parts["world"], *options]), "fault": parts["fault"], "seed": parts["seed"]}


def _parts(url: str) -> dict[str, Any]:
    parts: dict[str, Any] = json.loads(url.removeprefix(SCHEME))
    return parts


def record(url: str, folder: Path) -> Path:
    """Simulate a recording into a folder; returns its file.

    Raises
    ------
    GraphSlamError
        The world does not have what a fault needs.
    """
    from graph_slam_ros.tools.simulation import Fault, simulate, write_faulty_bag

    parts, file = _parts(url), folder / "simulated.mcap"
    faults = [] if parts["fault"] == NO_FAULT else [Fault.parsed(parts["fault"])]
    write_faulty_bag(simulate(parts["world"], parts["seed"], **parts["options"]), file, faults, parts["seed"])
    return file
